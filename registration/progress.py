"""Progress of long computations: a bar in a terminal, plain lines in a log."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from registration.terminal import console, printable

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

_LINE_INTERVAL_S = 15.0


@runtime_checkable
class Progress(Protocol):
    """Receives the progress of a long computation."""

    def message(self, text: str) -> None:
        """Show a message to the user."""

    def update(self, done: int, total: int, label: str) -> None:
        """Report that `done` of `total` steps of `label` are complete."""


class NullProgress:
    """Discards everything."""

    def message(self, text: str) -> None:
        pass

    def update(self, done: int, total: int, label: str) -> None:
        pass


class PrefixedProgress:
    """Passes everything on with a prefix, which says to which of several items it belongs."""

    def __init__(self, progress: Progress, prefix: str) -> None:
        self._progress, self._prefix = progress, prefix

    def message(self, text: str) -> None:
        self._progress.message(f"{self._prefix}: {text}")

    def update(self, done: int, total: int, label: str) -> None:
        self._progress.update(done, total, f"{self._prefix}: {label}")


@contextmanager
def console_progress() -> Iterator[Progress]:
    """Return a context: a progress bar on stderr if that is a terminal, else a line per new label and each 15 s."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with RichProgress(*columns, console=console(stderr=True)) as bar:
        yield _Bar(bar)


class _Bar:
    def __init__(self, bar: "RichProgress") -> None:
        self._bar = bar
        self._task = bar.add_task("", total=None)

    def message(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False)

    def update(self, done: int, total: int, label: str) -> None:
        self._bar.update(self._task, completed=done, total=total, description=label)


class _Lines:
    def __init__(self) -> None:
        self._start_s = self._last_s = time.monotonic()
        self._label = ""

    def message(self, text: str) -> None:
        print(printable(text), file=sys.stderr, flush=True)

    def update(self, done: int, total: int, label: str) -> None:
        now = time.monotonic()
        if label == self._label and now - self._last_s < _LINE_INTERVAL_S:
            return
        self._label, self._last_s = label, now
        self.message(f"[{now - self._start_s:6.1f} s] {label}: {done}/{total}")
