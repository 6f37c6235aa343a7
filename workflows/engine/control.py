"""The queue from outside: put jobs in, cancel a run, retry what failed, forget old iterations. No process is needed."""

import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import sqlalchemy as sa
from dbos import DBOSClient, EnqueueOptions

from registration.errors import InputError
from workflows.engine.database import BELOW, below, checked_url, engine, redacted_url, table
from workflows.engine.rows import APPLICATION, VERSION, Json
from workflows.jobs import MAX_BYTES, FlowJob, Job, check_id

CHUNK = 1000  # jobs that are put in with one transaction
ACTIVE = ("ENQUEUED", "PENDING", "DELAYED")
FAILED = ("ERROR", "MAX_RECOVERY_ATTEMPTS_EXCEEDED")


class Queue:
    """A connection to the queue's database."""

    def __init__(self, url: str) -> None:
        """Raises InputError if there is no queue at the URL: `migrate` makes one."""
        self.url = checked_url(url)
        self._engine = engine(self.url)
        try:
            with self._engine.connect() as connection:
                connection.execute(sa.text(f"SELECT 1 FROM {table(self.url, 'workflow_status')} LIMIT 1"))
        except sa.exc.SQLAlchemyError as error:
            self._engine.dispose()
            first, *_ = str(getattr(error, "orig", error)).splitlines() or [""]
            raise InputError(
                "There is no queue",
                where=redacted_url(self.url),
                expected="a database that `gnmreg migrate` prepared",
                got=first,
                fix="check the URL, or run `gnmreg migrate`",
            ) from None
        self._client = DBOSClient(
            system_database_engine=self._engine,
            serializer=Json(),
            application_name=APPLICATION,
            use_listen_notify=False,
        )

    def close(self) -> None:
        self._client.destroy()
        self._engine.dispose()

    def put(self, jobs: Iterable[Job | FlowJob]) -> int:
        """Put jobs in; one whose id is there already is left as it is. Returns how many there were.

        Raises:
            InputError: an id that cannot be used, or arguments that are not JSON or too large.
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

    def cancel(self, run: str) -> int:
        """End a run, or a part of it: nothing more of it starts, and what is running is stopped. Returns how many.

        The driver is cancelled first, so that nothing puts new jobs in; looked for again until nothing is left.
        """
        gone = 0
        while ids := self._ids(run, ACTIVE):
            for chunk in _chunks(ids):
                self._client.cancel_workflows(chunk)
            gone += len(ids)
        return gone

    def retry(self, run: str, *, cancelled: bool = False) -> list[str]:
        """Put everything of a run that failed into its queue again, and the flows above it, in place. Returns the ids.

        Flows start from the beginning: what they made is there, so that they reach the place where they ended at once.
        """
        wanted = (*FAILED, "CANCELLED") if cancelled else FAILED
        failed = self._ids(run, wanted)
        above = {"/".join(parts[:n]) for parts in (i.split("/") for i in failed) for n in range(1, len(parts))}
        flows = [i for i in self._ids(run, ("SUCCESS",), name="flow") if i in above]
        chosen = sorted({*failed, *flows}, key=lambda i: -i.count("/"))  # jobs before the flows that wait for them
        queues = self._queues(chosen)
        for identity in chosen:
            self._client.rewind_workflow(identity, 1, queue_name=queues[identity])
        return chosen

    def forget(self, part: str) -> int:
        """Delete the rows of a run or of an iteration of it that has ended. Returns how many.

        Raises:
            InputError: some of it has not ended.
        """
        if running := self._ids(part, ACTIVE):
            raise InputError(
                "The jobs have not ended",
                where=part,
                expected="a run or an iteration that is over",
                got=f"{len(running)} that wait or run",
                fix="wait, or cancel it first",
            )
        ids = self._ids(part, ())
        for chunk in _chunks(ids):
            self._client.delete_workflows(chunk)
        return len(ids)

    def _ids(self, run: str, statuses: Sequence[str], name: str | None = None) -> list[str]:
        """Ids of a run in the given states (none: in any), the shortest first."""
        query = f"SELECT workflow_uuid FROM {table(self.url, 'workflow_status')} WHERE {BELOW}"
        parameters: dict[str, Any] = below(check_id(run))
        if statuses:
            query += " AND status IN :statuses"
            parameters["statuses"] = list(statuses)
        if name is not None:
            query += " AND name = :name"
            parameters["name"] = name
        text = sa.text(query + " ORDER BY length(workflow_uuid), workflow_uuid")
        if statuses:
            text = text.bindparams(sa.bindparam("statuses", expanding=True))
        with self._engine.connect() as connection:
            return [row[0] for row in connection.execute(text, parameters)]

    def _queues(self, ids: Sequence[str]) -> dict[str, str]:
        """The queue of each job. A dead letter's and a cancelled job's were taken from them, so they lie in the input."""
        found = {}
        query = sa.text(
            f"SELECT w.workflow_uuid, coalesce(i.inputs, w.inputs) FROM {table(self.url, 'workflow_status')} w "
            f"LEFT JOIN {table(self.url, 'workflow_input')} i ON i.workflow_uuid = w.workflow_uuid "
            "WHERE w.workflow_uuid IN :ids"
        ).bindparams(sa.bindparam("ids", expanding=True))
        with self._engine.connect() as connection:
            for chunk in _chunks(ids):
                for identity, inputs in connection.execute(query, {"ids": chunk}):
                    found[identity] = json.loads(inputs)["kwargs"]["queue"]
        return found


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
            fix="hand over paths, not data",
        )


def _chunks(items: Iterable[Any]) -> Iterator[list[Any]]:
    iterator = iter(items)
    while chunk := list(islice(iterator, CHUNK)):
        yield chunk
