"""The HTML page of one registration: self-contained, no external resources."""

import json
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

from registration.report.charts import loss_curves
from registration.report.heat_map import UNMEASURED, heat_pictures, scale_limit_mm
from registration.report.inputs import HeatMap, ReportInputs
from registration.report.pictures import CLASS_COLOURS, SCALE, Picture, ViewPictures, data_uri, view_pictures
from registration.report.style import document, sectioned
from registration.storage.hashing import to_jsonable
from registration.types import Registration

FIGURES = {
    "scan_to_mesh": "Scan to mesh",
    "scan_to_mesh_by_area": "Scan to mesh, 100,000 points by area",
    "mesh_to_scan": "Mesh to scan",
    "vertex_error": "Vertex error against the truth",
    "drift": "Drift from the neutral",
}
STATISTICS = {"mean_mm": "mean", "median_mm": "median", "std_mm": "std", "p95_mm": "p95"}
_OPEN_VIEWS = 4  # whose normals and classes are unfolded from the start


def write_report(inputs: ReportInputs) -> str:
    """The whole page. Sections without anything to show are left out."""
    views = [view_pictures(view) for view in inputs.views]
    sections = {
        "Distances": ("", _distances(inputs)),
        "Views": ("", _views(views, inputs.class_names)),
        "Optimisation": ("", _optimisation(inputs.registration)),
        "Provenance": ("", _provenance(inputs)),
    }
    footer = (
        "Distances are unsigned; nothing is aligned or scaled before they are taken, and nothing is dropped unless the "
        "table says so."
    )
    title = f"{escape(inputs.subject)} · {escape(inputs.expression)} – registration"
    return document(title, _header(inputs) + sectioned(sections, footer=footer))


def headline(registration: Registration) -> str:
    """The result in one or two plain sentences."""
    opening = {
        "converged": "The registration converged",
        "stopped": "The registration was stopped before it converged",
        "failed": "The registration failed",
    }[registration.status]
    sentence = f"{opening}: {registration.reason}." if registration.reason else f"{opening}."
    face = registration.figures.get("scan_to_mesh", {}).get("face", {})
    if face.get("mean_mm") is None:
        return f"{sentence} There is no scan of the face to measure it against."
    return (
        f"{sentence} On the face the scan lies {_mm(face['mean_mm'])} mm from the mesh on average; "
        f"half of its points are within {_mm(face['median_mm'])} mm and 95 % within {_mm(face['p95_mm'])} mm."
    )


def remarks(registration: Registration) -> list[str]:
    """What a person should know beside the headline: views left out, landmarks left out, parts too deep in others."""
    figures = registration.figures
    found = [f"View {view} hardly counts: {why}." for view, why in figures.get("views_not_trusted", {}).items()]
    found += [f"{note[:1].upper()}{note[1:]}." for note in figures.get("notes", [])]
    for pair, row in figures.get("intersections", {}).get("pairs", {}).items():
        count = sum(value for name, value in row.items() if name.startswith("vertices_beyond"))
        if count:
            deepest = _mm(row["max_excess_mm"])
            found.append(f"{pair.capitalize()}: {count} vertices deeper than in the template, by up to {deepest} mm.")
    return found


def _header(inputs: ReportInputs) -> str:
    registration = inputs.registration
    lines = "".join(f"<li>{escape(remark)}</li>" for remark in remarks(registration))
    told = f"<ul>{lines}</ul>" if lines else ""
    return (
        '<header><div class="top"><div class="eyebrow">Head registration</div>'
        f"<h1>{escape(inputs.subject)} <span>{escape(inputs.expression)}</span>"
        f'<span class="badge {registration.status}" style="color:#fff">{registration.status}</span></h1>'
        f'<p class="lead">{escape(headline(registration))}</p>{told}{_tiles(inputs)}</div></header>'
    )


def _tiles(inputs: ReportInputs) -> str:
    figures, seconds = inputs.registration.figures, inputs.registration.seconds
    wanted = [
        ("scan_to_mesh", "face", "mean_mm", "scan to mesh, face, mean"),
        ("scan_to_mesh", "face", "median_mm", "scan to mesh, face, median"),
        ("scan_to_mesh", "face", "p95_mm", "scan to mesh, face, 95th percentile"),
        ("scan_to_mesh", "seen", "mean_mm", "scan to mesh, all that was seen, mean"),
        ("vertex_error", "face", "mean_mm", "vertex error against the truth, mean"),
        ("drift", "face", "mean_mm", "drift from the neutral, mean"),
    ]
    tiles = []
    for key, where, statistic, label in wanted:
        value = figures.get(key, {}).get(where, {}).get(statistic)
        if value is not None:
            tiles.append((f"{_mm(value)} <small>mm</small>", label))
    if seconds:
        tiles.append((_duration(sum(seconds.values())), f"in {len(seconds)} stages"))
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles)
    return f'<div class="tiles">{cells}</div>' if tiles else ""


def _distances(inputs: ReportInputs) -> str:
    table = _figure_table(inputs.registration.figures)
    picture = _heat(inputs.heat_map) if inputs.heat_map else ""
    return picture + (f'<div class="panel" style="margin-top:16px">{table}</div>' if table else "")


def _heat(heat: HeatMap) -> str:
    limit = scale_limit_mm(heat.distance_mm)
    sides = "".join(_figure(picture, side, side) for side, picture in heat_pictures(heat, limit))
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    return (
        "<p>How far the registered surface lies from the scan, drawn on the registered mesh. Grey was not measured: "
        "fewer than two cameras see it.</p>"
        f'<div class="panel"><div class="sides">{sides}</div><div class="bar"><span>0 mm</span>'
        f'<i style="background:linear-gradient(90deg, {stops})"></i><span>{limit:g} mm and more</span>'
        f'<em><span class="swatch" style="background:rgb{UNMEASURED}"></span>not measured</em></div></div>'
    )


def _figure_table(figures: Mapping[str, Any]) -> str:
    rows = []
    for key, name in FIGURES.items():
        for where, row in figures.get(key, {}).items():
            cells = "".join(f'<td class="num">{_mm(row[statistic])}</td>' for statistic in STATISTICS)
            note = ", ".join(
                f"{100 * row[field]:.1f} % dropped for {why}"
                for field, why in (("dropped_normals", "normals"), ("dropped_boundary", "the mesh's boundary"))
                if row.get(field)
            )
            rows.append(
                f'<tr><td>{name}</td><td>{escape(where)}</td><td class="num">{row["points"]:,}</td>{cells}'
                f'<td class="note">{note}</td></tr>'
            )
    if not rows:
        return ""
    heads = "".join(f'<th class="num">{name}</th>' for name in ("points", *STATISTICS.values()))
    return f"<table><tr><th>mm</th><th>where</th>{heads}<th></th></tr>{''.join(rows)}</table>"


def _views(views: list[ViewPictures], class_names: tuple[str, ...]) -> str:
    if not views:
        return ""
    legend = "".join(
        f'<span class="swatch" style="background:rgb{CLASS_COLOURS[k % len(CLASS_COLOURS)]}"></span>{escape(name)}'
        for k, name in enumerate(class_names)
    )
    stops = ", ".join(f"rgb{colour}" for colour in SCALE)
    cards = "".join(_card(view, opened=k < _OPEN_VIEWS) for k, view in enumerate(views))
    return (
        "<p>What each camera saw, what the registration looks like from there, and where the two differ. "
        "Click a picture to enlarge it.</p>"
        '<div class="hint wide">Differences: <span class="ramp" '
        f'style="background:linear-gradient(90deg, {stops})"></span> none to large'
        f"{' &nbsp; &nbsp; Classes:' + legend if legend else ''}</div>"
        f'<div class="views">{cards}</div>'
    )


def _card(view: ViewPictures, opened: bool) -> str:
    chips = " · ".join(f"{name} <b>{value}</b>" for name, value in view.numbers.items())
    triples = [
        '<div class="triple">'
        + "".join(_figure(picture, caption, f"{view.name}: {row.lower()}, {caption}") for caption, picture in pictures)
        + "</div>"
        for row, pictures in view.rows.items()
    ]
    rest = "".join(triples[1:])
    names = " and ".join(row.lower() for row in list(view.rows)[1:])
    folded = f"<details{' open' if opened else ''}><summary>{names}</summary>{rest}</details>" if rest else ""
    return (
        f'<article class="panel view"><header><h3>{escape(view.name)}</h3><span class="chips">{chips}</span></header>'
        f"{triples[0]}{folded}</article>"
    )


def _optimisation(registration: Registration) -> str:
    curves = loss_curves(registration.history)
    drawn = f'<div class="panel">{curves}</div>' if curves else ""
    longest = max(registration.seconds.values(), default=0.0) or 1.0
    bars = "".join(
        f'<span>{escape(stage)}</span><i style="width:{100 * value / longest:.1f}%"></i><span>{_duration(value)}</span>'
        for stage, value in registration.seconds.items()
    )
    times = f'<div class="panel" style="margin-top:16px"><div class="times">{bars}</div></div>' if bars else ""
    if not (drawn or times):
        return ""
    return f"<p>Every loss term over the steps of each stage, and how long the stages took.</p>{drawn}{times}"


def _provenance(inputs: ReportInputs) -> str:
    registration = inputs.registration
    config = escape(json.dumps(to_jsonable(registration.config), indent=2))
    parts = []
    if registration.config:
        parts.append(f"<details class=panel><summary>Resolved configuration</summary><pre>{config}</pre></details>")
    for title, rows in (("Inputs, sha256", registration.inputs), ("Versions", inputs.versions)):
        if rows:
            parts.append(f"<details class=panel><summary>{title}</summary>{_pairs(rows.items())}</details>")
    return "<p>All that is needed to make this result again.</p>" + "".join(parts) if parts else ""


def _pairs(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f'<tr><td>{escape(a)}</td><td class="mono">{escape(str(b))}</td></tr>' for a, b in rows)
    return f'<table style="margin-top:10px">{cells}</table>'


def _figure(picture: Picture, caption: str, description: str) -> str:
    return (
        f'<figure><img class="zoom" loading="lazy" alt="{escape(description)}" src="{data_uri(picture)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}" if value < 1 else f"{value:.2f}"


def _duration(seconds: float) -> str:
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{int(seconds // 60)} min {seconds % 60:.0f} s"
