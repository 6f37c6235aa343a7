"""Charts of how the optimisation went, as SVG inside the page."""

import io
import math
from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

INK, FAINT = "#2b2f36", "#d9d9d4"
LINES = ("#1f77b4", "#d1495b", "#2a9d8f", "#e9a23b", "#6a4c93", "#8c6d46", "#4c956c", "#b56576", "#5c677d", "#9a031e")
_PANELS = 3  # side by side


def loss_curves(history: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """One panel per stage, every term a line over the steps, logarithmic; a term keeps its colour throughout.

    Values that are not positive and finite leave gaps. Empty without any value.
    """
    stages = {name: terms for name, terms in history.items() if any(len(values) for values in terms.values())}
    if not stages:
        return ""
    names = list(dict.fromkeys(term for terms in stages.values() for term in terms))
    colours = {term: LINES[k % len(LINES)] for k, term in enumerate(names)}
    rows, columns = math.ceil(len(stages) / _PANELS), min(len(stages), _PANELS)
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "report", "font.family": "sans-serif"}):
        figure = Figure(figsize=(11.4, 2.9 * rows + 0.5), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (stage, terms) in zip(panels, stages.items(), strict=False):
            for term, values in terms.items():
                clean = [v if v is not None and math.isfinite(v) and v > 0 else math.nan for v in values]
                panel.plot(range(1, len(clean) + 1), clean, color=colours[term], lw=1.4, label=term)
            _dress(panel, stage)
        for panel in panels[len(stages) :]:
            panel.set_visible(False)
        handles = [Line2D([], [], color=colours[term], lw=2.4) for term in names]
        figure.legend(handles, names, loc="outside lower left", ncols=min(len(names), 8), fontsize=9, frameon=False)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = buffer.getvalue()
    return drawing[drawing.index("<svg") :]


def _dress(panel: Axes, stage: str) -> None:
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())
    if high < 100 * low:
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.set_title(stage, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    panel.set_xlabel("step", fontsize=9, color=INK)
    panel.tick_params(labelsize=8.5, colors=INK, which="both", length=0)
    panel.grid(axis="y", color=FAINT, lw=0.7)
    panel.margins(x=0.01)
    for name, spine in panel.spines.items():
        spine.set_visible(name == "bottom")
        spine.set_color(FAINT)
