"""The HTML page of one registration: self-contained, no external resources."""

import json
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from registration.report.charts import loss_curves
from registration.report.heat_map import render_heat_map, scale_limit_mm
from registration.report.inputs import ReportInputs, ReportView
from registration.report.pictures import CLASS_COLOURS, data_uri, view_images
from registration.report.templates import environment
from registration.storage.hashing import to_jsonable
from registration.types import METRIC_TITLES, Registration

STATISTICS = {"mean_mm": "mean", "median_mm": "median", "std_mm": "std", "p95_mm": "p95"}
_OPEN_VIEWS = 4  # whose normals and classes are unfolded at first


def render_report(inputs: ReportInputs) -> str:
    """Return the HTML page of a registration; sections without content are omitted.

    Args:
        inputs: all contents. Text from captures and manifests is escaped.
    """
    registration, heat = inputs.registration, inputs.heat_map
    limit_mm = scale_limit_mm(heat.distance_mm) if heat else 0.0
    longest_s = max(registration.seconds.values(), default=0.0) or 1.0
    template = environment().get_template("report.html")
    return template.render(
        subject=inputs.subject,
        expression=inputs.expression,
        status=registration.status,
        headline=headline(registration),
        remarks=remarks(registration),
        tiles=_tiles(registration),
        limit_mm=limit_mm,
        heat_images=[(side, data_uri(image)) for side, image in render_heat_map(heat, limit_mm)] if heat else [],
        distance_heads=("points", *STATISTICS.values()),
        distance_rows=_distance_rows(registration.figures),
        views=[_view(view) for view in inputs.views],
        open_views=_OPEN_VIEWS,
        legend=[(name, CLASS_COLOURS[k % len(CLASS_COLOURS)]) for k, name in enumerate(inputs.class_names)],
        curves=Markup(loss_curves(registration.history)),
        times=[(stage, 100 * value / longest_s, _duration(value)) for stage, value in registration.seconds.items()],
        config=json.dumps(to_jsonable(registration.config), indent=2) if registration.config else "",
        inputs=registration.inputs,
        versions=inputs.versions,
    )


def headline(registration: Registration) -> str:
    """Return the result in one or two sentences."""
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
    """Return remarks besides the headline: views with low weights, excluded landmarks, intersecting parts."""
    figures = registration.figures
    lines = [f"View {view} has a low weight: {why}." for view, why in figures.get("views_not_trusted", {}).items()]
    lines += [f"{note[:1].upper()}{note[1:]}." for note in figures.get("notes", [])]
    for pair, row in figures.get("intersections", {}).get("pairs", {}).items():
        count = sum(value for name, value in row.items() if name.startswith("vertices_beyond"))
        if count:
            deepest = _mm(row["max_excess_mm"])
            lines.append(f"{pair.capitalize()}: {count} vertices deeper than in the template, by up to {deepest} mm.")
    return lines


def _tiles(registration: Registration) -> list[tuple[str, str, str]]:
    metrics, seconds = registration.figures, registration.seconds
    shown = [
        ("scan_to_mesh", "face", "mean_mm", "scan to mesh, face, mean"),
        ("scan_to_mesh", "face", "median_mm", "scan to mesh, face, median"),
        ("scan_to_mesh", "face", "p95_mm", "scan to mesh, face, 95th percentile"),
        ("scan_to_mesh", "seen", "mean_mm", "scan to mesh, all visible parts, mean"),
        ("vertex_error", "face", "mean_mm", "vertex error against the ground truth, mean"),
        ("drift", "face", "mean_mm", "drift from the neutral, mean"),
    ]
    tiles = []
    for key, region, statistic, label in shown:
        value = metrics.get(key, {}).get(region, {}).get(statistic)
        if value is not None:
            tiles.append((_mm(value), "mm", label))
    if seconds:
        tiles.append((_duration(sum(seconds.values())), "", f"in {len(seconds)} stages"))
    return tiles


def _distance_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for key, title in METRIC_TITLES.items():
        for region, row in metrics.get(key, {}).items():
            note = ", ".join(
                f"{100 * row[field]:.1f} % excluded by {reason}"
                for field, reason in (("dropped_normals", "normals"), ("dropped_boundary", "the mesh's boundary"))
                if row.get(field)
            )
            statistics = [_mm(row[statistic]) for statistic in STATISTICS]
            rows.append(
                {
                    "title": title,
                    "region": region,
                    "points": f"{row['points']:,}",
                    "statistics": statistics,
                    "note": note,
                }
            )
    return rows


def _view(view: ReportView) -> dict[str, Any]:
    images = view_images(view)
    rows = {row: [(caption, data_uri(image)) for caption, image in captioned] for row, captioned in images.rows.items()}
    return {"name": images.name, "numbers": images.numbers, "rows": rows}


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}" if value < 1 else f"{value:.2f}"


def _duration(seconds: float) -> str:
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{int(seconds // 60)} min {seconds % 60:.0f} s"
