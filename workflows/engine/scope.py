"""What a flow may do. Everything here is durable: a flow that is started again walks past what is done already."""

import asyncio
import json
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

from workflows.engine.client import CHUNK, Queue
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.reader import CANCELLED, DONE, FAILED, Reader, Row, ended
from workflows.engine.serialization import JobFailed

log = logging.getLogger("gnmreg")

LOOK_S, SELDOM_S = 1.0, 5.0  # between two looks at the counts: at first, and when it takes long
AGAIN_S = 2.0  # after which a database that did not answer is asked again

T = TypeVar("T")
_UNREACHABLE = (sqlite3.OperationalError, psycopg.OperationalError, psycopg.InterfaceError)


class Scope:
    """Handed to a flow as its first argument."""

    def __init__(self, url: str) -> None:
        self.id = str(DBOS.workflow_id)  # of the flow: the ids of what it makes begin with it
        self._url = url

    async def put(self, jobs: Sequence[Job | FlowJob]) -> None:
        """Put jobs into their queues, 1,000 with one transaction and one step."""
        for start in range(0, len(jobs), CHUNK):
            await self._step(f"put {start}", _put, self._url, list(jobs[start : start + CHUNK]))

    async def wait(self, jobs: Sequence[Job | FlowJob]) -> dict[str, int]:
        """Wait, in one step that counts, until all of the jobs have ended, and return state -> how many."""
        counts: dict[str, int] = await self._step("wait", _counted, self._url, [job.id for job in jobs])
        return counts

    async def wait_below(self, part: str) -> dict[str, int]:
        """Like `wait` for all jobs that lie in the queue below an id: no list of ids is needed."""
        counts: dict[str, int] = await self._step("wait", _counted_below, self._url, part)
        return counts

    async def do(self, jobs: Sequence[Job | FlowJob]) -> dict[str, Any]:
        """Put, wait, and return id -> result of those that were done; what is missing failed."""
        await self.put(jobs)
        await self.wait(jobs)
        results: dict[str, Any] = await self._step("results", _results, self._url, [job.id for job in jobs])
        return results

    async def failures(self, jobs: Sequence[Job | FlowJob]) -> dict[str, str]:
        """Why those of the jobs that failed, or were cancelled, did: id -> reason."""
        reasons: dict[str, str] = await self._step("failures", _failures, self._url, [job.id for job in jobs])
        return reasons

    async def read(self, file: str) -> Any:
        """A JSON file, as it is now and for the rest of this flow's life."""
        return await self._step("read", _read, file)

    async def tell(self, key: str, value: Any) -> None:
        """Leave a small value under a key for whoever watches."""
        await DBOS.set_event_async(key, value)

    def park(self, reason: str) -> JobFailed:
        """The error to raise when the run should stop until a person retries it."""
        return JobFailed({"status": "parked", "reason": reason})

    async def _step(self, name: str, function: Any, *arguments: Any) -> Any:
        options = {"name": name, "preemptible": True}
        return await DBOS.run_step_async(options, function, *arguments)  # type: ignore[call-overload]


async def _put(url: str, jobs: list[Job | FlowJob]) -> int:
    def put() -> int:
        queue = Queue(url, known=True)
        try:
            return queue.put(jobs)
        finally:
            queue.close()

    return await _patiently(put)


async def _counted(url: str, ids: list[str]) -> dict[str, int]:
    return await _polled(url, lambda reader: reader.counts_of(ids), lambda counts: ended(counts) >= len(ids))


async def _counted_below(url: str, part: str) -> dict[str, int]:
    count = partial(Reader.counts, run=part, kind="job")
    return await _polled(url, count, lambda counts: ended(counts) == sum(counts.values()))


async def _polled(
    url: str, count: Callable[[Reader], dict[str, int]], over: Callable[[dict[str, int]], bool]
) -> dict[str, int]:
    reader, pause = Reader(url, known=True), LOOK_S
    while True:
        counts = await _patiently(partial(count, reader))
        if over(counts):
            return counts
        await asyncio.sleep(pause * random.uniform(0.8, 1.2))
        pause = min(1.2 * pause, SELDOM_S)


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
    return json.loads(await asyncio.to_thread(Path(file).read_text, "utf-8"))


async def _rows(url: str, ids: list[str]) -> dict[str, Row]:
    return await _patiently(lambda: Reader(url, known=True).rows(ids))


async def _patiently(ask: Callable[[], T]) -> T:
    """The answer of the database, however long it takes to come back: a restart of the server must end no flow."""
    while True:
        try:
            return await asyncio.to_thread(ask)
        except (sa.exc.OperationalError, sa.exc.InterfaceError, *_UNREACHABLE) as error:
            first, *_ = str(getattr(error, "orig", error)).splitlines() or [""]
            log.warning("the queue's database does not answer, waiting: %s", first)
            await asyncio.sleep(AGAIN_S)


def _value(row: Row) -> Any:
    """What a step or a flow returned; a job's outcome wraps it."""
    return row.result.get("result") if row.kind == "job" and row.result is not None else row.result
