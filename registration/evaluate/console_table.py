"""Figures as a table on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

NAMES = {
    "scan_to_mesh": "scan to mesh",
    "scan_to_mesh_by_area": "scan to mesh, by area",
    "mesh_to_scan": "mesh to scan",
    "vertex_error": "vertex error",
    "drift": "drift",
}


def print_figures(figures: Mapping[str, Any], title: str, console: Console | None = None) -> None:
    """Print every figure that has a mean; millimetres."""
    table = Table(title=title, caption="millimetres")
    for name in ("figure", "where"):
        table.add_column(name)
    for name in ("points", "mean", "median", "std", "p95"):
        table.add_column(name, justify="right")
    for key, name in NAMES.items():
        for where, row in figures.get(key, {}).items():
            values = [row[field] for field in ("mean_mm", "median_mm", "std_mm", "p95_mm")]
            table.add_row(name, where, f"{row['points']:,}", *("-" if v is None else f"{v:.3f}" for v in values))
    (console or Console()).print(table)


def print_audit(figures: Mapping[str, Any], title: str, console: Console | None = None) -> None:
    """Print an audit's figures (`Audit.figures`), one pair of parts a row."""
    beyond = next(name for name in figures if name.startswith("vertices_beyond_"))
    limit = beyond.removeprefix("vertices_beyond_").replace("mm", " mm")
    table = Table(title=title, caption=f"{figures[beyond]} vertices deeper than in the template by more than {limit}")
    table.add_column("one part in another", no_wrap=True)
    for name in ("in the template", "deepest, mm", f"> {limit} deeper", "most, mm"):
        table.add_column(name, justify="right")
    for name, row in figures["pairs"].items():
        baseline = f"{row['template_vertices']:,}", f"{row['template_max_mm']:.2f}"
        table.add_row(name, *baseline, f"{row[beyond]:,}", f"{row['max_excess_mm']:.2f}")
    (console or Console()).print(table)
