"""The figures of a registration that tables of many registrations show."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Headline:
    """A column of such tables. Smaller values are better."""

    path: tuple[str, ...]  # of the value among a manifest's figures
    column: str  # header of a CSV file, with the unit
    title: str  # header on a page
    unit: str
    digits: int = 3


_SCAN = ("scan_to_mesh", "face")
HEADLINES = (
    Headline(path=(*_SCAN, "mean_mm"), column="scan_to_mesh_face_mean_mm", title="scan to mesh, mean", unit="mm"),
    Headline(path=(*_SCAN, "median_mm"), column="scan_to_mesh_face_median_mm", title="scan to mesh, median", unit="mm"),
    Headline(path=(*_SCAN, "p95_mm"), column="scan_to_mesh_face_p95_mm", title="scan to mesh, 95 %", unit="mm"),
    Headline(path=("drift", "face", "mean_mm"), column="drift_face_mean_mm", title="drift, mean", unit="mm"),
)


def brief(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return those figures of a manifest that `HEADLINES` names, with the rows that they are in."""
    kept: dict[str, Any] = {}
    for headline in HEADLINES:
        if headline_value(figures, headline) is not None:
            *above, last = headline.path[:-1] or headline.path
            source, target = figures, kept
            for name in above:
                source, target = source[name], target.setdefault(name, {})
            target[last] = source[last]
    return kept


def headline_value(figures: Mapping[str, Any], headline: Headline) -> float | None:
    """Return a column's value; None if the figures lack it, or it is no finite number."""
    value: Any = figures
    for name in headline.path:
        value = value.get(name) if isinstance(value, Mapping) else None
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if number else None
