"""Metrics of a registration as tables on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from registration.types import METRIC_TITLES


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
