"""The captures of a batch as a table, ranked by what needs a look; also as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from workflows.records.headline import (
    HEADLINES,
    WRONG,
    Headline,
    headline_value,
    present,
    verdict_level,
    verdict_reasons,
    verdict_title,
)

DONE, FAILED, INTERRUPTED, CANCELLED = "done", "failed", "interrupted", "cancelled"  # states of jobs
RUNNING, WAITING = "running", "waiting"
_UNFINISHED = (INTERRUPTED, CANCELLED, RUNNING, WAITING)  # in the order of the page
_MIN_COMPARED = 8  # captures that have a figure before it is compared with the others'
_MAX_DEVIATIONS, _MAX_RATIO = 6.0, 1.5  # of a figure from the batch's median that needs no look; both are exceeded
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # a spreadsheet would execute such a cell
_COLUMNS = ("capture", "state", "status", "verdict", "needs_a_look", "reason")
_MORE_COLUMNS = ("registration_s", "report", "source", "job")


@dataclass(frozen=True, kw_only=True)
class BatchRow:
    """One capture of a batch."""

    name: str  # its key in the store
    source: str  # folder or URL of the capture
    job: str  # id
    state: str
    status: str  # the registration's if the job is done, what became of the job if it failed, else the state
    reason: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)  # as in a manifest
    seconds: float | None = None  # duration of the registration
    report: str | None = None  # path in the store
    thumbnail: str | None = None  # path in the store
    look: str = ""  # why a registration should be looked at


@dataclass(frozen=True, kw_only=True)
class BatchTable:
    """All captures of a batch at one time."""

    run: str
    written: str  # UTC
    rows: tuple[BatchRow, ...]  # as `ranked` returns them
    live: bool = True  # False: all processes that worked on the batch have ended

    @property
    def headlines(self) -> list[Headline]:
        """The figures that any row has."""
        return present(row.figures for row in self.rows)

    def counts(self) -> dict[str, int]:
        """Return status -> number of rows, in the order of the rows."""
        counts: dict[str, int] = {}
        for row in self.rows:
            counts[row.status] = counts.get(row.status, 0) + 1
        return counts

    def to_csv(self) -> str:
        """Return the text of a CSV file with a line of headers. Its cells cannot be taken for formulas."""
        text, headlines = io.StringIO(), self.headlines
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow((*_COLUMNS, *(headline.column for headline in headlines), *_MORE_COLUMNS))
        for row in self.rows:
            values = [headline_value(row.figures, headline) for headline in headlines]
            verdict = verdict_title(row.figures)
            words = [cell(word) for word in (row.name, row.state, row.status, verdict, row.look, row.reason)]
            numbers = ["" if value is None else f"{value:.6g}" for value in (*values, row.seconds)]
            writer.writerow((*words, *numbers, *map(cell, (row.report or "", row.source, row.job))))
        return text.getvalue()


def ranked(rows: Sequence[BatchRow]) -> tuple[BatchRow, ...]:
    """Return the rows in the order in which they need a look, with the reasons in `look`.

    First failed captures, by kind; then registrations that are wrong or to be looked at by their verdict, were
    stopped, or have a figure far above the batch's median; then the other registrations, the largest figure first;
    then captures that are not done.
    """
    medians = {headline: limit for headline in HEADLINES if (limit := _limit(rows, headline)) is not None}
    looked = [replace(row, look="; ".join(_reasons(row, medians))) if row.state == DONE else row for row in rows]
    return tuple(sorted(looked, key=lambda row: _rank(row, medians)))


@dataclass(frozen=True)
class _Limit:
    """The usual and the largest inconspicuous value of a figure in a batch."""

    usual: float
    largest: float


def _limit(rows: Sequence[BatchRow], headline: Headline) -> _Limit | None:
    found = [headline_value(row.figures, headline) for row in rows if row.state == DONE]
    values = [value for value in found if value is not None]
    if len(values) < _MIN_COMPARED:
        return None
    usual = median(values)
    deviation = median(abs(value - usual) for value in values)
    return _Limit(usual, max(usual + _MAX_DEVIATIONS * deviation, _MAX_RATIO * usual))


def _reasons(row: BatchRow, limits: Mapping[Headline, _Limit]) -> list[str]:
    reasons = verdict_reasons(row.figures)
    if row.status == "stopped" and not reasons:
        reasons = ["it was stopped before it converged"]
    for headline, limit in limits.items():
        value = headline_value(row.figures, headline)
        if value is not None and value > limit.largest:
            usual, unit = f"{limit.usual:.{headline.digits}f}", headline.unit
            reasons.append(f"{headline.title} {value:.{headline.digits}f} {unit}, usually {usual} {unit}")
    return reasons


def _rank(row: BatchRow, limits: Mapping[Headline, _Limit]) -> tuple[Any, ...]:
    if row.state == FAILED:
        return (0, row.status, row.reason, row.name)
    if row.state != DONE:
        return (3 + (_UNFINISHED.index(row.state) if row.state in _UNFINISHED else len(_UNFINISHED)), row.name)
    values = [(headline_value(row.figures, headline), headline) for headline in HEADLINES]
    ratios = [value / max(limits[h].largest, 1e-9) for value, h in values if value is not None and h in limits]
    first = next((value for value, _ in values if value is not None), 0.0)
    level = 1.0 if verdict_level(row.figures) == WRONG else 1.5 if row.look else 2.0
    return (level, -max(ratios, default=0.0), -first, row.name)


def cell(text: str) -> str:
    """Return a text without control characters that no spreadsheet takes for a formula."""
    plain = "".join(character if character.isprintable() else " " for character in text).strip()
    return f"'{plain}" if plain.startswith(_FORMULA) else plain
