"""Line charts as inline SVG: metrics against a number of components."""

import io
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from registration.report.colours import GRID_COLOUR, LINE_COLOURS, TEXT_COLOUR

_COLUMNS = 3  # panels in a row
_DOTTED = 60  # values of a line, above which they get no dots


@dataclass(frozen=True, kw_only=True)
class ChartLine:
    """A line of a chart, with a confidence band."""

    name: str  # in the legend
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float | None] = ()  # bounds of the band; None where there is none
    high: Sequence[float | None] = ()


def line_charts(panels: Mapping[str, Sequence[ChartLine]], x_label: str, *, from_zero: bool = True) -> str:
    """Plot lines with their confidence bands, one panel per title.

    Lines of one name have the same colour in all panels.

    Args:
        panels: title -> lines; panels without lines are omitted.
        x_label: of the horizontal axis of all panels.
        from_zero: the vertical axes start at zero.

    Returns:
        An SVG element; empty without any line.
    """
    panels = {title: lines for title, lines in panels.items() if lines}
    if not panels:
        return ""
    names = list(dict.fromkeys(line.name for lines in panels.values() for line in lines))
    colours = {name: LINE_COLOURS[k % len(LINE_COLOURS)] for k, name in enumerate(names)}
    rows, columns = math.ceil(len(panels) / _COLUMNS), min(len(panels), _COLUMNS)
    with chart_style():
        figure = Figure(figsize=(11.4, 2.9 * rows + 0.5), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, lines) in zip(axes, panels.items(), strict=False):
            for line in lines:
                dots = {"marker": "o", "ms": 3.5} if len(line.x) <= _DOTTED else {}
                panel.plot(line.x, line.y, color=colours[line.name], lw=1.6, **dots)
                with_band = [k for k, low in enumerate(line.low) if low is not None]
                low, high = ([float(side[k] or 0) for k in with_band] for side in (line.low, line.high))
                band_x = [line.x[k] for k in with_band]
                panel.fill_between(band_x, low, high, color=colours[line.name], alpha=0.15, lw=0)
            if from_zero:
                panel.set_ylim(bottom=0)
            style_axes(panel, title, x_label)
        for panel in axes[len(panels) :]:
            panel.set_visible(False)
        return to_svg(figure, colours)


def chart_style() -> AbstractContextManager[None]:
    """Return the context in which charts are drawn: the same bytes in every run, text as text."""
    return matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "report", "font.family": "sans-serif"})


def to_svg(figure: Figure, colours: Mapping[str, str]) -> str:
    """Return the figure with its legend below it, as an SVG element."""
    handles = [Line2D([], [], color=colour, lw=2.4) for colour in colours.values()]
    columns = min(len(colours), 8)
    figure.legend(handles, list(colours), loc="outside lower left", ncols=columns, fontsize=9, frameon=False)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    return svg[svg.index("<svg") :]


def style_axes(panel: Axes, title: str, x_label: str) -> None:
    """Give a panel its title, the label of its horizontal axis and the report's plain look."""
    panel.set_title(title, loc="left", fontsize=10.5, color=TEXT_COLOUR, fontweight="bold")
    panel.set_xlabel(x_label, fontsize=9, color=TEXT_COLOUR)
    panel.tick_params(labelsize=8.5, colors=TEXT_COLOUR, which="both", length=0)
    panel.grid(axis="y", color=GRID_COLOUR, lw=0.7)
    panel.margins(x=0.01)
    for name, spine in panel.spines.items():
        spine.set_visible(name == "bottom")
        spine.set_color(GRID_COLOUR)
