"""Figures of the farm for Prometheus, at /metrics: of the queue's state when they are asked for."""

from collections import Counter as Tally
from collections.abc import Iterator, Sequence

from fastapi import APIRouter, Depends
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
    SummaryMetricFamily,
)
from prometheus_client.registry import Collector
from starlette.responses import Response

from workflows.engine.reader import DONE, FAILED, WAITING, JobTimes
from workflows.service.access import need
from workflows.service.state import Service, ServiceState

router = APIRouter(tags=["health"], dependencies=[Depends(need("viewer"))])
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS_S = (5, 10, 20, 40, 60, 120, 240, 480, 960, 1920, 3840)  # of the time that a job takes
MAX_REASON = 80  # letters of a reason: a label's values must stay few
MAX_REASONS = 50


@router.get("/metrics", response_class=Response)
def metrics(state: Service) -> Response:
    """Return the farm's figures in the text format of Prometheus."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Farm(state))
    return Response(generate_latest(registry), media_type=CONTENT_TYPE)


class _Farm(Collector):
    """The figures of one answer."""

    def __init__(self, state: ServiceState) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        figures, board = self._state.metrics(), self._state.board
        jobs = GaugeMetricFamily("gnmreg_jobs", "Jobs in the queue by state", labels=["state"])
        for name, count in sorted(figures.counts.items()):
            jobs.add_metric([name], count)
        yield jobs
        entries = [entry for entry in board.entries.values() if entry.times.kind == "job"]
        depth = Tally(entry.times.queue or "" for entry in entries if entry.times.state == WAITING)
        waiting = GaugeMetricFamily("gnmreg_queue_depth", "Waiting jobs by queue", labels=["queue"])
        for name, count in sorted(depth.items()):
            waiting.add_metric([name], count)
        yield waiting
        results = GaugeMetricFamily("gnmreg_results", "Ended jobs by status and verdict", labels=["status", "verdict"])
        ended = Tally((entry.status, entry.level) for entry in entries if entry.times.state in (DONE, FAILED))
        for (status, verdict), count in sorted(ended.items()):
            results.add_metric([status, verdict], count)
        yield results
        failures = GaugeMetricFamily("gnmreg_failures", "Failed jobs by kind and reason", labels=["kind", "reason"])
        for kind in figures.failures[:MAX_REASONS]:
            failures.add_metric([kind.kind, kind.reason[:MAX_REASON]], len(kind.jobs))
        yield failures
        workers = GaugeMetricFamily("gnmreg_processes_alive", "Workers and coordinators that live", labels=["process"])
        for name in figures.processes:
            workers.add_metric([name], 1)
        yield workers
        yield GaugeMetricFamily(
            "gnmreg_captures_per_day", "Captures in a day of work, of the last 1,000", figures.a_day
        )
        yield GaugeMetricFamily("gnmreg_jobs_left", "Jobs that wait or run", figures.left)
        yield _durations([entry.times for entry in entries])
        stages = SummaryMetricFamily("gnmreg_stage_seconds", "Seconds of registrations by stage", labels=["stage"])
        for name, (count, seconds) in sorted(board.stage_seconds.items()):
            stages.add_metric([name], count_value=count, sum_value=seconds)
        yield stages
        yield GaugeMetricFamily(
            "gnmreg_store_bytes", "Bytes of results in the farm's folder", self._state.store_size.bytes()
        )
        yield CounterMetricFamily("gnmreg_changes", "Changes of the queue that the service saw", board.number)
        yield GaugeMetricFamily(
            "gnmreg_queue_answered_timestamp_seconds", "When the queue last answered", board.answered
        )


def _durations(jobs: Sequence[JobTimes]) -> Metric:
    """Histogram of the seconds that completed jobs took in their last attempt."""
    spans = [job.ended - job.started for job in jobs if job.state == DONE and job.made and job.started and job.ended]
    buckets = [(str(float(limit)), float(sum(span <= limit for span in spans))) for limit in BUCKETS_S]
    family = HistogramMetricFamily("gnmreg_job_seconds", "Seconds of completed jobs that computed something")
    family.add_metric([], [*buckets, ("+Inf", float(len(spans)))], sum(spans))
    return family
