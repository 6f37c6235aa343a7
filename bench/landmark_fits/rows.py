"""A measured figure with its limit, and the table of an experiment."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of a table."""

    what: str
    measured: str
    limit: str = ""  # empty: no limit was set
    ok: bool | None = None  # None: no limit was set


def at_most(what: str, value: float, limit: float, unit: str, digits: int = 3) -> Row:
    """A figure that should be at most a limit."""
    measured = f"{value:.{digits}g} {unit}".strip()
    return Row(what=what, measured=measured, limit=f"<= {limit:g} {unit}".strip(), ok=value <= limit)


def between(what: str, value: float, low: float, high: float, unit: str = "") -> Row:
    """A figure that should lie between limits."""
    return Row(
        what=what,
        measured=f"{value:.3g} {unit}".strip(),
        limit=f"{low:g} to {high:g} {unit}".strip(),
        ok=low <= value <= high,
    )


def show(title: str, rows: Sequence[Row], notes: Sequence[str] = ()) -> None:
    """Print a table, and notes under it."""
    console = Console(width=150)
    table = Table("figure", "measured", "asked", "", title=title, title_justify="left")
    for row in rows:
        table.add_row(row.what, row.measured, row.limit, "" if row.ok is None else "ok" if row.ok else "MISSED")
    console.print(table)
    for note in notes:
        console.print(f"  {note}")
