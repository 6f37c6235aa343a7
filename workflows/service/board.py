"""The state of the queue in memory: read once, then kept up to date from the rows that changed.

Pages and events of twenty thousand captures come from here, so that a viewer costs no query. Every change has a number;
the last changes are kept for viewers that were disconnected.
"""

import logging
import secrets
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import nan
from typing import Any, TypeVar

from workflows.engine.alive import ended_processes
from workflows.engine.reader import DONE, FAILED, INTERRUPTED, RUNNING, JobTimes, QueueReader
from workflows.records.headline import HEADLINES, headline_value, verdict_level, verdict_reasons

KEPT = 20_000  # changes that are kept
OVERLAP_MS = 30_000  # by which queries for changes overlap: transactions become visible later than their time stamps
RELOAD_S = 60.0  # after which deleted rows are noticed
MAX_DERIVED = 64  # values that are kept
MAX_REASON = 500  # letters
_CHUNK = 500  # rows whose results are read at a time
log = logging.getLogger("gnmreg.service")
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Entry:
    """A job or flow on the board.

    Attributes:
        times: what the figures of a queue need.
        status: of the registration if the job is done, what became of the job if it failed, else the state.
        reason: of a failure, of a verdict that asks for a look, or of the registration's status.
        level: of the registration's verdict; empty without one.
        content_id: of the published result; empty without one.
        thumbnail: whether there is a picture of the head.
        figures: of the registration, a number for each of `records.headline.HEADLINES`, NaN where there is none; or
            nothing.
    """

    times: JobTimes
    status: str
    reason: str = ""
    level: str = ""
    content_id: str = ""
    thumbnail: bool = False
    figures: Sequence[float] = ()

    @property
    def id(self) -> str:
        """Id of the job."""
        return self.times.id

    @property
    def run(self) -> str:
        """Name of the run."""
        return self.times.id.partition("/")[0]

    def brief(self) -> dict[str, Any]:
        """Return what lists and events show."""
        times = self.times
        return {
            "id": times.id,
            "kind": times.kind,
            "state": times.state,
            "status": self.status,
            "reason": self.reason,
            "verdict": self.level,
            "executor": times.executor,
            "created": times.created,
            "started": times.started,
            "ended": times.ended,
            "content_id": self.content_id,
        }


@dataclass(frozen=True, slots=True)
class Change:
    """One change of a job: its new entry, or that it was deleted."""

    number: int
    id: str
    entry: Entry | None


class Derived:
    """Values that follow from all jobs, such as a sorted list: kept until a job changes, for all viewers."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Any, ...], Any] = {}
        self._of: dict[str, Entry] | None = None
        self._lock = threading.RLock()

    def get(self, entries: dict[str, Entry], key: tuple[Any, ...], make: Callable[[], Value]) -> Value:
        """Return the value of a key, which `make` computes from these entries of the board if it is not kept."""
        with self._lock:
            if self._of is not entries or len(self._kept) > MAX_DERIVED:
                self._of, self._kept = entries, {}
            if key not in self._kept:
                self._kept[key] = make()
            value: Value = self._kept[key]
            return value


class Board:
    """All jobs of a queue, kept up to date by a thread."""

    def __init__(self, url: str, poll_s: float = 1.0) -> None:
        """Nothing is read before `start`. `poll_s`: seconds between two queries."""
        self._reader = QueueReader(url, known=True)
        self._poll_s = poll_s
        self.epoch = secrets.token_hex(4)  # numbers of changes are unique within it
        self.entries: dict[str, Entry] = {}  # replaced, not changed: readers need no lock
        self.stage_seconds: dict[str, tuple[int, float]] = {}  # stage -> number and seconds of registrations seen
        self.derived = Derived()
        self.answered = 0.0  # when the database last answered, seconds since 1970
        self._changes: deque[Change] = deque(maxlen=KEPT)
        self._number = 0
        self._newest_ms, self._loaded = 0.0, 0.0
        self._listeners: list[Callable[[], None]] = []
        self._refreshing, self._changing = threading.Lock(), threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="board", daemon=True)

    def start(self) -> None:
        """Read the queue, then follow it."""
        self.refresh()
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and the streams of events."""
        self._stop.set()
        for callback in tuple(self._listeners):
            callback()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    def listen(self, callback: Callable[[], None]) -> None:
        """Have a function called, in the board's thread, after changes."""
        self._listeners.append(callback)

    def ignore(self, callback: Callable[[], None]) -> None:
        """Forget a function of `listen`."""
        self._listeners.remove(callback)

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.is_set()

    @property
    def number(self) -> int:
        """Number of the last change."""
        return self._number

    def changes_after(self, number: int) -> Sequence[Change] | None:
        """Return the changes after a number, in order; None if some of them are not kept any more."""
        with self._changing:
            first = self._changes[0].number if self._changes else self._number + 1
            if number < first - 1 or number > self._number:
                return None
            return list(islice(self._changes, number - first + 1, None))

    def jobs_with(self, content_id: str) -> list[str]:
        """Return the ids of the jobs whose result has a content id."""
        entries = self.entries

        def make() -> dict[str, list[str]]:
            found: dict[str, list[str]] = {}
            for entry in entries.values():
                if entry.content_id:
                    found.setdefault(entry.content_id, []).append(entry.id)
            return found

        return self.derived.get(entries, ("contents",), make).get(content_id, [])

    def refresh(self) -> None:
        """Read what changed since the last call."""
        with self._refreshing:
            self._refresh()

    def _refresh(self) -> None:
        now = time.monotonic()
        everything = now > self._loaded + RELOAD_S or not self._loaded
        since_ms = 0 if everything else max(1, int(self._newest_ms - OVERLAP_MS))
        rows, old = self._reader.times(since_ms=since_ms), self.entries
        changed = [row for row in rows if row.id not in old or old[row.id].times != row]
        known = {row.id: old[row.id] for row in rows if row.id in old} if everything else dict(old)
        fresh = {entry.id: entry for entry in self._entries(changed)}
        fresh |= self._interrupted({**known, **fresh})
        deleted = [identity for identity in old if identity not in known and identity not in fresh]
        self._newest_ms = max((row.updated_ms for row in rows), default=self._newest_ms)
        self._loaded = now if everything else self._loaded
        self.answered = time.time()
        if not fresh and not deleted:
            return
        self.entries = known | fresh
        with self._changing:
            for identity, entry in (*fresh.items(), *((identity, None) for identity in deleted)):
                self._number += 1
                self._changes.append(Change(self._number, identity, entry))
        for callback in tuple(self._listeners):
            callback()

    def _watch(self) -> None:
        while not self._stop.wait(self._poll_s):
            try:
                self.refresh()
            except Exception as error:  # the server may be restarting: the next query says
                log.warning("the queue does not answer now: %s", str(error).splitlines()[:1])

    def _entries(self, rows: Sequence[JobTimes]) -> Iterable[Entry]:
        """Entries of rows, with what the results of done jobs say."""
        by_id = {row.id: row for row in rows if row.state == DONE and row.kind == "job"}
        done = list(by_id)
        results: dict[str, Entry] = {}
        for start in range(0, len(done), _CHUNK):
            for identity, job in self._reader.rows(done[start : start + _CHUNK]).items():
                results[identity] = _entry(by_id[identity], job.result)
                self._add_stages(job.result)
        for row in rows:
            if row.state == FAILED and row.failure:
                yield Entry(row, str(row.failure.get("status")), str(row.failure.get("reason")))
            elif row.id in results:
                yield results[row.id]
            else:
                yield Entry(row, row.state)

    def _add_stages(self, result: Mapping[str, Any] | None) -> None:
        stages = _about(result).get("stages")
        for name, seconds in stages.items() if isinstance(stages, dict) else ():
            if isinstance(seconds, int | float):
                count, total = self.stage_seconds.get(name, (0, 0.0))
                self.stage_seconds = {**self.stage_seconds, name: (count + 1, total + seconds)}

    def _interrupted(self, entries: dict[str, Entry]) -> dict[str, Entry]:
        """Entries of running jobs whose process has ended, and of interrupted ones whose process lives again."""
        states = (RUNNING, INTERRUPTED)
        running = {key: entry for key, entry in entries.items() if entry.times.state in states}
        ended = ended_processes(self._reader.url, {e.times.executor for e in running.values() if e.times.executor})
        found = {}
        for key, entry in running.items():
            state = INTERRUPTED if entry.times.executor in ended else RUNNING
            if state != entry.times.state:
                found[key] = Entry(replace(entry.times, state=state), state)
        return found


def _inner(result: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """What a step returned; others can write to the queue."""
    inner = (result or {}).get("result")
    return inner if isinstance(inner, dict) else {}


def _about(result: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """What is known about a registration, whether it is in a store or in a subject's folder."""
    inner = _inner(result)
    about = inner.get("about")
    return about if isinstance(about, dict) else inner


def _entry(times: JobTimes, result: dict[str, Any] | None) -> Entry:
    """The entry of a done job, from its result; others can write to the queue."""
    inner = (result or {}).get("result")
    inner = inner if isinstance(inner, dict) else {}
    about = inner.get("about")
    about = about if isinstance(about, dict) else inner
    figures = about.get("figures")
    figures = figures if isinstance(figures, dict) else {}
    words = about.get("status"), about.get("reason"), inner.get("content_id")
    status, reason, content = (word if isinstance(word, str) else "" for word in words)
    values = [headline_value(figures, headline) for headline in HEADLINES] if figures else []
    return Entry(
        times,
        status or DONE,
        "; ".join(verdict_reasons(figures))[:MAX_REASON] or reason,
        level=verdict_level(figures) or "",
        content_id=content,
        thumbnail=about.get("thumbnail") is True,
        figures=array("f", [nan if value is None else value for value in values]) if values else (),
    )
