"""Rows of the tables of registrations, on the pages of batches and subjects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from registration.evaluate.names import LEVEL_TITLES, Level
from workflows.records.headline import Headline, headline_value

MISSING = "–"


@dataclass(frozen=True, kw_only=True)
class RegistrationLine:
    """A row, with everything as text."""

    name: str
    label: str = ""  # a second name, such as the expression's
    status: str
    failed: bool
    level: Level | None = None  # of the verdict; None: there is none
    look: str = ""  # why it should be looked at
    reason: str
    report: str | None  # path relative to the page, not quoted
    thumbnail: str | None  # URL
    width: int  # of the thumbnail, px
    values: Sequence[str]
    seconds: str

    @property
    def verdict(self) -> str:
        return "" if self.level is None else LEVEL_TITLES[self.level]


def figure_texts(figures: Mapping[str, Any], headlines: Sequence[Headline]) -> list[str]:
    """Return a text for each column."""
    values = [(headline_value(figures, headline), headline.digits) for headline in headlines]
    return [MISSING if value is None else f"{value:.{digits}f}" for value, digits in values]


def seconds_text(seconds: float | None) -> str:
    """Return a duration without its unit."""
    return MISSING if seconds is None else f"{seconds:.0f}"
