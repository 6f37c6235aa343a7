"""The HTML page of a built model: what its components do, from whom it came, who was left out; self-contained."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from registration.frames import MM_PER_M
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.report.charts import Line, number_curves
from registration.report.heat_map import heat_pictures, scale_limit_mm
from registration.report.inputs import HeatMap
from registration.report.pictures import SCALE, data_uri
from registration.report.style import document, sectioned

SIGMAS = 2.0
IDENTITY, EXPRESSION = 4, 2  # components drawn, of the head and of each region
SIDES, SIZE = ("front", "subject's left"), (300, 325)  # of each picture; px
_CSS = """
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 16px; margin-bottom: 16px; }
.pair .sides { grid-template-columns: 1fr 1fr; }
h3 { margin: 0 0 10px; font-size: 15.5px; } .panel + .panel { margin-top: 16px; } td.kind { color: var(--soft); }
.pair .panel + .panel { margin-top: 0; }
"""


def write_model_page(data: GNMData, manifest: Mapping[str, Any]) -> str:
    """The first components at plus and minus two standard deviations, variance, tables, and who was rejected."""
    sections = {
        "Identity": (
            f"The template with one component at plus and minus {SIGMAS:g} standard deviations; colours are distances.",
            _drawn(data, _identity(data)),
        ),
        "Expressions": ("The same of every region's first components.", _drawn(data, _expressions(data))),
        "Variance": ("What each component adds, and what share of all is kept.", _variance(manifest)),
        "Left out": (
            "Registrations that stand apart from the others, and are in no component.",
            _rejected(manifest["rejected"]),
        ),
        "Who": ("Subjects by tag; expressions by category and label.", _tables(manifest)),
        "Provenance": ("All that is needed to make this model again.", _provenance(manifest)),
    }
    return document("A head model", _header(manifest) + sectioned(sections), css=_CSS)


def _header(manifest: Mapping[str, Any]) -> str:
    identity, figures = manifest["identity"], manifest["figures"]
    expressions = sum(one["expressions"] for one in manifest["subjects"])
    tiles = (
        (str(len(manifest["subjects"])), "subjects"),
        (str(expressions), "expressions"),
        (str(identity["components"]), f"identity components, {100 * identity['share_kept']:.1f} % of the variance"),
        (str(len(manifest["rejected"])), "registrations left out"),
        (f"{figures['drift_mm']:.2f} <small>mm</small>", "drift of the template's skull"),
    )
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles)
    return (
        '<header><div class="top"><div class="eyebrow">Head model</div>'
        f'<h1>{manifest["content_id"][:16]}</h1><p class="lead">Built from registrations and the model '
        f'<span class="mono">{manifest["inputs"]["previous"][:16]}</span>.</p>'
        f'<div class="tiles">{cells}</div></div></header>'
    )


def _identity(data: GNMData) -> dict[str, np.ndarray]:
    """Components that move the skin, the first ones, by name."""
    moves = np.abs(data.vertex_identity_basis[:, regions.exterior(data)]).max((1, 2), initial=0) > 0
    chosen = np.flatnonzero(moves)[:IDENTITY].tolist()
    return {str(data.identity_names[k]): data.vertex_identity_basis[k] for k in chosen}


def _expressions(data: GNMData) -> dict[str, np.ndarray]:
    found = {}
    for members, _ in regions.expression_regions(data).values():
        for k in members[:EXPRESSION].tolist():
            found[str(data.expression_names[k])] = data.expression_basis[k]
    return found


def _drawn(data: GNMData, components: Mapping[str, np.ndarray]) -> str:
    """Each at both ends, coloured by how far vertices move; one scale for all."""
    if not components:
        return ""
    skin = regions.exterior(data)
    sizes = {name: SIGMAS * MM_PER_M * np.linalg.norm(basis, axis=1) for name, basis in components.items()}
    limit = scale_limit_mm(np.concatenate([size[skin] for size in sizes.values()]))
    panels = []
    for name, basis in components.items():
        ends = []
        for sign, sigmas in (("+", SIGMAS), ("−", -SIGMAS)):
            heat = HeatMap(
                vertices=(data.template_vertex_positions + sigmas * basis).astype(np.float32),
                triangles=data.triangles,
                distance_mm=sizes[name],
                T_head_world=np.eye(4),
            )
            told = escape(f"{name}, {sign}{SIGMAS:g}")
            sides = "".join(
                f'<figure><img class="zoom" loading="lazy" alt="{told}, {side}" src="{data_uri(picture)}"></figure>'
                for side, picture in heat_pictures(heat, limit, sides=SIDES, size=SIZE)
            )
            ends.append(f'<div class="panel"><h3>{told}</h3><div class="sides">{sides}</div></div>')
        panels.append(f'<div class="pair">{"".join(ends)}</div>')
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    bar = (
        f'<div class="bar"><span>0 mm</span><i style="background:linear-gradient(90deg, {stops})"></i>'
        f"<span>{limit:g} mm and more</span></div>"
    )
    return "".join(panels) + bar


def _variance(manifest: Mapping[str, Any]) -> str:
    parts = {"identity": manifest["identity"]}
    if isinstance(manifest["expression"], Mapping):
        parts |= manifest["expression"]
    lines, rows = [], []
    for name, part in parts.items():
        variance = np.array(part["variance_mm2"], float)
        share = 100 * part["share_kept"] * np.cumsum(variance) / max(variance.sum(), 1e-30)
        words = name.replace("_", " ")
        lines.append(Line(name=words, x=range(1, len(share) + 1), y=share.tolist()))
        cells = (part["components"], f"{100 * part['share_kept']:.2f} %", f"{100 * part['share_previous']:.0f} %")
        rows.append((words, *cells, part["method"]))
    heads = ("", "components", "variance kept", "previous model's share", "found by")
    chart = number_curves({"variance, %": lines}, "components")
    told = "" if len(parts) > 1 else f"<p>Expressions are {escape(str(manifest['expression']))}.</p>"
    return f'<div class="panel">{chart}</div><div class="panel">{table(heads, rows)}</div>{told}'


def _rejected(rejected: Sequence[Mapping[str, str]]) -> str:
    if not rejected:
        return '<div class="panel">None.</div>'
    rows = [(one["name"], one["reason"]) for one in rejected]
    return f'<div class="panel">{table(("registration", "why"), rows)}</div>'


def _tables(manifest: Mapping[str, Any]) -> str:
    groups = {**manifest["demographics"], "category": manifest["categories"], "label": manifest["labels"]}
    found = [table((name, "count"), list(counts.items())) for name, counts in groups.items() if counts]
    return "".join(f'<div class="panel">{one}</div>' for one in found)


def _provenance(manifest: Mapping[str, Any]) -> str:
    parts = []
    for title, key in (("Inputs, sha256", "inputs"), ("Settings", "config"), ("Versions", "versions")):
        content = table(("", ""), list(manifest[key].items()))
        parts.append(f"<details class=panel><summary>{title}</summary>{content}</details>")
    return "".join(parts)


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """An HTML table; the first column is text, numbers stand to the right. Everything is escaped."""

    def cell(value: Any, tag: str, number: bool) -> str:
        return f"<{tag}{' class=num' if number else ''}>{escape(str(value))}</{tag}>"

    numeric = [bool(rows) and isinstance(value, (int, float)) for value in (rows[0] if rows else heads)]
    head = "".join(cell(name, "th", number) for name, number in zip(heads, numeric, strict=True))
    body = "".join(
        "<tr>" + "".join(cell(value, "td", number) for value, number in zip(row, numeric, strict=True)) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
