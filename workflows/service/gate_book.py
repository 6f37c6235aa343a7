"""The registrations of a run at the gate: their manifests are read once, and kept in short."""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from registration.errors import InputError
from registration.storage.reading import parse_json
from registration.storage.records import read_json
from registration.terminal import printable
from workflows.engine.reader import DONE, FAILED, JobRow
from workflows.gate.decisions import DecisionEntry, DecisionLog, current
from workflows.gate.figures import Assessed, read_figures
from workflows.gate.item import GateItem, of_last_round
from workflows.gate.rules import GateThresholds, judge, read_thresholds
from workflows.ids import check_id, is_remote
from workflows.records.store import Store
from workflows.service.board import Entry
from workflows.service.problems import Problem
from workflows.service.results import REGISTRATION, arguments_of, results_of

if TYPE_CHECKING:
    from workflows.service.state import ServiceState

MANIFEST = "manifest.json"
READ_S = 2.0  # for which one request reads manifests; the next ones go on
_CHUNK = 200  # rows that are read at once
UNUSABLE = "unusable"  # a failed registration, which is published nevertheless


@dataclass(frozen=True, kw_only=True)
class GateRun:
    """A run at the gate, as far as its registrations were read."""

    items: Mapping[str, GateItem]  # job -> registration, in the order in which they need a look
    unread: int  # registrations whose manifest was not read yet
    thresholds: GateThresholds

    def waiting(self) -> list[str]:
        """Return the jobs whose registrations wait for a person."""
        return [job for job, item in self.items.items() if item.waits]


@dataclass(frozen=True)
class _Read:
    updated_ms: float  # of the job's row
    item: GateItem | None  # without decision; None: there is no registration


class GateBook:
    """The gate of one farm."""

    def __init__(self, folder: Path) -> None:
        """`folder`: of the farm. Nothing is read yet."""
        self.log = DecisionLog.of_farm(folder)
        self._folder = Path(folder)
        self._read: dict[str, _Read] = {}
        self._judged_by = ""  # content id of the thresholds
        self._lock = threading.Lock()

    def thresholds(self) -> GateThresholds:
        """Return the limits of the farm. Raises InputError if their file is damaged."""
        return read_thresholds(None, self._folder)

    def decisions(self) -> dict[str, DecisionEntry]:
        """Return content id -> the decision that holds. Raises InputError if the log is damaged."""
        return current(self.log.read())

    def of_run(self, state: "ServiceState", run: str, seconds: float = READ_S) -> GateRun:
        """Return a run's registrations with verdicts and decisions; of a coregistration, those of its last round.

        Args:
            state: of the service.
            run: name of the run.
            seconds: for which manifests are read.

        Raises:
            InputError: the thresholds or the log are damaged.
        """
        thresholds, decided = self.thresholds(), self.decisions()
        entries = _registrations(state, run)
        with self._lock:
            if thresholds.content_id != self._judged_by:
                self._read, self._judged_by = {}, thresholds.content_id
            stale = [entry for entry in entries if not self._knows(entry)]
            until = time.monotonic() + seconds
            while stale and time.monotonic() < until:
                chunk, stale = stale[:_CHUNK], stale[_CHUNK:]
                rows = state.reader.rows([entry.id for entry in chunk])
                for number, entry in enumerate(chunk):
                    if time.monotonic() > until:
                        stale = chunk[number:] + stale
                        break
                    item = _item(state, rows[entry.id], run, thresholds) if entry.id in rows else None
                    self._read[entry.id] = _Read(entry.times.updated_ms, item)
            known = {entry.id: self._read[entry.id].item for entry in entries if self._knows(entry)}
        items = {
            job: replace(item, decision=decided.get(item.content_id)) for job, item in known.items() if item is not None
        }
        ordered = dict(sorted(items.items(), key=lambda pair: _rank(pair[0], pair[1])))
        return GateRun(items=ordered, unread=len(stale), thresholds=thresholds)

    def _knows(self, entry: Entry) -> bool:
        read = self._read.get(entry.id)
        return read is not None and read.updated_ms == entry.times.updated_ms


def _registrations(state: "ServiceState", run: str) -> list[Entry]:
    """The jobs of a run that have registered a capture."""
    entries = {key: one for key, one in state.board.entries.items() if one.run == run and one.times.captures}
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
