"""Figures of a registration as tables on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from registration import terminal
from registration.evaluate.names import LEVEL_TITLES
from registration.evaluate.residuals import residual_rows
from registration.types import METRIC_TITLES


def print_metrics(metrics: Mapping[str, Any], title: str, console: Console | None = None) -> None:
    """Print the distance statistics, one metric and region per row, in millimetres, and why others are missing.

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
    console = console or terminal.console()
    console.print(table)
    for key, reason in metrics.get("unmeasured", {}).items():
        console.print(f"{METRIC_TITLES[key]}: not measured: {reason}", markup=False, highlight=False, soft_wrap=True)


def print_assessment(figures: Mapping[str, Any], console: Console | None = None) -> None:
    """Print what the images say about a registration, a residual per row, and the verdict with its reasons.

    Args:
        figures: of a registration's manifest; what is missing is not printed.
        console: default: the terminal.
    """
    console = console or terminal.console()
    rows = residual_rows(figures.get("residuals", {}))
    if rows:
        table = Table(title="residuals in the images", caption="pixels at a head height of 512 px")
        for heading in ("", "overall", "worst view", ""):
            table.add_column(heading, justify="left" if heading == "" else "right")
        for kind, overall, worst, view in rows:
            unknown = "-" if overall is None else kind.text(overall)
            table.add_row(kind.title, unknown, kind.text(worst), Text(view))
        console.print(table)
    if verdict := figures.get("verdict"):
        reasons = "; ".join(verdict["reasons"])
        console.print(
            f"verdict: {LEVEL_TITLES[verdict['level']]}: {reasons}", markup=False, highlight=False, soft_wrap=True
        )
