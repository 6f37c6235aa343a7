"""What stands in the queue's rows, asked in SQL that cannot write."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
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
class Row:
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
class Figures:
    """A run, or all of the queue, in numbers; jobs only, flows aside."""

    counts: dict[str, int]  # state -> jobs
    flows: dict[str, int]  # state -> flows
    ended_last_hour: int
    a_day: float  # jobs a day at the rate since the oldest of the last 1,000 that were done
    failures: dict[str, int]  # "status: reason" -> jobs
    workers: dict[str, int]  # executor id -> jobs that it runs


class Reader:
    """Read-only questions to the queue's database."""

    def __init__(self, url: str, *, known: bool = False) -> None:
        """Raises InputError if there is no queue at the URL, unless it is `known` that there is one."""
        self.url = checked_url(url)
        if not known:
            require_queue(self.url)
        self._status, self._output, self._input = (
            table(self.url, name) for name in ("workflow_status", "workflow_output", "workflow_input")
        )

    def counts(self, run: str, *, kind: str | None = None) -> dict[str, int]:
        """State -> number of jobs and flows below a run, itself aside."""
        parameters = {"below": below(check_id(run))["below"]}
        query = f"SELECT status, count(*) FROM {self._status} WHERE workflow_uuid LIKE :below ESCAPE '\\'"
        if kind:
            query += " AND name = :kind"
            parameters["kind"] = kind
        return _by_state(self._rows(query + " GROUP BY status", parameters))

    def counts_of(self, ids: Sequence[str]) -> dict[str, int]:
        """State -> how many of these are in it; ids that are not there are counted nowhere."""
        total: dict[str, int] = {}
        query = f"SELECT status, count(*) FROM {self._status} WHERE workflow_uuid IN :ids GROUP BY status"
        with reading(self.url) as ask:
            for start in range(0, len(ids), 1000):
                found = _by_state(ask(query, {"ids": list(ids[start : start + 1000])}))
                total = {state: total.get(state, 0) + found.get(state, 0) for state in {*total, *found}}
        return total

    def rows(self, ids: Sequence[str]) -> dict[str, Row]:
        """The jobs and flows of these ids."""
        query, found = self._select("w.workflow_uuid IN :ids"), dict[str, Row]()
        with reading(self.url) as ask:
            for start in range(0, len(ids), 1000):
                found |= {row[0]: _row(row) for row in ask(query, {"ids": list(ids[start : start + 1000])})}
        return found

    def failed(self, run: str, limit: int = 1000) -> list[Row]:
        """The jobs and flows of a run that failed, the oldest first."""
        among = BELOW.replace("workflow_uuid", "w.workflow_uuid")
        query = self._select(f"{among} AND w.status IN {_FAILED} ORDER BY w.created_at LIMIT {int(limit)}")
        return [_row(row) for row in self._rows(query, below(check_id(run)))]

    def runs(self) -> list[str]:
        """Ids of the drivers, the newest first."""
        query = (
            f"SELECT workflow_uuid FROM {self._status} WHERE name = 'flow' AND workflow_uuid NOT LIKE '%/%' "
            "ORDER BY created_at DESC"
        )
        return [row[0] for row in self._rows(query, {})]

    def figures(self, run: str | None = None) -> Figures:
        """Everything that `gnmreg status` shows."""
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
        done, since = last[0]
        return Figures(
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
    """How many of the counted have ended, one way or another."""
    return sum(counts.get(state, 0) for state in (DONE, FAILED, CANCELLED))


def _by_state(rows: Sequence[Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for status, count in rows:
        state = STATES.get(status, status)
        counts[state] = counts.get(state, 0) + int(count)
    return counts


def _row(row: Any) -> Row:
    identity, kind, status, executor, inputs, output, error, created, ended_ms = row
    state = STATES.get(status, status)
    dead = DEAD if status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED" else ""
    return Row(
        id=identity,
        kind=kind,
        state=state,
        executor=executor,
        spec=_loaded(inputs, {"args": [{}]})["args"][0],
        result=_loaded(output, None),
        failure=_failure(error, dead) if state == FAILED else None,
        created=created / 1000,
        ended=ended_ms / 1000 if ended_ms else None,
    )


def _failure(error: str | None, dead: str) -> dict[str, Any]:
    record = _loaded(error, {}).get("error") if error else None
    if isinstance(record, dict):
        return {"status": "failed", "reason": "", **record}
    return {"status": "dead", "reason": dead} if dead else {"status": "failed", "reason": str(error)}


def _loaded(text: str | None, otherwise: Any) -> Any:
    try:
        return json.loads(text) if text else otherwise
    except ValueError:
        return otherwise
