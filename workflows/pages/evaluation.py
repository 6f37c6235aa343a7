"""The HTML page of an evaluation of models: self-contained."""

from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import numpy as np

from coregister.evaluate.confidence_intervals import Interval
from coregister.evaluate.evaluation import Curve, Evaluation, Row
from registration.model.gnm_npz import GNMData
from registration.report.charts import Line, number_curves
from registration.report.heat_map import UNMEASURED, heat_pictures, scale_limit_mm
from registration.report.inputs import HeatMap
from registration.report.pictures import SCALE, data_uri
from registration.report.style import document, sectioned

_CSS = """
td small { color: var(--soft); margin-left: 6px; } h3 { margin: 0 0 10px; font-size: 15.5px; }
.panel + .panel { margin-top: 16px; } td.kind { color: var(--soft); }
"""


def write_evaluate_page(evaluation: Evaluation, models: Mapping[str, GNMData], manifest: Mapping[str, Any]) -> str:
    """Curves, gains, tables and a map of where each model falls short."""
    tabled = evaluation.settings.components[-1]
    sections = {
        "Generalization": (
            "Mean distance of each model's best from held-out heads, with 95 % intervals over subjects. Nothing is "
            "regularised and nothing scaled. Expressions: displacement from the neutral within a region's soft mask.",
            _panel(number_curves(_generalization(evaluation), "components")),
        ),
        "Gain": (
            "By how much a model's mean distance is smaller than the first model's, with the same number of "
            "components; subjects are paired.",
            _gains(evaluation),
        ),
        "Where": (
            f"Distance on the head's skin with {tabled} components, mean over subjects.",
            _maps(evaluation, models),
        ),
        "Specificity and compactness": (
            "Specificity: distance of random heads from the nearest held-out one; a model that generalizes by being "
            "able to look like anything pays here. Its band is over random heads. Compactness: what the first "
            "components hold of a model's own variation.",
            _panel(number_curves(_specificity(evaluation), "components")),
        ),
        "Tables": (
            f"Millimetres, mean and 95 % interval. Regions and tags: neutrals with {tabled} identity components. "
            "Categories: every capture with all identity and expression components.",
            _tables(evaluation),
        ),
        "Provenance": ("All that is needed to make this result again.", _provenance(manifest)),
    }
    footer = f"Figures in correspondence are of {evaluation.vertices:,} vertices: the head's skin without the neck."
    body = _header(evaluation, tabled) + sectioned(sections, footer=footer)
    return document("Evaluation of head models", body, css=_CSS)


def _header(evaluation: Evaluation, tabled: int) -> str:
    tiles = []
    for name, one in evaluation.models.items():
        mean = float(one.identity.at(tabled).mean())
        tiles.append((f"{mean:.2f} <small>mm</small>", f"{name}: generalization, {tabled} components"))
        if one.specificity is not None:
            random = float(one.specificity.at(tabled).mean())
            tiles.append((f"{random:.2f} <small>mm</small>", f"{name}: specificity, {tabled} components"))
    for gain in evaluation.gains:
        if gain.components == tabled:
            tiles.append((f"{100 * gain.gain.mean:.0f} <small>%</small>", f"{gain.model}: nearer than the first"))
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{escape(label)}</span></div>' for value, label in tiles)
    lost = sum(one.unconverged for one in evaluation.models.values())
    told = f"<ul><li>{lost} fits ended before they settled.</li></ul>" if lost else ""
    names = " · ".join(escape(name) for name in evaluation.models)
    return (
        '<header><div class="top"><div class="eyebrow">Evaluation of head models</div>'
        f'<h1>{names}</h1><p class="lead">On {len(evaluation.subjects)} people that no model was made from.</p>{told}'
        f'<div class="tiles">{cells}</div></div></header>'
    )


def _generalization(evaluation: Evaluation) -> dict[str, list[Line]]:
    panels: dict[str, list[Line]] = {"identity, mm": [], "identity, scan to surface, mm": []}
    for name, one in evaluation.models.items():
        panels["identity, mm"].append(_line(name, one.identity))
        if one.scans is not None:
            panels["identity, scan to surface, mm"].append(_line(name, one.scans))
        for region, curve in one.expressions.items():
            panels.setdefault(f"expression, {_words(region)}, mm", []).append(_line(name, curve))
    return panels


def _specificity(evaluation: Evaluation) -> dict[str, list[Line]]:
    panels: dict[str, list[Line]] = {"specificity, mm": []}
    for name, one in evaluation.models.items():
        if one.specificity is not None:
            panels["specificity, mm"].append(_line(name, one.specificity))
        for part, compact in one.compactness.items():
            numbers = range(1, len(compact.share) + 1)
            shares = [100 * share for share in compact.share]
            panels.setdefault(f"variance, {_words(part)}, %", []).append(Line(name=name, x=numbers, y=shares))
    return panels


def _line(name: str, curve: Curve) -> Line:
    return Line(
        name=name,
        x=curve.components,
        y=[one.mean for one in curve.intervals],
        low=[one.low for one in curve.intervals],
        high=[one.high for one in curve.intervals],
    )


def _gains(evaluation: Evaluation) -> str:
    if not evaluation.gains:
        return ""
    rows = "".join(
        f'<tr><td>{escape(one.model)}</td><td class="num">{one.components}</td>'
        f'<td class="num">{_cell(one.difference_mm)}</td><td class="num">{_cell(one.gain, 100, 1)} %</td></tr>'
        for one in evaluation.gains
    )
    first = escape(next(iter(evaluation.models)))
    heads = f'<th>model</th><th class="num">components</th><th class="num">mm nearer than {first}</th>'
    return _panel(f'<table><tr>{heads}<th class="num">gain</th></tr>{rows}</table>')


def _maps(evaluation: Evaluation, models: Mapping[str, GNMData]) -> str:
    limit = max(scale_limit_mm(one.vertex_mm) for one in evaluation.models.values())
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    bar = (
        f'<div class="bar"><span>0 mm</span><i style="background:linear-gradient(90deg, {stops})"></i>'
        f'<span>{limit:g} mm and more</span><em><span class="swatch" style="background:rgb{UNMEASURED}"></span>'
        "not measured: neck, eyes, mouth</em></div>"
    )
    panels = []
    for name, one in evaluation.models.items():
        heat = HeatMap(
            vertices=models[name].template_vertex_positions.astype(np.float32),
            triangles=models[name].triangles,
            distance_mm=one.vertex_mm,
            T_head_world=np.eye(4),
        )
        sides = "".join(
            f'<figure><img class="zoom" alt="{escape(name)}, {side}" src="{data_uri(picture)}"></figure>'
            for side, picture in heat_pictures(heat, limit)
        )
        panels.append(_panel(f'<h3>{escape(name)}</h3><div class="sides">{sides}</div>'))
    return "".join(panels) + bar


def _tables(evaluation: Evaluation) -> str:
    models = list(evaluation.models.items())
    rows: dict[tuple[str, str], dict[str, Row]] = {}
    for name, one in models:
        for row in one.rows:
            rows.setdefault((row.kind, row.name), {})[name] = row
    heads = "".join(f'<th class="num">{escape(name)}</th>' for name, _ in models)
    tables = []
    for kind in dict.fromkeys(kind for kind, _ in rows):
        members = [(name, found) for (other, name), found in rows.items() if other == kind]
        lines = "".join(_table_row(name, found, [model for model, _ in models]) for name, found in members)
        tables.append(
            f'<table><tr><th style="width:30%">{escape(_words(kind))}</th><th class="num">subjects</th>{heads}</tr>'
            f"{lines}</table>"
        )
    return "".join(_panel(table) for table in tables)


def _table_row(name: str, found: Mapping[str, Row], models: Iterable[str]) -> str:
    subjects = next(iter(found.values())).subjects
    cells = "".join(
        f'<td class="num">{_cell(found[model].distance_mm) if model in found else "–"}</td>' for model in models
    )
    return f'<tr><td>{escape(_words(name))}</td><td class="num">{subjects}</td>{cells}</tr>'


def _cell(interval: Interval, factor: float = 1.0, digits: int = 3) -> str:
    mean = f"{factor * interval.mean:.{digits}f}"
    if interval.low is None or interval.high is None:
        return f"{mean}<small>one subject</small>"
    return f"{mean}<small>{factor * interval.low:.{digits}f} to {factor * interval.high:.{digits}f}</small>"


def _provenance(manifest: Mapping[str, Any]) -> str:
    parts = []
    for title, key in (("Inputs, sha256", "inputs"), ("Settings", "config"), ("Versions", "versions")):
        cells = "".join(
            f'<tr><td>{escape(str(name))}</td><td class="mono">{escape(str(value))}</td></tr>'
            for name, value in manifest[key].items()
        )
        parts.append(
            f'<details class=panel><summary>{title}</summary><table style="margin-top:10px">{cells}</table></details>'
        )
    return "".join(parts)


def _panel(content: str) -> str:
    return f'<div class="panel">{content}</div>' if content else ""


def _words(name: str) -> str:
    return name.replace("_", " ")
