"""The HTML page of one registration: self-contained, no external resources."""

import json
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from registration.evaluate.residuals import RESIDUALS, residual_rows
from registration.evaluate.verdict import LEVEL_TITLES, judge
from registration.report.charts import loss_curves
from registration.report.heat_map import render_heat_map, scale_limit_mm
from registration.report.inputs import ReportInputs
from registration.report.pictures import CLASS_COLOURS, ViewImages, data_uri, view_images
from registration.report.remarks import format_mm, headline, remarks
from registration.report.templates import environment
from registration.storage.hashing import to_jsonable
from registration.types import METRIC_TITLES, Registration

STATISTICS = {"mean_mm": "mean", "median_mm": "median", "std_mm": "std", "p95_mm": "p95"}
_OPEN_VIEWS = 4  # whose normals and classes are unfolded at first
_THUMBNAIL_QUALITY = 75  # of their JPEGs


def render_report(inputs: ReportInputs) -> str:
    """Return the HTML page of a registration; sections without content are omitted.

    Args:
        inputs: all contents. Text from captures and manifests is escaped.
    """
    registration, heat = inputs.registration, inputs.heat_map
    limit_mm = scale_limit_mm(heat.distance_mm) if heat else 0.0
    longest_s = max(registration.seconds.values(), default=0.0) or 1.0
    by_view = registration.figures.get("residuals", {}).get("views", {})
    template = environment().get_template("report.html")
    return template.render(
        subject=inputs.subject,
        expression=inputs.expression,
        status=registration.status,
        headline=headline(registration),
        verdict=_verdict(registration),
        remarks=remarks(registration),
        tiles=_tiles(registration),
        limit_mm=limit_mm,
        heat_images=[(side, data_uri(image)) for side, image in render_heat_map(heat, limit_mm)] if heat else [],
        distance_heads=("points", *STATISTICS.values()),
        distance_rows=_distance_rows(registration.figures),
        residual_rows=_residual_rows(registration.figures.get("residuals", {})),
        views=[_view(view_images(view), by_view.get(view.name, {})) for view in inputs.views],
        thumbnails=[
            _view(view_images(view), by_view.get(view.name, {}), _THUMBNAIL_QUALITY) for view in inputs.thumbnails
        ],
        open_views=_OPEN_VIEWS,
        legend=[(name, CLASS_COLOURS[k % len(CLASS_COLOURS)]) for k, name in enumerate(inputs.class_names)],
        curves=Markup(loss_curves(registration.history)),
        times=[(stage, 100 * value / longest_s, _duration(value)) for stage, value in registration.seconds.items()],
        config=json.dumps(to_jsonable(registration.config), indent=2) if registration.config else "",
        inputs=registration.inputs,
        versions=inputs.versions,
    )


def _verdict(registration: Registration) -> dict[str, Any]:
    """The stored verdict, or that on a registration from before there was one."""
    figure = registration.figures.get("verdict") or judge(registration.status, registration.figures).figure
    return {"level": figure["level"], "title": LEVEL_TITLES[figure["level"]], "reasons": figure["reasons"]}


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
            tiles.append((format_mm(value), "mm", label))
    if not tiles:
        overall = metrics.get("residuals", {}).get("overall", {})
        tiles = [
            (f"{overall[name]:.1f}", kind.unit, f"{kind.title}: {kind.meaning}")
            for name, kind in RESIDUALS.items()
            if name in overall
        ]
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
            statistics = [format_mm(row[statistic]) for statistic in STATISTICS]
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


def _view(images: ViewImages, residuals: Mapping[str, float], quality: int = 86) -> dict[str, Any]:
    """A view's pictures and its residuals as text."""
    rows = {
        row: [(caption, data_uri(image, quality)) for caption, image in captioned]
        for row, captioned in images.rows.items()
    }
    numbers = {kind.title: kind.text(residuals[name]) for name, kind in RESIDUALS.items() if name in residuals}
    return {"name": images.name, "numbers": numbers, "rows": rows}


def _residual_rows(figure: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Kind, overall value, worst value, its view, and the meaning, as text."""
    return [
        (kind.title, "–" if overall is None else kind.text(overall), kind.text(worst), view, kind.meaning)
        for kind, overall, worst, view in residual_rows(figure)
    ]


def _duration(seconds: float) -> str:
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{int(seconds // 60)} min {seconds % 60:.0f} s"
