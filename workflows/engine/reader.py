"""Read-only queries of the queue's rows."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

from workflows.engine.alive import ended_processes
from workflows.engine.database import BELOW, below, checked_url, reading, require_queue, table
from workflows.ids import check_id

WAITING, RUNNING, DONE, FAILED, CANCELLED = "waiting", "running", "done", "failed", "cancelled"
INTERRUPTED = "interrupted"  # running, says the queue, but its process has ended: another one will take it
STATES = {
    "ENQUEUED": WAITING,
    "DELAYED": WAITING,
    "PENDING": RUNNING,
    "SUCCESS": DONE,
    "ERROR": FAILED,
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": FAILED,
    "CANCELLED": CANCELLED,
}
_FAILED = "('ERROR', 'MAX_RECOVERY_ATTEMPTS_EXCEEDED')"
MAX_TIME_MS = 2.5e14  # in the year 9892
DEAD = "killed its worker every time"


@dataclass(frozen=True, kw_only=True)
class JobRow:
    """One job or flow."""

    id: str
    kind: str  # "job" | "flow"
    state: str
    executor: str | None
    spec: dict[str, Any]
    result: dict[str, Any] | None  # a job's outcome, a flow's result
    failure: dict[str, Any] | None  # {"status", "reason", ...}
    created: float  # seconds since 1970
    ended: float | None
    started: float | None = None  # when a worker last took it
    queue: str | None = None
    version: str | None = None  # of the flows' structure; workers take jobs of their own only

    @property
    def since(self) -> float:
        """When its state began, seconds since 1970."""
        return self.ended or (self.started if self.state in (RUNNING, INTERRUPTED) else None) or self.created


@dataclass(frozen=True, slots=True)
class JobTimes:
    """What the figures of a queue need of a job or flow: little, as there may be many."""

    id: str
    kind: str
    state: str
    executor: str | None
    ended: float | None
    started: float | None
    version: str | None
    queue: str | None
    created: float
    updated_ms: float  # when the row last changed
    captures: bool  # whether it registers a capture
    made: bool  # whether it computed something, or found the result of the same inputs
    failure: dict[str, Any] | None


class QueueReader:
    """Read-only queries of the queue's database."""

    def __init__(self, url: str, *, known: bool = False) -> None:
        """Open a queue. Raises InputError if there is none at the URL, which `known` does not check."""
        self.url = checked_url(url)
        if not known:
            require_queue(self.url)
        self._status, self._output, self._input = (
            table(self.url, name) for name in ("workflow_status", "workflow_output", "workflow_input")
        )

    def counts(self, run: str, *, kind: str | None = None) -> dict[str, int]:
        """Return state -> number of jobs and flows below a run, without the run itself."""
        parameters = {"below": below(check_id(run))["below"]}
        query = f"SELECT status, count(*) FROM {self._status} WHERE workflow_uuid LIKE :below ESCAPE '\\'"
        if kind:
            query += " AND name = :kind"
            parameters["kind"] = kind
        return _by_state(self._rows(query + " GROUP BY status", parameters))

    def counts_of(self, ids: Sequence[str]) -> dict[str, int]:
        """Return state -> number of these ids; ids that are not in the queue are not counted."""
        total: dict[str, int] = {}
        query = f"SELECT status, count(*) FROM {self._status} WHERE workflow_uuid IN :ids GROUP BY status"
        with reading(self.url) as ask:
            for start in range(0, len(ids), 1000):
                counts = _by_state(ask(query, {"ids": list(ids[start : start + 1000])}))
                total = {state: total.get(state, 0) + counts.get(state, 0) for state in {*total, *counts}}
        return total

    def rows(self, ids: Sequence[str]) -> dict[str, JobRow]:
        """Return id -> row of those of these ids that are in the queue."""
        query, rows = self._select("w.workflow_uuid IN :ids"), dict[str, JobRow]()
        with reading(self.url) as ask:
            for start in range(0, len(ids), 1000):
                rows |= {row[0]: _row(row) for row in ask(query, {"ids": list(ids[start : start + 1000])})}
        return rows

    def listing(self, run: str | None = None) -> list[JobRow]:
        """Return the jobs and flows of a run, or of the whole queue; interrupted ones have that state."""
        where, parameters = _among(run)
        rows = [_row(row) for row in self._rows(self._select(where), parameters)]
        ended = ended_processes(self.url, {row.executor for row in rows if row.state == RUNNING and row.executor})
        return [
            replace(row, state=INTERRUPTED) if row.state == RUNNING and row.executor in ended else row for row in rows
        ]

    def times(self, run: str | None = None, *, since_ms: int = 0) -> list[JobTimes]:
        """Return what `listing` does, in short; only rows that changed at `since_ms`, ms since 1970, or later."""
        where, parameters = _among(run)
        if since_ms:
            where, parameters = f"{where} AND w.updated_at >= :since", {**parameters, "since": since_ms}
        rows = self._rows(
            "SELECT w.workflow_uuid, w.name, w.status, w.executor_id, w.completed_at, w.started_at_epoch_ms, "
            "w.application_version, w.queue_name, w.created_at, w.updated_at, "
            "CASE WHEN coalesce(i.inputs, w.inputs) LIKE :capture THEN 1 ELSE 0 END, "
            "CASE WHEN coalesce(o.output, w.output) LIKE :kept THEN 0 ELSE 1 END, "
            f"CASE WHEN w.status IN {_FAILED} THEN coalesce(o.error, w.error) END "
            f"FROM {self._status} w LEFT JOIN {self._output} o ON o.workflow_uuid = w.workflow_uuid "
            f"LEFT JOIN {self._input} i ON i.workflow_uuid = w.workflow_uuid WHERE {where}",
            {**parameters, "capture": '%"capture": "%', "kept": '%"made": false%'},
        )
        ended = ended_processes(self.url, {row[3] for row in rows if _state(row[2]) == RUNNING and row[3]})
        return [_times(row, ended) for row in rows]

    def ids(self, run: str | None = None) -> list[str]:
        """Return the ids of a run, or of the whole queue."""
        where, parameters = _among(run)
        return [
            str(row[0]) for row in self._rows(f"SELECT workflow_uuid FROM {self._status} w WHERE {where}", parameters)
        ]

    def _select(self, where: str) -> str:
        return (
            "SELECT w.workflow_uuid, w.name, w.status, w.executor_id, coalesce(i.inputs, w.inputs), "
            "coalesce(o.output, w.output), coalesce(o.error, w.error), w.created_at, w.completed_at, "
            "w.started_at_epoch_ms, w.queue_name, w.application_version "
            f"FROM {self._status} w LEFT JOIN {self._output} o ON o.workflow_uuid = w.workflow_uuid "
            f"LEFT JOIN {self._input} i ON i.workflow_uuid = w.workflow_uuid WHERE {where}"
        )

    def _rows(self, query: str, parameters: dict[str, Any]) -> Sequence[Any]:
        with reading(self.url) as ask:
            return ask(query, parameters)


def ended(counts: dict[str, int]) -> int:
    """Return how many of the counted jobs have ended, in whichever state."""
    return sum(counts.get(state, 0) for state in (DONE, FAILED, CANCELLED))


def _among(run: str | None) -> tuple[str, dict[str, Any]]:
    """The condition for the rows `w` of a run, or of the whole queue, and its parameters."""
    if run is None:
        return "1 = 1", {}
    return BELOW.replace("workflow_uuid", "w.workflow_uuid"), below(check_id(run))


def _by_state(rows: Sequence[Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for status, count in rows:
        state = _state(status)
        counts[state] = counts.get(state, 0) + int(count)
    return counts


def _row(row: Any) -> JobRow:
    identity, kind, status, executor, inputs, output, error, created, ended_ms, started, queue, version = row
    state = _state(status)
    dead = DEAD if status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED" else ""
    return JobRow(
        id=identity,
        kind=kind,
        state=state,
        executor=executor,
        spec=_spec(inputs),
        result=_object(output),
        failure=_failure(error, dead) if state == FAILED else None,
        created=number(created) / 1000,
        ended=number(ended_ms) / 1000 if ended_ms else None,
        started=number(started) / 1000 if started else None,
        queue=queue,
        version=version,
    )


def _times(row: Any, ended_processes: set[str]) -> JobTimes:
    identity, kind, status, executor, ended_ms, started, version, queue, created, updated, captures, made, error = row
    state = _state(status)
    dead = DEAD if status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED" else ""
    return JobTimes(
        id=str(identity),
        kind=kind,
        state=INTERRUPTED if state == RUNNING and executor in ended_processes else state,
        executor=executor,
        ended=number(ended_ms) / 1000 if ended_ms else None,
        started=number(started) / 1000 if started else None,
        version=version,
        queue=queue,
        created=number(created) / 1000,
        updated_ms=number(updated),
        captures=bool(captures),
        made=bool(made),
        failure=_failure(error, dead) if state == FAILED else None,
    )


def _spec(inputs: Any) -> dict[str, Any]:
    """The job or flow in a row's inputs; empty for a row that this package did not write."""
    args = (_object(inputs) or {}).get("args")
    return args[0] if isinstance(args, list) and args and isinstance(args[0], dict) else {}


def _failure(error: Any, dead: str) -> dict[str, Any]:
    record = (_object(error) or {}).get("error")
    if isinstance(record, dict):
        return {"status": "failed", "reason": "", **record}
    return {"status": "dead", "reason": dead} if dead else {"status": "failed", "reason": str(error)[:2000]}


def _object(text: Any) -> dict[str, Any] | None:
    """The JSON object in a column, None if it holds anything else: others can write to the database, too."""
    try:
        value = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _state(status: Any) -> str:
    """The state of a row; one with a status that DBOS does not write will not run."""
    return STATES.get(status, FAILED) if isinstance(status, str) else FAILED


def number(value: Any) -> float:
    """Return a time in a column, milliseconds; 0 for anything that is none, which SQLite allows in any column."""
    time_ms = float(value) if isinstance(value, (int, float, Decimal)) else 0.0
    return time_ms if 0.0 <= time_ms < MAX_TIME_MS else 0.0
