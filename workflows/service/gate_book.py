"""The registrations of a run at the gate: their manifests are read once, and kept in short."""

import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from registration.errors import InputError
from registration.storage.reading import parse_json
from registration.storage.records import read_json
from registration.terminal import printable
from workflows.engine.reader import DONE, FAILED, JobRow
from workflows.gate.decisions import DecisionEntry, DecisionLog, current
from workflows.gate.figures import Assessed, read_figures
from workflows.gate.item import GateError, GateItem, gate_error, of_last_round
from workflows.gate.rules import GateThresholds, judge, read_thresholds
from workflows.ids import check_id, is_remote
from workflows.records.store import Store
from workflows.service.board import Entry
from workflows.service.problems import Problem
from workflows.service.results import REGISTRATION, arguments_of, results_of

if TYPE_CHECKING:
    from workflows.service.state import ServiceState

MANIFEST = "manifest.json"
WAIT_S = 0.1  # for which a request waits for manifests; the next ones show more
SHOW_S = 2.0  # between two times at which requests show what a thread has read
MAX_MADE = 16  # runs whose registrations are kept in order
_CHUNK = 20  # manifests that are read at once
Shown = Literal["waiting", "decided", "accept", "look", "reject", "all"]  # which registrations a filter shows
UNUSABLE = "unusable"  # a failed registration, which is published nevertheless


def fits(item: GateItem, show: Shown) -> bool:
    """Return whether a filter shows a registration."""
    if show == "waiting":
        return item.waits
    if show == "decided":
        return item.decision is not None
    return show in ("all", item.verdict.level)


@dataclass(frozen=True, kw_only=True)
class GateRun:
    """A run at the gate, as far as its registrations were read."""

    items: Mapping[str, GateItem]  # job -> registration, in the order in which they need a look
    unread: int  # registrations whose manifest was not read yet
    thresholds: GateThresholds

    @cached_property
    def counts(self) -> Mapping[str, int]:
        """How many registrations each filter shows."""
        kinds: tuple[Shown, ...] = ("waiting", "decided", "accept", "look", "reject")
        return {kind: sum(fits(item, kind) for item in self.items.values()) for kind in kinds}

    @cached_property
    def error(self) -> GateError | None:
        """The gate's own, from the sample of the accepted."""
        return gate_error(list(self.items.values()))


@dataclass(frozen=True)
class _Read:
    updated_ms: float  # of the job's row
    item: GateItem | None  # without decision; None: there is no registration


@dataclass(frozen=True)
class _Made:
    """A run's registrations in order, and what they follow from."""

    entries: Mapping[str, Entry]
    state: tuple[object, ...]
    run: GateRun


class GateBook:
    """The gate of one farm. Manifests are read by a thread, once, and requests show what was read so far."""

    def __init__(self, folder: Path) -> None:
        """`folder`: of the farm. Nothing is read yet."""
        self.log = DecisionLog.of_farm(folder)
        self._folder = Path(folder)
        self._read: dict[str, _Read] = {}
        self._judged_by = ""  # content id of the thresholds
        self._version = 0  # of what was read, as requests show it
        self._made: dict[str, _Made] = {}
        self._reading: dict[str, Future[None]] = {}
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="gate")
        self._stop = threading.Event()
        self._lock = threading.RLock()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._threads.shutdown(cancel_futures=True)

    def thresholds(self) -> GateThresholds:
        """Return the limits of the farm. Raises InputError if their file is damaged."""
        return read_thresholds(None, self._folder)

    def of_run(self, state: "ServiceState", run: str, seconds: float = WAIT_S) -> GateRun:
        """Return a run's registrations with verdicts and decisions; of a coregistration, those of its last round.

        Args:
            state: of the service.
            run: name of the run.
            seconds: for which to wait at most until all manifests are read.

        Raises:
            InputError: the thresholds or the log are damaged.
        """
        thresholds, log = self.thresholds(), self.log.read()
        board = state.board.entries
        with self._lock:
            if thresholds.content_id != self._judged_by:
                self._read, self._judged_by = {}, thresholds.content_id
            made = self._made.get(run)
            if made is not None and made.entries is board and made.state == (self._judged_by, self._version, len(log)):
                return made.run
            entries = _registrations(board, run)
            if any(not self._knows(entry) for entry in entries) and run not in self._reading:
                self._reading[run] = self._threads.submit(self._read_all, state, run, entries, thresholds)
            reading = self._reading.get(run)
        if reading is not None:
            wait([reading], seconds)
        with self._lock:
            result = GateRun(
                items=self._ordered(entries, current(log)),
                unread=sum(not self._knows(entry) for entry in entries),
                thresholds=thresholds,
            )
            if len(self._made) >= MAX_MADE:
                self._made.clear()
            self._made[run] = _Made(board, (self._judged_by, self._version, len(log)), result)
        return result

    def _read_all(self, state: "ServiceState", run: str, entries: Sequence[Entry], thresholds: GateThresholds) -> None:
        """Read the manifests that are not known, half of the time: requests are answered meanwhile."""
        shown_s = 0.0
        try:
            stale = [entry for entry in entries if not self._knows(entry)]
            for start in range(0, len(stale), _CHUNK):
                chunk, begin_s = stale[start : start + _CHUNK], time.monotonic()
                rows = state.reader.rows([entry.id for entry in chunk])
                items = {job: _item(state, row, run, thresholds) for job, row in rows.items()}
                with self._lock:
                    if self._stop.is_set() or thresholds.content_id != self._judged_by:
                        return
                    self._read |= {e.id: _Read(e.times.updated_ms, items.get(e.id)) for e in chunk}
                    if time.monotonic() > shown_s + SHOW_S:
                        self._version, shown_s = self._version + 1, time.monotonic()
                self._stop.wait(min(0.1, time.monotonic() - begin_s) if start + _CHUNK < len(stale) else 0.0)
        finally:
            with self._lock:
                self._version += 1
                del self._reading[run]

    def _ordered(self, entries: Sequence[Entry], decided: Mapping[str, DecisionEntry]) -> dict[str, GateItem]:
        known = {entry.id: self._read[entry.id].item for entry in entries if self._knows(entry)}
        items = {
            job: item if item.content_id not in decided else replace(item, decision=decided[item.content_id])
            for job, item in known.items()
            if item is not None
        }
        return dict(sorted(items.items(), key=lambda pair: _rank(pair[0], pair[1])))

    def _knows(self, entry: Entry) -> bool:
        read = self._read.get(entry.id)
        return read is not None and read.updated_ms == entry.times.updated_ms


def _registrations(board: Mapping[str, Entry], run: str) -> list[Entry]:
    """The jobs of a run that have registered a capture."""
    entries = {key: one for key, one in board.items() if one.run == run and one.times.captures}
    chosen = [entries[job] for job in of_last_round(list(entries))]
    return [
        entry
        for entry in chosen
        if entry.times.state == DONE or (entry.times.state == FAILED and entry.status == UNUSABLE)
    ]


def _item(state: "ServiceState", row: JobRow, run: str, thresholds: GateThresholds) -> GateItem | None:
    """The registration of a job; None if there is none that can be read."""
    try:
        place, record = _manifest(state, row)
    except (InputError, Problem):
        return None
    if not isinstance(record, dict) or not isinstance(record.get("content_id"), str):
        return None
    status, figures, inputs = record.get("status"), record.get("figures"), record.get("inputs")
    if status not in ("converged", "stopped", "failed"):
        return None
    assessed = Assessed(
        content_id=record["content_id"][:200],
        status=status,
        reason=str(record.get("reason", ""))[:2000],
        is_neutral=not isinstance(inputs, dict) or "neutral" not in inputs,
        figures=read_figures(figures if isinstance(figures, dict) else {}),
    )
    stored = "store" in arguments_of(row)
    name = row.id.removeprefix(f"{run}/") if stored else printable("/".join(Path(place).parts[-2:]))  # as `gnmreg gate`
    return GateItem(name=name, place=place, assessed=assessed, verdict=judge(assessed, thresholds))


def _manifest(state: "ServiceState", row: JobRow) -> tuple[str, Any]:
    """Where the registration is, and its manifest. Raises InputError or Problem."""
    arguments = arguments_of(row)
    if "store" in arguments and is_remote(url := state.places.of_row(arguments["store"], "store")):
        store = Store(url)
        artifact = store.find(check_id(arguments.get("key", "")))
        if artifact is None:
            raise Problem.missing("registration", row.id)
        content = store.read(artifact, f"{REGISTRATION}/{MANIFEST}")
        place = f"{url}/{artifact.key}/{artifact.attempt}/{REGISTRATION}"
        refuse = partial(InputError, "The manifest cannot be read", where=place, fix="register the capture again")
        return place, parse_json(content, refuse)
    found = results_of(state, row)
    if found is None:
        raise Problem.missing("registration", row.id)
    return str(found.registration), read_json(found.registration / MANIFEST, title="registration")


def _rank(job: str, item: GateItem) -> tuple[bool, int, str]:
    """Those that are for a person first, decided or not: a decision moves nothing in the list. Then by name."""
    return not item.verdict.for_person, ("look", "accept", "reject").index(item.verdict.level), job
