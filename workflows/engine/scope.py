"""Operations of a flow. All are durable: a restarted flow gets the stored results of what it did before."""

import asyncio
import logging
import random
import sqlite3
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import psycopg
import sqlalchemy as sa
from dbos import DBOS

from registration.errors import InputError
from registration.storage.reading import read_json
from workflows.engine.client import CHUNK, QueueClient
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.reader import CANCELLED, DONE, FAILED, JobRow, QueueReader, ended
from workflows.engine.serialization import JobFailed

log = logging.getLogger("gnmreg")

POLL_S, SLOW_POLL_S = 1.0, 5.0  # between two counts: at first, and later on
RETRY_S = 2.0  # before the next try when the database does not answer

T = TypeVar("T")
_UNREACHABLE = (sqlite3.OperationalError, psycopg.OperationalError, psycopg.InterfaceError)


class FlowScope:
    """The first argument of a flow."""

    def __init__(self, url: str) -> None:
        self.id = str(DBOS.workflow_id)  # of the flow: the ids of its jobs begin with it
        self._url = url

    async def submit(self, jobs: Sequence[Job | FlowJob]) -> None:
        """Put jobs into their queues, 1,000 per transaction and step."""
        for start in range(0, len(jobs), CHUNK):
            await self._step(f"put {start}", _submit, self._url, list(jobs[start : start + CHUNK]))

    async def wait(self, jobs: Sequence[Job | FlowJob]) -> dict[str, int]:
        """Wait until all of the jobs have ended, and return state -> number of jobs."""
        counts: dict[str, int] = await self._step("wait", _wait, self._url, [job.id for job in jobs])
        return counts

    async def wait_below(self, part: str) -> dict[str, int]:
        """Wait like `wait` for all jobs in the queue below an id, without a list of ids."""
        counts: dict[str, int] = await self._step("wait", _wait_below, self._url, part)
        return counts

    async def run(self, jobs: Sequence[Job | FlowJob]) -> dict[str, Any]:
        """Submit, wait, and return id -> result of those that succeeded; jobs that are missing failed."""
        await self.submit(jobs)
        await self.wait(jobs)
        results: dict[str, Any] = await self._step("results", _results, self._url, [job.id for job in jobs])
        return results

    async def failures(self, jobs: Sequence[Job | FlowJob]) -> dict[str, str]:
        """Return id -> reason of those of the jobs that failed or were cancelled."""
        reasons: dict[str, str] = await self._step("failures", _failures, self._url, [job.id for job in jobs])
        return reasons

    async def read(self, file: str) -> Any:
        """Return a JSON file's content at the first call; later calls of this flow return the same."""
        return await self._step("read", _read, file)

    def park(self, reason: str) -> JobFailed:
        """Return the error to raise when the run is to stop until an operator retries it."""
        return JobFailed({"status": "parked", "reason": reason})

    async def _step(self, name: str, function: Any, *arguments: Any) -> Any:
        options = {"name": name, "preemptible": True}
        return await DBOS.run_step_async(options, function, *arguments)  # type: ignore[call-overload]


async def _submit(url: str, jobs: list[Job | FlowJob]) -> int:
    def submit() -> int:
        queue = QueueClient(url, known=True)
        try:
            return queue.submit(jobs)
        finally:
            queue.close()

    return await _retry_until_answered(submit)


async def _wait(url: str, ids: list[str]) -> dict[str, int]:
    return await _poll(url, lambda reader: reader.counts_of(ids), lambda counts: ended(counts) >= len(ids))


async def _wait_below(url: str, part: str) -> dict[str, int]:
    count = partial(QueueReader.counts, run=part, kind="job")
    return await _poll(url, count, lambda counts: ended(counts) == sum(counts.values()))


async def _poll(
    url: str, count: Callable[[QueueReader], dict[str, int]], is_over: Callable[[dict[str, int]], bool]
) -> dict[str, int]:
    reader, pause = QueueReader(url, known=True), POLL_S
    while True:
        counts = await _retry_until_answered(partial(count, reader))
        if is_over(counts):
            return counts
        await asyncio.sleep(pause * random.uniform(0.8, 1.2))
        pause = min(1.2 * pause, SLOW_POLL_S)


async def _results(url: str, ids: list[str]) -> dict[str, Any]:
    rows = await _rows(url, ids)
    return {identity: _value(row) for identity, row in rows.items() if row.state == DONE}


async def _failures(url: str, ids: list[str]) -> dict[str, str]:
    rows = await _rows(url, ids)
    return {
        identity: f"{row.failure['status']}: {row.failure['reason']}" if row.failure else row.state
        for identity, row in rows.items()
        if row.state in (FAILED, CANCELLED)
    }


async def _read(file: str) -> Any:
    refuse = partial(InputError, "The flow's file cannot be read", where=file, fix="submit the run again")
    return await asyncio.to_thread(read_json, Path(file), refuse)


async def _rows(url: str, ids: list[str]) -> dict[str, JobRow]:
    return await _retry_until_answered(lambda: QueueReader(url, known=True).rows(ids))


async def _retry_until_answered(ask: Callable[[], T]) -> T:
    """Return the database's answer, however long that takes: a restart of the server must not end a flow."""
    while True:
        try:
            return await asyncio.to_thread(ask)
        except (sa.exc.OperationalError, sa.exc.InterfaceError, *_UNREACHABLE) as error:
            first, *_ = str(getattr(error, "orig", error)).splitlines() or [""]
            log.warning("the queue's database does not answer, waiting: %s", first)
            await asyncio.sleep(RETRY_S)


def _value(row: JobRow) -> Any:
    """The returned value of a step or a flow; a job's outcome wraps it."""
    return row.result.get("result") if row.kind == "job" and row.result is not None else row.result
