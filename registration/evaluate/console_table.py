"""Metrics of a registration as tables on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

METRIC_TITLES = {
    "scan_to_mesh": "scan to mesh",
    "scan_to_mesh_by_area": "scan to mesh, by area",
    "mesh_to_scan": "mesh to scan",
    "vertex_error": "vertex error",
    "drift": "drift",
}


def print_metrics(metrics: Mapping[str, Any], title: str, console: Console | None = None) -> None:
    """Print the distance statistics, one metric and region per row, in millimetres.

    Args:
        metrics: `RegistrationEvaluation.metrics`, or the `figures` of a manifest; other entries are ignored.
        title: of the table.
        console: default: the terminal.
    """
    table = Table(title=title, caption="millimetres")
    for heading in ("metric", "region"):
        table.add_column(heading)
    for heading in ("points", "mean", "median", "std", "p95"):
        table.add_column(heading, justify="right")
    for key, metric_title in METRIC_TITLES.items():
        for region, row in metrics.get(key, {}).items():
            values = [row[field] for field in ("mean_mm", "median_mm", "std_mm", "p95_mm")]
            cells = ("-" if value is None else f"{value:.3f}" for value in values)
            table.add_row(metric_title, region, f"{row['points']:,}", *cells)
    (console or Console()).print(table)


def print_audit(metrics: Mapping[str, Any], title: str, console: Console | None = None) -> None:
    """Print a penetration audit, one pair of parts per row.

    Args:
        metrics: `PenetrationAudit.metrics`, or the `intersections` among the `figures` of a manifest.
        title: of the table.
        console: default: the terminal.
    """
    beyond_key = next(key for key in metrics if key.startswith("vertices_beyond_"))
    tolerance = beyond_key.removeprefix("vertices_beyond_").replace("mm", " mm")
    caption = f"{metrics[beyond_key]} vertices deeper than in the template by more than {tolerance}"
    table = Table(title=title, caption=caption)
    table.add_column("one part in another", no_wrap=True)
    for heading in ("vertices in the template", "max depth, mm", f"> {tolerance} deeper", "max excess, mm"):
        table.add_column(heading, justify="right")
    for name, row in metrics["pairs"].items():
        baseline = f"{row['template_vertices']:,}", f"{row['template_max_mm']:.2f}"
        table.add_row(name, *baseline, f"{row[beyond_key]:,}", f"{row['max_excess_mm']:.2f}")
    (console or Console()).print(table)
