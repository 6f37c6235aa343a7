"""The state of a queue in figures: counts, throughput, expected end, who works on what."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from workflows.engine.alive import ended_processes, lock_names
from workflows.engine.failures import FailureKind, failure_kinds
from workflows.engine.jobs import VERSION
from workflows.engine.presence import living_processes, uncovered
from workflows.engine.reader import DONE, INTERRUPTED, RUNNING, WAITING, JobRow, JobTimes, QueueReader

DAY_S = 24 * 3600.0
LAST = 1000  # completed jobs that the throughput is measured on


@dataclass(frozen=True, kw_only=True)
class QueueMetrics:
    """Figures of a run, or of the whole queue; of jobs unless stated otherwise."""

    counts: dict[str, int]  # state -> jobs
    flows: dict[str, int]  # state -> flows
    captures: bool  # whether the throughput counts registrations of captures only, or all jobs
    ended_last_hour: int
    a_day: float  # completed in a day of work, from the last 1,000
    left: int  # that wait, run or are interrupted, of those that the throughput counts
    failures: tuple[FailureKind, ...]
    running: tuple[JobRow, ...]
    processes: tuple[str, ...]  # executor ids of the processes that live
    uncovered: tuple[str, ...]  # waiting jobs that every worker of their queue leaves: they lie outside its roots
    unserved: tuple[str, ...]  # queues with waiting jobs that no process serves
    foreign: tuple[str, ...]  # versions of waiting jobs that processes of this release do not take

    @property
    def left_s(self) -> float | None:
        """Seconds until the last of the jobs in the queue ends, at the same throughput; None: it cannot be said."""
        return self.left * DAY_S / self.a_day if self.left and self.a_day and self.running else None


def queue_metrics(reader: QueueReader, run: str | None = None) -> QueueMetrics:
    """Return the figures of a run, of a part of it, or of the whole queue."""
    return metrics_of(reader, reader.times(run))


def metrics_of(reader: QueueReader, rows: Sequence[JobTimes]) -> QueueMetrics:
    """Return the figures of jobs and flows that were read from a queue."""
    jobs = [row for row in rows if row.kind == "job"]
    registrations = [row for row in jobs if row.captures]
    counted = registrations or jobs
    known = {row.executor for row in rows if row.executor} | lock_names(reader.url)
    living = living_processes(reader.url)
    waiting = {row.id: row.queue for row in rows if row.state == WAITING}
    served = {queue for process in living for queue in process.queues}
    running = [row.id for row in jobs if row.state == RUNNING]
    return QueueMetrics(
        counts=_counts(jobs),
        flows=_counts([row for row in rows if row.kind == "flow"]),
        captures=bool(registrations),
        ended_last_hour=sum(row.ended is not None and row.ended > time.time() - 3600 for row in jobs),
        a_day=_a_day(counted),
        left=sum(row.state in (WAITING, RUNNING, INTERRUPTED) for row in counted),
        failures=tuple(failure_kinds(jobs)),
        running=tuple(reader.rows(running).values()),
        processes=tuple(sorted({p.name for p in living} | (known - ended_processes(reader.url, known)))),
        uncovered=tuple(uncovered(living, waiting)),
        unserved=tuple(sorted({queue for queue in waiting.values() if served and queue and queue not in served})),
        foreign=tuple(sorted({row.version for row in rows if row.state == WAITING and row.version} - {VERSION})),
    )


def _counts(rows: Iterable[JobTimes]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for row in rows:
        counts[row.state] = counts.get(row.state, 0) + 1
    return counts


def _a_day(jobs: Sequence[JobTimes]) -> float:
    """Completed jobs in a day of working time: the time in which at least one of the last ones was at work.

    Nights without work do not count, nor do results that were there already.
    """
    spans = [(row.started, row.ended) for row in jobs if row.state == DONE and row.started and row.ended and row.made]
    spans = sorted(spans, key=lambda span: span[1])[-LAST:]
    working_s, until = 0.0, 0.0
    for start, end in sorted(spans):
        working_s += max(0.0, end - max(start, until))
        until = max(until, end)
    return len(spans) * DAY_S / max(working_s, 1e-3) if spans else 0.0
