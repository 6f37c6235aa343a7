"""Bar charts as inline SVG: one value per group and series, with its interval."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from registration.report.charts import chart_style, style_axes, to_svg
from registration.report.colours import LINE_COLOURS, TEXT_COLOUR

_COLUMNS = 2  # panels in a row
_LEVEL = 5  # groups, above which their names are turned
_WIDTH = 0.8  # of all bars of a group


@dataclass(frozen=True, kw_only=True)
class Bars:
    """One series of a bar chart."""

    name: str  # in the legend
    groups: Sequence[str]
    values: Sequence[float]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()


def bar_charts(panels: Mapping[str, Sequence[Bars]]) -> str:
    """Plot bars by group, one panel per title; a series has the same colour in all panels.

    Args:
        panels: title -> series; groups that a series lacks are left empty.

    Returns:
        An SVG element; empty without any series.
    """
    panels = {title: series for title, series in panels.items() if series}
    if not panels:
        return ""
    names = list(dict.fromkeys(bars.name for series in panels.values() for bars in series))
    colours = {name: LINE_COLOURS[k % len(LINE_COLOURS)] for k, name in enumerate(names)}
    columns = min(len(panels), _COLUMNS)
    rows = math.ceil(len(panels) / columns)
    with chart_style():
        figure = Figure(figsize=(11.4, 3.0 * rows + 0.5), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, series) in zip(axes, panels.items(), strict=False):
            groups = list(dict.fromkeys(group for bars in series for group in bars.groups))
            width = _WIDTH / len(series)
            for number, bars in enumerate(series):
                x = np.array([groups.index(group) for group in bars.groups]) + (number - (len(series) - 1) / 2) * width
                panel.bar(x, bars.values, 0.92 * width, color=colours[bars.name])
                for place, low, high in zip(x, bars.low, bars.high, strict=True):
                    if low is not None and high is not None:
                        panel.plot([place, place], [low, high], color=TEXT_COLOUR, lw=1)
            style_axes(panel, title, "")
            many = len(groups) > _LEVEL
            panel.set_xticks(range(len(groups)), groups, rotation=30 if many else 0, ha="right" if many else "center")
        for panel in axes[len(panels) :]:
            panel.set_visible(False)
        return to_svg(figure, colours)
