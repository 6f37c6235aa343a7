"""The figures of a registration that tables of many registrations show."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from registration.evaluate.names import LEVEL_TITLES, RESIDUALS, Level


@dataclass(frozen=True, kw_only=True)
class Headline:
    """A column of such tables. Smaller values are better."""

    path: tuple[str, ...]  # of the value among a manifest's figures
    column: str  # header of a CSV file, with the unit
    title: str  # header on a page
    unit: str
    digits: int = 3


_SCAN, _IMAGES = ("scan_to_mesh", "face"), ("residuals", "overall")
HEADLINES = (
    Headline(path=(*_SCAN, "mean_mm"), column="scan_to_mesh_face_mean_mm", title="scan to mesh, mean", unit="mm"),
    Headline(path=(*_SCAN, "median_mm"), column="scan_to_mesh_face_median_mm", title="scan to mesh, median", unit="mm"),
    Headline(path=(*_SCAN, "p95_mm"), column="scan_to_mesh_face_p95_mm", title="scan to mesh, 95 %", unit="mm"),
    Headline(path=("drift", "face", "mean_mm"), column="drift_face_mean_mm", title="drift, mean", unit="mm"),
    *(
        Headline(path=(*_IMAGES, name), column=name, title=kind.title, unit=kind.unit, digits=1)
        for name, kind in RESIDUALS.items()
    ),
)
LOOK: Level = "look"
WRONG: Level = "wrong"


def brief(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return the verdict and those figures of a manifest that `HEADLINES` names, with the rows that they are in."""
    kept: dict[str, Any] = {"verdict": figures["verdict"]} if verdict_level(figures) else {}
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


def verdict_level(figures: Mapping[str, Any]) -> Level | None:
    """Return the level of the verdict; None for a registration without one."""
    verdict = figures.get("verdict")
    level = verdict.get("level") if isinstance(verdict, Mapping) else None
    return next((known for known in LEVEL_TITLES if known == level), None)


def verdict_title(figures: Mapping[str, Any]) -> str:
    """Return the verdict in words; empty for a registration without one."""
    level = verdict_level(figures)
    return "" if level is None else LEVEL_TITLES[level]


def verdict_reasons(figures: Mapping[str, Any]) -> list[str]:
    """Return why a registration should be looked at; empty if its verdict is good, or there is none."""
    if verdict_level(figures) not in (LOOK, WRONG):
        return []
    reasons = figures["verdict"].get("reasons")
    return [str(reason) for reason in reasons] if isinstance(reasons, list | tuple) else []


def present(rows: Iterable[Mapping[str, Any]]) -> list[Headline]:
    """Return the columns that have a value in any of the rows, each the figures of a registration."""
    figures = list(rows)
    return [h for h in HEADLINES if any(headline_value(row, h) is not None for row in figures)]
