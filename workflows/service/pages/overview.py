"""The first page: throughput, expected end, queue, workers, failures, runs."""

import time
from collections.abc import Iterable, Sequence
from typing import Any

from fastapi import APIRouter, Depends, Request
from starlette.responses import Response

from workflows.engine.metrics import QueueMetrics
from workflows.engine.reader import CANCELLED, DONE, FAILED, INTERRUPTED, RUNNING, WAITING
from workflows.farm.status import CAPTURES_PER_DAY, is_coordinator, remarks, stage_of
from workflows.ids import redact
from workflows.service.access import need
from workflows.service.api.jobs import list_runs
from workflows.service.board import Entry
from workflows.service.pages.base import page
from workflows.service.state import Service, ServiceState

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
STATES = (DONE, RUNNING, WAITING, INTERRUPTED, FAILED, CANCELLED)
HOURS = 24
MAX_FAILURES, MAX_RUNS, MAX_WORKERS = 20, 50, 64  # that are listed


@router.get("/")
def overview(state: Service, request: Request) -> Response:
    """Show the farm."""
    figures = state.metrics()
    done = _by_hour(state.board.entries.values())
    last_day = sum(done)
    runs = list_runs(state)
    return page(
        request,
        "overview.html",
        target=CAPTURES_PER_DAY,
        figures=figures,
        unit="captures" if figures.captures else "jobs",
        last_day=last_day,
        hours=_columns(done),
        ends=None if figures.left_s is None else time.time() + figures.left_s,
        queue=[(name, figures.counts.get(name, 0)) for name in STATES],
        total=sum(figures.counts.values()),
        workers=list(_workers(state, figures))[:MAX_WORKERS],
        processes=len(figures.processes),
        remarks=[redact(line) for line in remarks(figures)],
        failures=figures.failures[:MAX_FAILURES],
        more_failures=max(0, len(figures.failures) - MAX_FAILURES),
        runs=runs[:MAX_RUNS],
        more_runs=max(0, len(runs) - MAX_RUNS),
        silent_s=round(time.time() - state.board.answered),
        now=time.time(),
    )


def _workers(state: ServiceState, figures: QueueMetrics) -> Iterable[dict[str, Any]]:
    """What every process does."""
    logs, by_executor = state.settings.folder / "logs", {row.executor: row for row in figures.running}
    for name in figures.processes:
        row = by_executor.get(name)
        idle = "coordinates" if is_coordinator(name) else "idle"
        yield {
            "name": name,
            "job": "" if row is None else row.id,
            "stage": idle if row is None else redact(stage_of(row, logs)),
            "since": None if row is None else row.since,
        }


def _by_hour(entries: Iterable[Entry]) -> list[int]:
    """Captures, or jobs if no job registers one, that were done in each of the last 24 hours, the latest last."""
    now, captures, jobs = time.time(), [0] * HOURS, [0] * HOURS
    for entry in entries:
        times = entry.times
        if times.kind == "job" and times.state == DONE and times.ended and times.ended > now - HOURS * 3600:
            hour = min(HOURS - 1, max(0, HOURS - 1 - int((now - times.ended) / 3600)))
            jobs[hour] += 1
            captures[hour] += times.captures
    return captures if any(captures) else jobs


def _columns(counts: Sequence[int]) -> list[tuple[float, str]]:
    most = max(*counts, 1)
    return [(count / most, f"{HOURS - k} h ago: {count}") for k, count in enumerate(counts)]
