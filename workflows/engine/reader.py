"""Read-only queries of the queue's rows."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from workflows.engine.database import BELOW, Ask, below, checked_url, reading, require_queue, table
from workflows.ids import check_id

DAY_S = 24 * 3600.0
WAITING, RUNNING, DONE, FAILED, CANCELLED = "waiting", "running", "done", "failed", "cancelled"
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


@dataclass(frozen=True, kw_only=True)
class QueueMetrics:
    """Counts of a run, or of the whole queue; of jobs unless stated otherwise."""

    counts: dict[str, int]  # state -> jobs
    flows: dict[str, int]  # state -> flows
    ended_last_hour: int
    a_day: float  # jobs per day at the rate since the oldest of the last 1,000 done
    failures: dict[str, int]  # "status: reason" -> jobs
    workers: dict[str, int]  # executor id -> running jobs


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

    def jobs(self, run: str) -> list[JobRow]:
        """Return the jobs of a run, or of a part of it, without its flows."""
        among = BELOW.replace("workflow_uuid", "w.workflow_uuid")
        return [_row(row) for row in self._rows(self._select(f"w.name = 'job' AND {among}"), below(check_id(run)))]

    def metrics(self, run: str | None = None) -> QueueMetrics:
        """Return everything that `gnmreg status` shows, of a run or of the whole queue."""
        among = f"{BELOW} AND " if run else ""
        parameters = below(check_id(run)) if run else {}
        now_ms = time.time() * 1000
        with reading(self.url) as ask:
            jobs = ask(
                f"SELECT name, status, count(*) FROM {self._status} WHERE {among}1 = 1 GROUP BY name, status",
                parameters,
            )
            hour = ask(
                f"SELECT count(*) FROM {self._status} WHERE {among}name = 'job' AND completed_at > :since",
                {**parameters, "since": int(now_ms - 3600 * 1000)},
            )
            last = ask(
                "SELECT count(*), min(completed_at) FROM ("
                f"SELECT completed_at FROM {self._status} WHERE {among}name = 'job' AND status = 'SUCCESS' "
                "AND completed_at IS NOT NULL ORDER BY completed_at DESC LIMIT 1000) AS last",
                parameters,
            )
            workers = ask(
                f"SELECT executor_id, count(*) FROM {self._status} WHERE {among}status = 'PENDING' AND name = 'job' "
                "GROUP BY executor_id",
                parameters,
            )
            failures = self._failures(ask, among, parameters)
        done, since = last[0][0], _number(last[0][1])
        return QueueMetrics(
            counts=_by_state([row[1:] for row in jobs if row[0] == "job"]),
            flows=_by_state([row[1:] for row in jobs if row[0] == "flow"]),
            ended_last_hour=int(hour[0][0]),
            a_day=done * DAY_S * 1000 / max(now_ms - since, 1000.0) if done else 0.0,
            failures=failures,
            workers={str(name): int(count) for name, count in workers},
        )

    def _failures(self, ask: Ask, among: str, parameters: dict[str, Any]) -> dict[str, int]:
        among = among.replace("workflow_uuid", "w.workflow_uuid")
        rows = ask(
            f"SELECT coalesce(o.error, w.error), count(*) FROM {self._status} w "
            f"LEFT JOIN {self._output} o ON o.workflow_uuid = w.workflow_uuid "
            f"WHERE {among}w.name = 'job' AND w.status IN {_FAILED} "
            "GROUP BY coalesce(o.error, w.error)",
            parameters,
        )
        total: dict[str, int] = {}
        for error, count in rows:
            record = _failure(error, DEAD)
            text = f"{record['status']}: {record['reason']}"
            total[text] = total.get(text, 0) + int(count)
        return dict(sorted(total.items(), key=lambda item: -item[1]))

    def _select(self, where: str) -> str:
        return (
            "SELECT w.workflow_uuid, w.name, w.status, w.executor_id, coalesce(i.inputs, w.inputs), "
            "coalesce(o.output, w.output), coalesce(o.error, w.error), w.created_at, w.completed_at "
            f"FROM {self._status} w LEFT JOIN {self._output} o ON o.workflow_uuid = w.workflow_uuid "
            f"LEFT JOIN {self._input} i ON i.workflow_uuid = w.workflow_uuid WHERE {where}"
        )

    def _rows(self, query: str, parameters: dict[str, Any]) -> Sequence[Any]:
        with reading(self.url) as ask:
            return ask(query, parameters)


def ended(counts: dict[str, int]) -> int:
    """Return how many of the counted jobs have ended, in whichever state."""
    return sum(counts.get(state, 0) for state in (DONE, FAILED, CANCELLED))


def _by_state(rows: Sequence[Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for status, count in rows:
        state = STATES.get(status, status)
        counts[state] = counts.get(state, 0) + int(count)
    return counts


def _row(row: Any) -> JobRow:
    identity, kind, status, executor, inputs, output, error, created, ended_ms = row
    state = STATES.get(status, status)
    dead = DEAD if status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED" else ""
    return JobRow(
        id=identity,
        kind=kind,
        state=state,
        executor=executor,
        spec=_spec(inputs),
        result=_object(output),
        failure=_failure(error, dead) if state == FAILED else None,
        created=_number(created) / 1000,
        ended=_number(ended_ms) / 1000 if ended_ms else None,
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


def _number(value: Any) -> float:
    """A time in a column; 0 for anything else, which SQLite allows in any column."""
    return float(value) if isinstance(value, (int, float, Decimal)) else 0.0
