"""Progress of long work: a bar in a terminal, plain lines in a log."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

_LINE_EVERY_S = 15.0


@runtime_checkable
class Progress(Protocol):
    """What long work reports to."""

    def note(self, text: str) -> None:
        """Something a person should know."""

    def at(self, done: int, total: int, what: str) -> None:
        """`done` of `total` steps; `what` is going on."""


class _Bar:
    def __init__(self, bar: "RichProgress") -> None:
        self._bar = bar
        self._task = bar.add_task("", total=None)

    def note(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False)

    def at(self, done: int, total: int, what: str) -> None:
        self._bar.update(self._task, completed=done, total=total, description=what)


class _Lines:
    def __init__(self) -> None:
        self._begun = self._last = time.monotonic()
        self._what = ""

    def note(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def at(self, done: int, total: int, what: str) -> None:
        now = time.monotonic()
        if what == self._what and now - self._last < _LINE_EVERY_S:
            return
        self._what, self._last = what, now
        self.note(f"[{now - self._begun:6.1f} s] {what}: {done}/{total}")


class Silent:
    """For callers that want none."""

    def note(self, text: str) -> None:
        pass

    def at(self, done: int, total: int, what: str) -> None:
        pass


class Named:
    """For one of several: says which one it is about."""

    def __init__(self, progress: Progress, name: str) -> None:
        self._progress, self._name = progress, name

    def note(self, text: str) -> None:
        self._progress.note(f"{self._name}: {text}")

    def at(self, done: int, total: int, what: str) -> None:
        self._progress.at(done, total, f"{self._name}: {what}")


@contextmanager
def shown() -> Iterator[Progress]:
    """Return a context with a progress bar on stderr if that is a terminal, else lines."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with RichProgress(*columns, console=Console(stderr=True)) as bar:
        yield _Bar(bar)
