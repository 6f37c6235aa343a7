"""Commands of the farm: batches, workers and coordinators, inspection and control of the queue (docs/operations.md)."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from registration.errors import InputError
from workflows.cli.options import NOT_SET, FarmOptions, JobId, JobOptions, Port, RunName, RunOptions

if TYPE_CHECKING:
    from workflows.engine.client import QueueClient
    from workflows.engine.reader import JobRow, QueueMetrics
    from workflows.farm.batch_page import BatchPage

CAPTURES_PER_DAY = 10_000  # the throughput that status compares with
REFRESH_S = 2.0
MAX_REASONS = MAX_IDS = 20  # that are listed
QueueName = Literal["gpu", "rebuild"]
_FARM, _RUN, _FIT = FarmOptions(), RunOptions(), JobOptions()


def worker(
    farm: FarmOptions = _FARM,
    root: Annotated[tuple[str, ...], arg(metavar="FOLDER|URL", help_behavior_hint=NOT_SET)] = (),
    gpu: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: no GPU)")] = None,
    queue: Annotated[tuple[QueueName, ...], arg(metavar="{gpu,rebuild}")] = ("gpu",),
) -> int:
    """Execute jobs of the queue, one at a time, in a child process.

    Start one worker for each GPU, or for each share of the CPU cores and the memory.

    Args:
        farm: Which farm.
        root: Captures, models and results of jobs must lie below one of these folders and URLs or the farm's folder;
            other jobs are refused.
        gpu: Use this GPU only.
        queue: Queues to take jobs from: gpu (registrations), rebuild (model building: much memory), or both.
    """
    os.environ["CUDA_VISIBLE_DEVICES"] = "" if gpu is None else str(gpu)  # before any library looks for a GPU
    from workflows.engine.process import EngineProcess, check_queues, names, serve
    from workflows.steps.table import STEPS

    folder = farm.directory.resolve()
    serve(
        EngineProcess(
            url=farm.url,
            queues=check_queues(queue),
            logs=folder / "logs",
            names=names("cpu") if gpu is None else names("gpu")[gpu : gpu + 1],
            roots=(str(folder), *root),
            steps=STEPS,
            modules=("workflows.steps.register",),
        )
    )


def coordinator(farm: FarmOptions = _FARM) -> int:
    """Execute the flows of the queue: batches, subjects, coregistrations.

    One coordinator is enough; a second one takes over if it dies.

    Args:
        farm: Which farm.
    """
    from workflows.engine.jobs import DRIVER, SUBJECTS
    from workflows.engine.process import EngineProcess, names, serve
    from workflows.farm.flows import FLOWS

    logs = farm.directory.resolve() / "logs"
    serve(EngineProcess(url=farm.url, queues=(DRIVER, SUBJECTS), logs=logs, names=names("coordinator"), flows=FLOWS))


def migrate(farm: FarmOptions = _FARM) -> int:
    """Create or update the queue's tables.

    Workers and coordinators also do so when they start.

    Args:
        farm: Which farm.
    """
    from workflows.engine.database import redacted_url
    from workflows.engine.process import migrate

    migrate(farm.url)
    print(f"the queue is ready: {redacted_url(farm.url)}")
    return 0


def batch(
    captures: Positional[Annotated[tuple[str, ...], arg(metavar="CAPTURE", help_behavior_hint="(required)")]],
    /,
    model: Annotated[str, arg(metavar="NPZ|URL")],
    out: Annotated[str, arg(metavar="DIR|URL")],
    run: Annotated[str | None, arg(metavar="RUN", help_behavior_hint="(default: the name of the store)")] = None,
    fit: JobOptions = _FIT,
    farm: RunOptions = _RUN,
) -> int:
    """Register many independent captures through the queue.

    Args:
        captures: Capture folders or their URLs; @FILE stands for a file with one of them on each line. Those that
            cannot be used are listed, and the others are registered.
        model: The head model, a GNM NPZ file or its URL.
        out: The store to publish results in, a folder or an s3:// URL.
        run: Name of the run. Submitting to the same run again adds new captures, and registers those again whose
            settings or contents changed.
        fit: How the captures are registered.
        farm: Where the jobs are executed.
    """
    from registration.progress import console_progress
    from workflows.engine.process import migrate
    from workflows.farm.batch import batch_jobs, made_and_kept, submit_batch
    from workflows.farm.batch_page import BatchPage
    from workflows.farm.local import LocalFarm, local_gpus, run_until_done

    jobs = batch_jobs(captures, model=model, out=out, run=run, options=fit.register_options())
    folder = farm.farm_folder(out)
    url = farm.url_for(folder)
    if farm.local:
        migrate(url)
    submission = submit_batch(url, jobs)
    print(f"{jobs.run}: {submission.total} captures are in the queue: {submission.new} new,", end=" ")
    print(f"{submission.again} again, {submission.waiting} waiting or running already", flush=True)
    for line in jobs.remarks[:MAX_IDS]:
        print(line, file=sys.stderr)
    if len(jobs.remarks) > MAX_IDS:
        print(f"and {len(jobs.remarks) - MAX_IDS} more", file=sys.stderr)
    page = BatchPage(url, jobs.run, out)
    if not farm.local:
        _say_page(page)
        return 1 if jobs.remarks else 0
    roots = (*jobs.roots, str(folder.resolve()))
    gpus = local_gpus() if fit.variant == "cuda" else ()
    machine = LocalFarm(url=url, folder=folder, roots=roots, workers=farm.workers, gpus=gpus)
    try:
        with console_progress() as progress:
            result = run_until_done(machine, jobs.run, progress, page.update)
    finally:
        _say_page(page, live=False)
    print("\n".join((*_status_lines(_figures(url, jobs.run)), *filter(None, [result.reason]))))
    made, kept = made_and_kept(url, jobs)
    print(f"{made} registered, {kept} kept: their inputs did not change")
    return 0 if not jobs.remarks and result.counts.get("done", 0) == sum(result.counts.values()) else 1


def _say_page(page: "BatchPage", *, live: bool = True) -> None:
    """Write a batch's page, and print where it is or why there is none."""
    page.write(live=live)
    print(page.problem or page.location, file=sys.stderr if page.problem else sys.stdout, flush=True)


def status(
    farm: FarmOptions = _FARM,
    run: Annotated[str | None, arg(metavar="RUN", help_behavior_hint="(default: all runs)")] = None,
    watch: bool = False,
) -> int:
    """Show queue progress: counts, throughput, failures by reason, active workers.

    Args:
        farm: Which farm.
        run: Only this run, or part of a run such as RUN/it00.
        watch: Refresh every two seconds until Ctrl-C.
    """
    url = farm.url
    while True:
        text = "\n".join(_status_lines(_figures(url, run)))
        print(f"\033[H\033[J{text}" if watch and sys.stdout.isatty() else text, flush=True)
        if not watch:
            return 0
        time.sleep(REFRESH_S)


def logs(job: JobId, /, farm: FarmOptions = _FARM) -> int:
    """Print a job's state and its output.

    Args:
        job: The job's id, such as RUN/it00/s00007/e003.
        farm: Which farm; its folder must be the one of the machine that executed the job, or shared with it.
    """
    from workflows.ids import check_id

    row = _row(farm.url, job)
    print(f"{row.id}: {row.state}" + (f" on {row.executor}" if row.executor else ""))
    if row.failure:
        print(f"{row.failure['status']}: {row.failure['reason']}")
    file = farm.directory / "logs" / f"{check_id(job)}.log"
    print(file.read_text("utf-8", "replace") if file.is_file() else f"no log here: {file}", end="")
    return 0


def debug(
    job: JobId,
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    view: bool = False,
    port: Port = 8080,
    farm: FarmOptions = _FARM,
) -> int:
    """Repeat a job in the foreground, with an image after every stage.

    The queue and its results are not changed.

    Args:
        job: The job's id.
        out: A new folder for the results: stages/, registration/, and inputs/ if they had to be downloaded.
        view: Also show the fit in the browser in 3D, with the scan and the cameras, until Ctrl-C.
        port: Port of that page on this machine's loopback interface; from elsewhere: ssh -L PORT:127.0.0.1:PORT HOST.
        farm: Which farm.
    """
    from registration.progress import console_progress
    from workflows.farm.debug import debug

    row = _row(farm.url, job)
    if row.failure:
        print(f"in the farm: {row.failure['status']}: {row.failure['reason']}")
    with console_progress() as progress:
        result = debug(row, out, progress, port=port if view else None)
    print(f"{result.summary}\n{out}", flush=True)
    if result.page is not None:
        print(f"Open {result.page.url} in a browser; stop with Ctrl-C.", flush=True)
        result.page.wait()
    return 0


def retry(run: RunName, /, cancelled: bool = False, farm: FarmOptions = _FARM) -> int:
    """Requeue the failed jobs of a run with their dependents; resume a parked run.

    Args:
        run: The run, or part of a run.
        cancelled: Also requeue cancelled jobs.
        farm: Which farm.
    """
    with _queue(farm.url) as queue:
        requeued = queue.retry(run, failed=True, cancelled=cancelled)
    print(f"{len(requeued)} requeued" + "".join(f"\n  {identity}" for identity in requeued[:MAX_IDS]))
    return 0


def cancel(run: RunName, /, farm: FarmOptions = _FARM) -> int:
    """Cancel a run, or part of it; running jobs are stopped within seconds.

    Args:
        run: The run, or part of a run such as RUN/it00/s00007.
        farm: Which farm.
    """
    with _queue(farm.url) as queue:
        print(f"{queue.cancel(run)} cancelled")
    return 0


def _status_lines(figures: "QueueMetrics") -> list[str]:
    """What status prints."""
    total = sum(figures.counts.values())
    counts = ", ".join(f"{figures.counts[state]} {state}" for state in sorted(figures.counts)) or "none"
    flows = ", ".join(f"{figures.flows[state]} {state}" for state in sorted(figures.flows)) or "none"
    lines = [f"jobs: {total} ({counts})", f"flows: {sum(figures.flows.values())} ({flows})"]
    percent = 100 * figures.a_day / CAPTURES_PER_DAY
    rate = f"throughput: {figures.a_day:,.0f} jobs a day, {percent:.0f} % of {CAPTURES_PER_DAY:,}"
    lines.append(f"{rate}; {figures.ended_last_hour} ended in the last hour")
    lines += [f"{name}: {count} running" for name, count in sorted(figures.workers.items())]
    if figures.failures:
        lines.append("failed:")
        lines += [f"{count:7d}  {reason[:200]}" for reason, count in list(figures.failures.items())[:MAX_REASONS]]
    return lines


def _figures(url: str, run: str | None) -> "QueueMetrics":
    from workflows.engine.reader import QueueReader

    return QueueReader(url).metrics(run)


def _row(url: str, job: str) -> "JobRow":
    from workflows.engine.reader import QueueReader

    row = QueueReader(url).rows([job]).get(job)
    if row is None:
        raise InputError(
            "There is no such job", where="JOB", expected="an id that the queue knows", got=job, fix="see gnmreg status"
        )
    return row


@contextmanager
def _queue(url: str) -> Iterator["QueueClient"]:
    from workflows.engine.client import QueueClient

    queue = QueueClient(url)
    try:
        yield queue
    finally:
        queue.close()
