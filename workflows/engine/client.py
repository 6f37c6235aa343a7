"""Access to the queue without a process: submit jobs, cancel a run, retry failed jobs, delete old iterations."""

import json
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import sqlalchemy as sa
from dbos import DBOSClient, EnqueueOptions

from registration.errors import InputError
from workflows.engine.alive import ended_processes
from workflows.engine.database import BELOW, below, checked_url, engine, require_queue, table
from workflows.engine.jobs import MAX_BYTES, VERSION, FlowJob, Job
from workflows.engine.log_output import configure_logging
from workflows.engine.reader import number
from workflows.engine.serialization import APPLICATION, JsonSerializer, UnreadableRow
from workflows.ids import check_id

CHUNK = 1000  # jobs submitted in one transaction
ACTIVE = ("ENQUEUED", "PENDING", "DELAYED")
WAITING = ("ENQUEUED", "DELAYED")
FAILED = ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED")
MAX_PRIORITY = 1000
SETTLE_S = 4.0  # within which a worker has noticed that its job was cancelled
_ITERATION = re.compile(r"^[^/]+/(it[0-9]+)(?:/|$)")


@dataclass(frozen=True, kw_only=True)
class Submission:
    """Numbers of the jobs of a submission."""

    new: int = 0
    again: int = 0  # had ended, or waited with other arguments
    waiting: int = 0  # waited or ran with these arguments

    @property
    def total(self) -> int:
        return self.new + self.again + self.waiting


class QueueClient:
    """A connection to the queue's database."""

    def __init__(self, url: str, *, known: bool = False) -> None:
        """Open a queue that `migrate` created. Raises InputError if there is none, which `known` does not check."""
        self.url = checked_url(url)
        if not known:
            require_queue(self.url)
        self._engine = engine(self.url)
        configure_logging()
        self._client = DBOSClient(
            system_database_engine=self._engine,
            serializer=JsonSerializer(),
            application_name=APPLICATION,
            use_listen_notify=False,
        )

    def close(self) -> None:
        self._client.destroy()
        self._engine.dispose()

    def submit(self, jobs: Iterable[Job | FlowJob]) -> int:
        """Put jobs into their queues and return their number. A job whose id exists is left unchanged.

        Raises:
            InputError: an id is invalid, or arguments are not JSON or too large.
        """
        count = 0
        for chunk in _chunks(jobs):
            for job in chunk:
                _check(job)
            with self._engine.begin() as connection:
                for job in chunk:
                    self._client.enqueue_in_transaction(connection, _options(job), job.spec(), queue=job.queue)
            count += len(chunk)
        return count

    def resubmit(self, jobs: Iterable[Job | FlowJob]) -> Submission:
        """Put jobs into their queues like `submit`, also those that have ended, and all with these arguments.

        A step returns at once if its product has the same inputs, so that only what changed is computed again.

        Raises:
            InputError: as `submit`, or a job runs with other arguments; the jobs before its thousand are submitted.
        """
        total = Submission()
        for chunk in _chunks(jobs):
            for job in chunk:
                _check(job)
            self._wait_for_cancelled([job.id for job in chunk])
            with self._engine.begin() as connection:
                specs = self._specs(connection, [job.id for job in chunk])
                left = self._make_room(connection, chunk, specs)
                put = [job for job in chunk if job.id not in left]
                for job in put:
                    self._client.enqueue_in_transaction(connection, _options(job), job.spec(), queue=job.queue)
            again = sum(job.id in specs for job in put)
            total = Submission(
                new=total.new + len(put) - again, again=total.again + again, waiting=total.waiting + len(left)
            )
        return total

    def cancel(self, run: str) -> int:
        """Cancel a run, or a part of it, including running jobs, and return the number of jobs and flows.

        The driver is cancelled first, so that it submits no new jobs; repeated until nothing is active.
        """
        cancelled = 0
        while ids := self._ids(run, ACTIVE):
            for chunk in _chunks(ids):
                self._client.cancel_workflows(chunk)
            cancelled += len(ids)
        return cancelled

    def prioritize(self, run: str, priority: int) -> int:
        """Give the waiting jobs of a run, or of a part of it, a priority; return their number.

        Args:
            run: id of the run or part.
            priority: the lowest number is taken first.

        Raises:
            InputError: the priority is out of range.
        """
        if not 1 <= priority <= MAX_PRIORITY:
            expected = f"1 to {MAX_PRIORITY}, the lowest first"
            raise InputError("The priority is out of range", where="priority", expected=expected, got=priority)
        update = sa.text(
            f"UPDATE {table(self.url, 'workflow_status')} SET priority = :priority, updated_at = :now "
            f"WHERE {BELOW} AND status IN {WAITING} AND name = 'job'"
        )
        with self._engine.begin() as connection:
            values = {**below(check_id(run)), "priority": priority, "now": int(time.time() * 1000)}
            return connection.execute(update, values).rowcount

    def retry(self, run: str, *, failed: bool = True, cancelled: bool = False) -> list[str]:
        """Requeue the failed jobs of a run and their dependents, under their ids. Returns the ids.

        Dependents are the flows above a failed job, from their start, and those of their jobs that were submitted
        after it ended, such as the record of a subject after a failed expression. Steps with unchanged inputs return
        at once. Of a run with iterations only the last one is retried: the others' models are superseded.

        Args:
            run: id of the run.
            failed: retry failed jobs.
            cancelled: retry cancelled jobs.
        """
        rows = self._rows(check_id(run))
        iterations = [row["iteration"] for row in rows.values() if row["iteration"]]
        last = max(iterations, default="")
        statuses = (*(FAILED if failed else ()), *(("CANCELLED",) if cancelled else ()))
        selected = {i: r for i, r in rows.items() if r["status"] in statuses and r["iteration"] in ("", last)}
        chosen = set(selected)
        for identity, row in selected.items():
            above = [i for i in _ancestors(identity) if i in rows]
            chosen |= {i for i in above if rows[i]["status"] not in ACTIVE}
            chosen |= {
                i
                for i, r in rows.items()
                if r["name"] == "job"
                and r["status"] == "SUCCESS"
                and r["created"] >= (row["ended"] or 0)
                and _nearest(i, rows) in above
            }
        ordered = sorted(chosen, key=lambda i: (-i.count("/"), i))  # jobs before the flows that wait for them
        self._wait_for_cancelled(ordered)
        queues = self._queues(ordered)
        ordered = [identity for identity in ordered if identity in queues]
        for identity in ordered:
            self._client.rewind_workflow(
                identity, start_step=1, queue_name=queues[identity], application_version=VERSION
            )
        return ordered

    def forget(self, part: str) -> int:
        """Delete the rows of a run, or of one of its iterations, and return their number.

        Raises:
            InputError: some of its jobs have not ended.
        """
        if running := self._ids(part, ACTIVE):
            raise InputError(
                "The jobs have not ended",
                where=part,
                expected="a run or an iteration that has ended",
                got=f"{len(running)} waiting or running",
                fix="wait, or cancel it first",
            )
        ids = self._ids(part, ())
        self._wait_for_cancelled(ids)
        for chunk in _chunks(ids):
            self._client.delete_workflows(chunk)
        return len(ids)

    def _make_room(
        self, connection: sa.Connection, jobs: Sequence[Job | FlowJob], specs: Mapping[str, Any]
    ) -> set[str]:
        """Delete the rows of jobs that ended, or wait with other arguments; return the ids of those that stay."""
        known = [job.id for job in jobs if job.id in specs]
        changed = {job.id for job in jobs if job.id in specs and specs[job.id] != _stored(job)}
        status = table(self.url, "workflow_status")

        def execute(query: str, ids: Iterable[str], **values: Any) -> Any:
            text = sa.text(query).bindparams(sa.bindparam("ids", expanding=True, type_=sa.Text()))
            return connection.execute(text, {"ids": list(ids), **values})

        execute(f"DELETE FROM {status} WHERE workflow_uuid IN :ids AND status NOT IN {ACTIVE}", known)
        execute(f"DELETE FROM {status} WHERE workflow_uuid IN :ids AND status IN {WAITING}", changed)
        query = f"SELECT workflow_uuid, executor_id FROM {status} WHERE workflow_uuid IN :ids"
        running = {identity: str(executor) for identity, executor in execute(query, changed)}
        dead = ended_processes(self.url, running.values())
        for name in dead:
            execute(
                f"DELETE FROM {status} WHERE workflow_uuid IN :ids AND executor_id = :name",
                [identity for identity, executor in running.items() if executor == name],
                name=name,
            )
        if busy := sorted(identity for identity, executor in running.items() if executor not in dead):
            raise InputError(
                "Jobs run with other settings",
                where=busy[0],
                expected="jobs that wait or have ended, or the settings that they run with",
                got=f"{len(busy)} running",
                fix=f"wait, or `gnmreg cancel {busy[0].partition('/')[0]}` first, or name another run with --run",
            )
        left = {row[0] for row in execute(query, known)}
        deleted = [identity for identity in known if identity not in left]
        for name in ("workflow_input", "workflow_output", "operation_outputs"):  # no foreign keys lead to the rows
            execute(f"DELETE FROM {table(self.url, name)} WHERE workflow_uuid IN :ids", deleted)
        return left

    def _specs(self, connection: sa.Connection, ids: Sequence[str]) -> dict[str, Any]:
        """Id -> version and arguments of those of the ids that are in the queue."""
        query = sa.text(
            "SELECT w.workflow_uuid, w.application_version, coalesce(i.inputs, w.inputs) "
            f"FROM {table(self.url, 'workflow_status')} w "
            f"LEFT JOIN {table(self.url, 'workflow_input')} i ON i.workflow_uuid = w.workflow_uuid "
            "WHERE w.workflow_uuid IN :ids"
        ).bindparams(sa.bindparam("ids", expanding=True, type_=sa.Text()))
        rows = connection.execute(query, {"ids": list(ids)})
        return {identity: (version, _spec(inputs)) for identity, version, inputs in rows}

    def _wait_for_cancelled(self, ids: Sequence[str]) -> None:
        """Wait until the workers of jobs that were cancelled a moment ago have noticed.

        A worker looks for the state "cancelled" once a second. If it found the job waiting again, it would keep on,
        with the arguments that were cancelled.
        """
        query = sa.text(
            f"SELECT executor_id, max(completed_at) FROM {table(self.url, 'workflow_status')} "
            "WHERE status = 'CANCELLED' AND executor_id IS NOT NULL AND workflow_uuid IN :ids GROUP BY executor_id"
        ).bindparams(sa.bindparam("ids", expanding=True, type_=sa.Text()))
        last: dict[str, float] = {}
        with self._engine.connect() as connection:
            for chunk in _chunks(ids):
                for name, cancelled in connection.execute(query, {"ids": chunk}):
                    last[str(name)] = max(last.get(str(name), 0.0), number(cancelled) / 1000)
        living = set(last) - ended_processes(self.url, last)
        pause_s = max((last[name] + SETTLE_S - time.time() for name in living), default=0.0)
        time.sleep(min(SETTLE_S, max(0.0, pause_s)))

    def _ids(self, run: str, statuses: Sequence[str]) -> list[str]:
        """Ids of a run in the given states (none given: in any), the shortest first."""
        rows = self._rows(check_id(run))
        ids = [i for i, row in rows.items() if not statuses or row["status"] in statuses]
        return sorted(ids, key=lambda i: (len(i), i))

    def _rows(self, run: str) -> dict[str, dict[str, Any]]:
        query = sa.text(
            f"SELECT workflow_uuid, name, status, created_at, completed_at FROM {table(self.url, 'workflow_status')} "
            f"WHERE {BELOW}"
        )
        with self._engine.connect() as connection:
            return {
                identity: {
                    "name": name,
                    "status": status,
                    "created": number(created),
                    "ended": number(ended),
                    "iteration": match[0] if (match := _ITERATION.findall(identity)) else "",
                }
                for identity, name, status, created, ended in connection.execute(query, below(run))
            }

    def _queues(self, ids: Sequence[str]) -> dict[str, str]:
        """The queue of each job, from its input: rows of dead and cancelled jobs have lost it.

        Rows without one were not written by this package: they cannot run, and are left out.
        """
        queues = {}
        query = sa.text(
            f"SELECT w.workflow_uuid, coalesce(i.inputs, w.inputs) FROM {table(self.url, 'workflow_status')} w "
            f"LEFT JOIN {table(self.url, 'workflow_input')} i ON i.workflow_uuid = w.workflow_uuid "
            "WHERE w.workflow_uuid IN :ids"
        ).bindparams(sa.bindparam("ids", expanding=True, type_=sa.Text()))
        with self._engine.connect() as connection:
            for chunk in _chunks(ids):
                for identity, inputs in connection.execute(query, {"ids": chunk}):
                    if queue := _queue(inputs):
                        queues[identity] = queue
        return queues


def _queue(inputs: Any) -> str | None:
    try:
        queue = JsonSerializer().deserialize(inputs)["kwargs"]["queue"]
    except (UnreadableRow, TypeError, KeyError):
        return None
    return queue if isinstance(queue, str) else None


def _spec(inputs: Any) -> Any:
    """A job's specification in a row; None in a row that this package did not write."""
    try:
        return JsonSerializer().deserialize(inputs)["args"][0]
    except (UnreadableRow, TypeError, KeyError, IndexError):
        return None


def _stored(job: Job | FlowJob) -> tuple[str, Any]:
    """What `_specs` returns for a job that was just submitted."""
    return VERSION, json.loads(json.dumps(job.spec()))


def _ancestors(identity: str) -> list[str]:
    """The ids above an id, the nearest first."""
    parts = identity.split("/")
    return ["/".join(parts[:n]) for n in range(len(parts) - 1, 0, -1)]


def _nearest(identity: str, rows: Mapping[str, Any]) -> str | None:
    """The flow that a job belongs to."""
    return next((i for i in _ancestors(identity) if i in rows), None)


def _options(job: Job | FlowJob) -> EnqueueOptions:
    return {
        "workflow_name": "job" if isinstance(job, Job) else "flow",
        "queue_name": job.queue,
        "workflow_id": job.id,
        "app_version": VERSION,
        "priority": job.priority,
    }


def _check(job: Job | FlowJob) -> None:
    check_id(job.id)
    try:
        size = len(json.dumps(job.spec(), allow_nan=False))
    except (TypeError, ValueError) as error:
        size, problem = 0, str(error)
    else:
        problem = f"{size} bytes" if size > MAX_BYTES else ""
    if problem:
        raise InputError(
            "The job cannot be put into the queue",
            where=job.id,
            expected=f"arguments as JSON of at most {MAX_BYTES} bytes",
            got=problem,
            fix="pass paths, not data",
        )


def _chunks(items: Iterable[Any]) -> Iterator[list[Any]]:
    iterator = iter(items)
    while chunk := list(islice(iterator, CHUNK)):
        yield chunk
