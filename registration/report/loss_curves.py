"""The loss terms of an optimization as inline SVG. Every registration has this chart: it is drawn without a library,
whose import and layout would take seconds."""

import math
from collections.abc import Mapping, Sequence
from html import escape

from registration.report.colours import GRID_COLOUR, LINE_COLOURS, TEXT_COLOUR

_COLUMNS = 3  # panels in a row
_WIDTH, _HEIGHT = 270.0, 200.0  # of a panel, with its margins
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 8.0, 26.0, 34.0
_LEGEND_WIDTH, _LEGEND_HEIGHT = 202.0, 17.0  # of an entry
_LEGEND_COLUMNS = 4
_MOST_LABELS = 7  # of an axis

Terms = Mapping[str, Sequence[float]]


def loss_curves(history: Mapping[str, Terms]) -> str:
    """Plot the loss terms of each stage over its steps, on a logarithmic axis, one panel per stage.

    A term has the same colour in all panels. Values that are not positive and finite leave gaps.

    Args:
        history: stage -> loss term -> its value at each step.

    Returns:
        An SVG element; empty without any value.
    """
    stages = {name: terms for name, terms in history.items() if any(len(values) for values in terms.values())}
    if not stages:
        return ""
    names = list(dict.fromkeys(term for terms in stages.values() for term in terms))
    colours = {term: LINE_COLOURS[k % len(LINE_COLOURS)] for k, term in enumerate(names)}
    columns = min(len(stages), _COLUMNS)
    top = _HEIGHT * math.ceil(len(stages) / _COLUMNS)
    width = max(_WIDTH * columns, _LEGEND_WIDTH * min(len(names), _LEGEND_COLUMNS))
    height = top + _LEGEND_HEIGHT * math.ceil(len(names) / _LEGEND_COLUMNS) + 6
    parts = [
        f'<g transform="translate({number % columns * _WIDTH:g} {number // columns * _HEIGHT:g})">'
        f"{_panel(stage, terms, colours)}</g>"
        for number, (stage, terms) in enumerate(stages.items())
    ]
    for number, (name, colour) in enumerate(colours.items()):
        x, y = number % _LEGEND_COLUMNS * _LEGEND_WIDTH, top + (number // _LEGEND_COLUMNS + 0.6) * _LEGEND_HEIGHT
        parts.append(f'<path d="M{x + 8:g} {y:g}h20" stroke="{colour}" stroke-width="2.4"/>')
        parts.append(_text(x + 34, y + 4, name, size=9))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
        f'font-family="sans-serif" fill="none">{"".join(parts)}</svg>'
    )


def _panel(stage: str, terms: Terms, colours: Mapping[str, str]) -> str:
    """One stage, drawn from (0, 0)."""
    parts = [_text(_LEFT, 16, stage, size=10.5, weight="bold")]
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    shown = [value for values in terms.values() for value in values if _is_shown(value)]
    low, high = (math.log10(limit) for limit in (min(shown, default=1.0), max(shown, default=1.0)))
    low, high = low - 0.03 * (high - low) - 1e-3, high + 0.03 * (high - low) + 1e-3
    steps = max(map(len, terms.values()))

    def x_of(step: float) -> float:
        return _LEFT + (right - _LEFT) * (step - 1) / max(1, steps - 1)

    def y_of(value: float) -> float:
        return bottom - (bottom - _TOP) * (math.log10(value) - low) / (high - low)

    for value in _round_values(low, high):
        y = y_of(value)
        parts.append(f'<path d="M{_LEFT:g} {y:.1f}H{right:g}" stroke="{GRID_COLOUR}" stroke-width="0.7"/>')
        parts.append(_text(_LEFT - 4, y + 3, f"{value:g}", size=8.5, anchor="end"))
    parts.append(f'<path d="M{_LEFT:g} {bottom:g}H{right:g}" stroke="{GRID_COLOUR}"/>')
    for step in _round_steps(steps):
        parts.append(_text(x_of(step), bottom + 13, f"{step}", size=8.5, anchor="middle"))
    parts.append(_text((_LEFT + right) / 2, bottom + 26, "step", size=9, anchor="middle"))
    for term, values in terms.items():
        points = [
            f"{x_of(step):.1f} {y_of(value):.1f}" if _is_shown(value) else ""
            for step, value in enumerate(values, start=1)
        ]
        begins = ["M" if not before else "L" for before in ["", *points[:-1]]]
        path = "".join(f"{begin}{point}" for begin, point in zip(begins, points, strict=True) if point)
        if path:
            parts.append(f'<path d="{path}" stroke="{colours[term]}" stroke-width="1.4"/>')
    return "".join(parts)


def _is_shown(value: float | None) -> bool:
    return value is not None and math.isfinite(value) and value > 0


def _round_values(low: float, high: float) -> list[float]:
    """Powers of ten between two logarithms, or 1, 2 and 5 times these where they are few."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    for factors in ((1,), (1, 2, 5)):
        values = [factor * 10.0**decade for decade in decades for factor in factors]
        values = [value for value in values if low <= math.log10(value) <= high]
        if len(values) > 2:
            break
    return values[:: math.ceil(len(values) / _MOST_LABELS)] if values else []


def _round_steps(steps: int) -> list[int]:
    """The first step and multiples of a round number."""
    rough = steps / (_MOST_LABELS - 1)
    power = 10 ** max(0, math.floor(math.log10(max(1, rough))))
    every = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
    return [1, *(step for step in range(every, steps + 1, every) if step > max(1, every / 2))]


def _text(x: float, y: float, text: str, *, size: float, anchor: str = "start", weight: str = "normal") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" font-weight="{weight}" '
        f'fill="{TEXT_COLOUR}">{escape(text)}</text>'
    )
