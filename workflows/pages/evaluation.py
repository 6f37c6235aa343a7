"""The HTML page of an evaluation of models: self-contained."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from coregister.evaluate.evaluation import Curve, MetricRow, ModelEvaluation
from registration.model.gnm_npz import GNMData
from registration.report.charts import ChartLine, line_charts
from registration.report.heat_map import scale_limit_mm
from registration.report.inputs import HeatMap
from workflows.pages.base import heat_images, render


def render_evaluation_page(
    evaluation: ModelEvaluation, models: Mapping[str, GNMData], manifest: Mapping[str, Any]
) -> str:
    """Return the page: curves, gains, tables and maps of the distance."""
    limit_mm = max(scale_limit_mm(metrics.vertex_mm) for metrics in evaluation.models.values())
    return render(
        "evaluation.html",
        evaluation=evaluation,
        manifest=manifest,
        components=evaluation.settings.components[-1],
        unconverged=sum(metrics.unconverged for metrics in evaluation.models.values()),
        tiles=_tiles(evaluation),
        generalization=Markup(line_charts(_generalization(evaluation), "components")),
        specificity=Markup(line_charts(_specificity(evaluation), "components")),
        heat_maps=_heat_maps(evaluation, models, limit_mm),
        limit_mm=limit_mm,
        metrics=_metrics(evaluation),
    )


def _tiles(evaluation: ModelEvaluation) -> list[tuple[str, str, str]]:
    components = evaluation.settings.components[-1]
    tiles = []
    for name, metrics in evaluation.models.items():
        mean = float(metrics.identity.at_components(components).mean())
        tiles.append((f"{mean:.2f}", "mm", f"{name}: generalization, {components} components"))
        if metrics.specificity is not None:
            random = float(metrics.specificity.at_components(components).mean())
            tiles.append((f"{random:.2f}", "mm", f"{name}: specificity, {components} components"))
    for gain in evaluation.gains:
        if gain.components == components:
            tiles.append((f"{100 * gain.gain.mean:.0f}", "%", f"{gain.model}: reduction against the first model"))
    return tiles


def _generalization(evaluation: ModelEvaluation) -> dict[str, list[ChartLine]]:
    panels: dict[str, list[ChartLine]] = {"identity, mm": [], "identity, scan to surface, mm": []}
    for name, metrics in evaluation.models.items():
        panels["identity, mm"].append(_line(name, metrics.identity))
        if metrics.scans is not None:
            panels["identity, scan to surface, mm"].append(_line(name, metrics.scans))
        for region, curve in metrics.expressions.items():
            panels.setdefault(f"expression, {_words(region)}, mm", []).append(_line(name, curve))
    return panels


def _specificity(evaluation: ModelEvaluation) -> dict[str, list[ChartLine]]:
    panels: dict[str, list[ChartLine]] = {"specificity, mm": []}
    for name, metrics in evaluation.models.items():
        if metrics.specificity is not None:
            panels["specificity, mm"].append(_line(name, metrics.specificity))
        for part, compact in metrics.compactness.items():
            numbers = range(1, len(compact.share) + 1)
            percent = [100 * share for share in compact.share]
            panels.setdefault(f"variance, {_words(part)}, %", []).append(ChartLine(name=name, x=numbers, y=percent))
    return panels


def _line(name: str, curve: Curve) -> ChartLine:
    return ChartLine(
        name=name,
        x=curve.components,
        y=[interval.mean for interval in curve.intervals],
        low=[interval.low for interval in curve.intervals],
        high=[interval.high for interval in curve.intervals],
    )


def _heat_maps(
    evaluation: ModelEvaluation, models: Mapping[str, GNMData], limit_mm: float
) -> dict[str, list[tuple[str, str]]]:
    maps = {}
    for name, metrics in evaluation.models.items():
        heat = HeatMap(
            vertices=models[name].template_vertex_positions.astype(np.float32),
            triangles=models[name].triangles,
            distance_mm=metrics.vertex_mm,
            T_head_world=np.eye(4),
        )
        maps[name] = heat_images(heat, limit_mm)
    return maps


def _metrics(evaluation: ModelEvaluation) -> dict[str, dict[str, dict[str, MetricRow]]]:
    """Kind -> name -> model -> row."""
    tables: dict[str, dict[str, dict[str, MetricRow]]] = {}
    for model, metrics in evaluation.models.items():
        for row in metrics.rows:
            tables.setdefault(row.kind, {}).setdefault(row.name, {})[model] = row
    return tables


def _words(name: str) -> str:
    return name.replace("_", " ")
