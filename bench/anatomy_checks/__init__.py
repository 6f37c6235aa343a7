"""Checks of regenerated anatomy. Each module is a section of `python -m bench.anatomy_parts`: it has a function

    figures(data: GNMData) -> Iterator[Figure]

that regenerates its part of a model and yields what it measured.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured value."""

    name: str
    value: float
    unit: str
    most: float | None = None  # the limit that the value keeps; without limits it is only told
    least: float | None = None

    @property
    def kept(self) -> bool:
        above = self.most is not None and not self.value <= self.most
        below = self.least is not None and not self.value >= self.least
        return not (above or below)

    @property
    def limit(self) -> str:
        bounds = [f"<= {self.most:g}" if self.most is not None else "", f">= {self.least:g}" if self.least else ""]
        return " ".join(filter(None, bounds)) or "told"
