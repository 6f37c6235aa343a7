"""Which waiting jobs a worker takes: those whose paths lie below its roots. It leaves the others to other workers.

What each worker leaves is in a table of the queue's database, so that `gnmreg status` can say what nobody takes.
"""

import json
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa
from dbos._sys_db import SystemDatabase

from registration.errors import InputError
from workflows.engine.database import Ask, engine, is_sqlite, reading, table
from workflows.engine.jobs import VERSION, Step, validate_arguments
from workflows.engine.presence import WORKERS, has_workers_table
from workflows.engine.serialization import JsonSerializer, UnreadableRow
from workflows.ids import OutsideRoots

PAGE = 50  # waiting jobs that are looked at together
MAX_PAUSE_S = 5.0  # between two searches that find nothing but jobs of others
SHARE = 0.05  # largest part of the time that is spent on such searches
MAX_LEFT = 1000  # ids that are reported


class Coverage:
    """The jobs that one worker takes or leaves."""

    def __init__(self, url: str, steps: Mapping[str, Step], roots: Sequence[str]) -> None:
        """Nothing is read yet.

        Args:
            url: of the queue's database.
            steps: the table of steps.
            roots: as `resolve_roots` returns them.
        """
        self._url, self._steps, self._roots = url, steps, tuple(roots)
        self._left: dict[str, dict[str, Any]] = {}  # queue -> id -> when the job was submitted
        self._next_s: dict[str, float] = {}  # queue -> time of the next search

    @property
    def left(self) -> list[str]:
        """Ids of waiting jobs that were left to others, some of them if there are very many."""
        return sorted(identity for left in self._left.values() for identity in left)[:MAX_LEFT]

    def first(self, queue: str, ask: Ask) -> list[str]:
        """Return the ids of the first jobs waiting in a queue that this worker takes, at most a page of them."""
        start_s = time.monotonic()
        if start_s < self._next_s.get(queue, 0.0):
            return []
        offset, seen, covered = 0, set[str](), list[str]()
        left = self._left.get(queue, {})
        while not covered:
            page = ask(_WAITING.format(table(self._url, "workflow_status")), self._page(queue, offset))
            seen |= {row[0] for row in page}
            unknown = [row for row in page if left.get(row[0]) != row[1]]
            outside = self._outside([row[0] for row in unknown], ask)
            left |= {identity: created for identity, created in unknown if identity in outside}
            covered = [identity for identity, _ in unknown if identity not in outside]
            if len(page) < PAGE:
                break
            offset += PAGE
        if not covered:
            left = {identity: created for identity, created in left.items() if identity in seen}
            pause_s = min(MAX_PAUSE_S, (time.monotonic() - start_s) / SHARE) if seen else 0.0
            self._next_s[queue] = time.monotonic() + pause_s
        self._left[queue] = left
        return covered

    def _page(self, queue: str, offset: int) -> dict[str, Any]:
        return {"queue": queue, "version": VERSION, "count": PAGE, "offset": offset}

    def _outside(self, ids: Sequence[str], ask: Ask) -> set[str]:
        """Those of the jobs whose paths lie outside the roots. What is wrong otherwise is refused when it is taken."""
        if not ids:
            return set()
        names = [table(self._url, name) for name in ("workflow_status", "workflow_input")]
        outside = set()
        for identity, inputs in ask(_INPUTS.format(*names), {"ids": list(ids)}):
            try:
                validate_arguments(JsonSerializer().deserialize(inputs)["args"][0], self._steps, self._roots)
            except OutsideRoots:
                outside.add(identity)
            except (InputError, UnreadableRow, TypeError, KeyError, IndexError):
                pass
        return outside


def take_covered_jobs_only(coverage: Coverage, url: str) -> None:
    """Make this process take from its queues only what `coverage` finds. Call it before DBOS is launched."""
    start, chosen = SystemDatabase.start_queued_workflows, threading.local()

    def start_covered(self: SystemDatabase, queue: Any, *arguments: Any, **named: Any) -> Any:
        running = arguments[3] if len(arguments) > 3 else named.get("local_running_count", 0)
        chosen.ids = []
        if queue._worker_concurrency is None or running < queue._worker_concurrency:
            with _asking(self, url) as ask:
                chosen.ids = coverage.first(queue.name, ask)
        return start(self, queue, *arguments, **named)

    def gate(self: SystemDatabase, *_: Any) -> list[Any]:
        return [self.tables.workflow_status.c.workflow_uuid.in_(getattr(chosen, "ids", []))]

    SystemDatabase.start_queued_workflows = start_covered  # type: ignore[method-assign]
    SystemDatabase._claim_gate = gate  # type: ignore[method-assign, assignment]


def publish_worker(url: str, name: str, about: Mapping[str, Any]) -> None:
    """Write what `gnmreg status` says of a process, into the table that `create_workers_table` made."""
    query = (
        f"INSERT INTO {table(url, WORKERS)} (name, about) VALUES (:name, :about) "
        "ON CONFLICT (name) DO UPDATE SET about = excluded.about"
    )
    with engine(url).begin() as connection:
        connection.execute(sa.text(query), {"name": name, "about": json.dumps(about)})


def create_workers_table(url: str) -> None:
    """Create the table of workers, unless it is there; several processes may do so at the same time."""
    if has_workers_table(url):
        return
    try:
        with engine(url).begin() as connection:
            connection.execute(
                sa.text(f"CREATE TABLE {table(url, WORKERS)} (name TEXT PRIMARY KEY, about TEXT NOT NULL)")
            )
    except sa.exc.SQLAlchemyError:
        if not has_workers_table(url):
            raise


@contextmanager
def _asking(database: SystemDatabase, url: str) -> Iterator[Ask]:
    """A query function: on PostgreSQL of DBOS's own connections, as a new one each time would be slow."""
    if is_sqlite(url):
        with reading(url) as ask:
            yield ask
        return
    with database.engine.connect() as connection:

        def ask_server(query: str, values: Mapping[str, Any]) -> list[Any]:
            names = [name for name, value in values.items() if isinstance(value, list)]
            lists: list[sa.BindParameter[Any]] = [sa.bindparam(name, expanding=True) for name in names]
            return list(connection.execute(sa.text(query).bindparams(*lists), dict(values)))

        yield ask_server


_WAITING = (
    "SELECT workflow_uuid, created_at FROM {} WHERE queue_name = :queue AND status = 'ENQUEUED' "
    "AND application_version = :version ORDER BY priority, created_at, workflow_uuid LIMIT :count OFFSET :offset"
)
_INPUTS = (
    "SELECT w.workflow_uuid, coalesce(i.inputs, w.inputs) FROM {} w "
    "LEFT JOIN {} i ON i.workflow_uuid = w.workflow_uuid WHERE w.workflow_uuid IN :ids"
)
