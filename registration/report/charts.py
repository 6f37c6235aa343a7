"""Charts as SVG inside a page: loss curves of an optimization, and metrics as functions of a number."""

import io
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

INK, FAINT = "#2b2f36", "#d9d9d4"
LINES = ("#1f77b4", "#d1495b", "#2a9d8f", "#e9a23b", "#6a4c93", "#8c6d46", "#4c956c", "#b56576", "#5c677d", "#9a031e")
_PANELS = 3  # side by side


def loss_curves(history: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """Draw the loss terms over the steps, one panel per stage, with a logarithmic axis.

    Args:
        history: values of each term in each stage. Values that are not positive and finite leave gaps.

    Returns:
        An `<svg>` element; empty if there are no values.
    """
    stages = {name: terms for name, terms in history.items() if any(len(values) for values in terms.values())}
    if not stages:
        return ""
    names = list(dict.fromkeys(term for terms in stages.values() for term in terms))
    colours = {term: LINES[k % len(LINES)] for k, term in enumerate(names)}
    rows, columns = math.ceil(len(stages) / _PANELS), min(len(stages), _PANELS)
    with _style():
        figure = Figure(figsize=(11.4, 2.9 * rows + 0.5), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (stage, terms) in zip(panels, stages.items(), strict=False):
            for term, values in terms.items():
                clean = [v if v is not None and math.isfinite(v) and v > 0 else math.nan for v in values]
                panel.plot(range(1, len(clean) + 1), clean, color=colours[term], lw=1.4, label=term)
            _scale_by_powers(panel)
            _dress(panel, stage, "step")
        for panel in panels[len(stages) :]:
            panel.set_visible(False)
        return _drawn(figure, colours)


@dataclass(frozen=True, kw_only=True)
class Line:
    """Values as a function of a number, with a confidence band; None where the band is unknown."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()


def number_curves(panels: Mapping[str, Sequence[Line]], x_name: str) -> str:
    """Draw lines over a number, one panel per title, with axes that begin at zero.

    Args:
        panels: lines by the title of their panel. Lines of one name have one colour.
        x_name: label of the horizontal axes.

    Returns:
        An `<svg>` element; empty if there are no lines.
    """
    panels = {title: lines for title, lines in panels.items() if lines}
    if not panels:
        return ""
    names = list(dict.fromkeys(line.name for lines in panels.values() for line in lines))
    colours = {name: LINES[k % len(LINES)] for k, name in enumerate(names)}
    rows, columns = math.ceil(len(panels) / _PANELS), min(len(panels), _PANELS)
    with _style():
        figure = Figure(figsize=(11.4, 2.9 * rows + 0.5), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, lines) in zip(axes, panels.items(), strict=False):
            for line in lines:
                panel.plot(line.x, line.y, color=colours[line.name], lw=1.6, marker="o", ms=3.5)
                known = [k for k, low in enumerate(line.low) if low is not None]
                low, high = ([float(side[k] or 0) for k in known] for side in (line.low, line.high))
                panel.fill_between([line.x[k] for k in known], low, high, color=colours[line.name], alpha=0.15, lw=0)
            panel.set_ylim(bottom=0)
            _dress(panel, title, x_name)
        for panel in axes[len(panels) :]:
            panel.set_visible(False)
        return _drawn(figure, colours)


def _style() -> AbstractContextManager[None]:
    return matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "report", "font.family": "sans-serif"})


def _drawn(figure: Figure, colours: Mapping[str, str]) -> str:
    """Render a figure with its legend below as SVG."""
    handles = [Line2D([], [], color=colour, lw=2.4) for colour in colours.values()]
    columns = min(len(colours), 8)
    figure.legend(handles, list(colours), loc="outside lower left", ncols=columns, fontsize=9, frameon=False)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = buffer.getvalue()
    return drawing[drawing.index("<svg") :]


def _scale_by_powers(panel: Axes) -> None:
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())
    if high < 100 * low:
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))


def _dress(panel: Axes, title: str, x_name: str) -> None:
    panel.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    panel.set_xlabel(x_name, fontsize=9, color=INK)
    panel.tick_params(labelsize=8.5, colors=INK, which="both", length=0)
    panel.grid(axis="y", color=FAINT, lw=0.7)
    panel.margins(x=0.01)
    for name, spine in panel.spines.items():
        spine.set_visible(name == "bottom")
        spine.set_color(FAINT)
