"""The HTML page of a comparison of models on the face, with the figures of [GNM, Intrinsic Evaluation of GNM]."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from coregister.evaluate.face_data import FACE, FaceReference
from coregister.evaluate.face_numbers import FaceComparison
from coregister.evaluate.face_protocol import STAGES, ProtocolSettings
from coregister.evaluate.face_tables import DENSITY_EDGES_MM
from registration.report.bars import Bars, bar_charts
from registration.report.charts import ChartLine, line_charts
from registration.report.heat_map import scale_limit_mm
from registration.report.inputs import HeatMap
from workflows.pages.base import heat_images, render

PAPER = (  # [GNM, Generalization to Novel Shapes]: mean, median, standard deviation on 15,000 scans, mm
    ("GNM, 15,000 scans of the paper", 0.748, 0.623, 0.529),
    ("FLAME, the same scans", 0.971, 0.780, 0.734),
    ("FLAME without jaw joint, the same scans", 0.968, 0.779, 0.729),
)
_LAST = STAGES[-1]


def render_comparison_page(
    comparison: FaceComparison, reference: FaceReference, manifest: Mapping[str, Any], settings: ProtocolSettings
) -> str:
    """Return the page: the table, errors by region and group, their density, maps, and the intrinsic curves."""
    limit_mm = max(scale_limit_mm(values) for values in comparison.vertex_mm.values())
    centres = (DENSITY_EDGES_MM[:-1] + DENSITY_EDGES_MM[1:]) / 2
    width = DENSITY_EDGES_MM[1] - DENSITY_EDGES_MM[0]
    densities = [
        ChartLine(name=d.model, x=centres.tolist(), y=(d.share / width).tolist())
        for d in comparison.densities
        if d.stage == _LAST
    ]
    return render(
        "comparison.html",
        comparison=comparison,
        manifest=manifest,
        settings=settings,
        paper=PAPER,
        regions=Markup(bar_charts({"distance by region, mm": _bars(comparison, "region")})),
        density=Markup(line_charts({"density of the distances, 1/mm": densities}, "mm")),
        groups=Markup(bar_charts({f"by {kind}, mm": _bars(comparison, kind) for kind in _kinds(comparison)})),
        curves=Markup(line_charts(_curves(comparison), "components")),
        heat_maps=_heat_maps(comparison, reference, limit_mm),
        limit_mm=limit_mm,
        stages=STAGES,
        grouped=[row for row in comparison.rows if row.kind != FACE],
    )


def _kinds(comparison: FaceComparison) -> list[str]:
    return [k for k in dict.fromkeys(row.kind for row in comparison.rows) if k not in ("face", "region")]


def _bars(comparison: FaceComparison, kind: str) -> list[Bars]:
    series = []
    for model in comparison.models:
        rows = [row for row in comparison.rows if (row.model, row.stage, row.kind) == (model, _LAST, kind)]
        series.append(
            Bars(
                name=model,
                groups=[row.name.replace("_", " ") for row in rows],
                values=[row.mean.mean for row in rows],
                low=[row.mean.low for row in rows],
                high=[row.mean.high for row in rows],
            )
        )
    return series


def _curves(comparison: FaceComparison) -> dict[str, list[ChartLine]]:
    panels: dict[str, list[ChartLine]] = {}
    for curve in comparison.curves:
        line = ChartLine(
            name=curve.model,
            x=curve.components,
            y=[interval.mean for interval in curve.intervals],
            low=[interval.low for interval in curve.intervals],
            high=[interval.high for interval in curve.intervals],
        )
        panels.setdefault(f"generalization, {curve.part.replace('_', ' ')}, mm", []).append(line)
    for model, counts in comparison.specificity_mm.items():
        if counts:
            line = ChartLine(name=model, x=[k for k, _ in counts], y=[interval.mean for _, interval in counts])
            panels.setdefault("specificity, mm", []).append(line)
    for model, parts in comparison.compactness_mm.items():
        identity = parts["identity"]
        if len(identity):
            share = 100 * identity**2 / identity[-1] ** 2
            line = ChartLine(name=model, x=range(1, len(share) + 1), y=share.tolist())
            panels.setdefault("compactness, identity, % of variance", []).append(line)
    return panels


def _heat_maps(
    comparison: FaceComparison, reference: FaceReference, limit_mm: float
) -> dict[str, list[tuple[str, str]]]:
    maps = {}
    for name, distance in comparison.vertex_mm.items():
        heat = HeatMap(
            vertices=reference.template.astype(np.float32),
            triangles=reference.triangles,
            distance_mm=distance,
            T_head_world=np.eye(4),
        )
        maps[name] = heat_images(heat, limit_mm)
    return maps
