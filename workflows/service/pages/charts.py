"""Line charts as numbers for SVG: the pages' security policy forbids the style attributes of other libraries."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

WIDTH, HEIGHT = 420.0, 240.0
LEFT, RIGHT, TOP, BOTTOM = 44.0, 84.0, 12.0, 34.0  # margins; on the right are the lines' names
TONES = 6  # colours of pages.css
DASHES = ("", "6 3", "2 3", "8 3 2 3")  # lines differ without colour, too
_LABEL = 12.0  # least distance of two names


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of a chart."""

    name: str
    points: Sequence[tuple[float, float]]


def line_chart(lines: Sequence[Line], x_label: str) -> dict[str, Any] | None:
    """Return what the macro `chart` draws; None without two different places on the horizontal axis.

    Args:
        lines: values that are no finite numbers are left out.
        x_label: of the horizontal axis.
    """
    drawn = [Line(name=line.name, points=[p for p in line.points if all(map(math.isfinite, p))]) for line in lines]
    drawn = [line for line in drawn if line.points]
    xs, ys = ([point[axis] for line in drawn for point in line.points] for axis in (0, 1))
    if len(set(xs)) < 2:
        return None
    step = _step(max(ys))
    top = step * max(1, math.ceil(max(ys) / step))
    left, right = min(xs), max(xs)

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            LEFT + (x - left) / (right - left) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - y / top * (HEIGHT - TOP - BOTTOM),
        )

    shown = []
    for number, line in enumerate(drawn):
        places = [place(*point) for point in line.points]
        shown.append(
            {
                "name": line.name,
                "tone": number % TONES,
                "dash": DASHES[number % len(DASHES)],
                "path": " ".join(f"{x:.1f},{y:.1f}" for x, y in places),
                "dots": places,
                "texts": [f"{line.name}: {y:.3f} at {x:g}" for x, y in line.points],
                "label_y": places[-1][1],
            }
        )
    _spread(shown)
    return {
        "width": WIDTH,
        "height": HEIGHT,
        "lines": shown,
        "grid": [(place(left, k * step)[1], f"{k * step:g}") for k in range(round(top / step) + 1)],
        "ticks": [(place(x, 0)[0], f"{x:g}") for x in _some(sorted(set(xs)))],
        "left": LEFT,
        "right": WIDTH - RIGHT,
        "x_label": x_label,
        "summary": "; ".join(f"{line.name} ends at {line.points[-1][1]:.3f}" for line in drawn),
    }


def curves(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return title -> chart of the curves in a coregistration's record."""
    charts = {}
    for title, name in (("Generalization, mm", "generalization_mm"), ("Specificity, mm", "specificity_mm")):
        lines = [
            Line(name=str(model), points=[(float(count), float(value)) for count, value in curve.items()])
            for model, curve in record[name].items()
        ]
        if (chart := line_chart(lines, "components")) is not None:
            charts[title] = chart
    return charts


def _step(largest: float) -> float:
    """A round distance of about four grid lines."""
    rough = max(largest, 1e-9) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= rough)


def _some(values: Sequence[float]) -> Sequence[float]:
    every = -(-len(values) // 7)
    return values[::every]


def _spread(lines: list[dict[str, Any]]) -> None:
    """Move the names of lines apart."""
    previous = -math.inf
    for line in sorted(lines, key=lambda item: item["label_y"]):
        line["label_y"] = previous = max(line["label_y"], previous + _LABEL)
