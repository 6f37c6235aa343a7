"""Commands of the farm: batches, workers and coordinators, inspection and control of the queue (docs/operations.md)."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from registration.errors import InputError
from registration.terminal import unescaped
from workflows.cli import remote
from workflows.cli.options import NOT_SET, FarmOptions, JobId, JobOptions, Port, RunName, RunOptions
from workflows.cli.remote import NO_SERVER, NO_UPLOAD, ServerOptions, UploadOptions

if TYPE_CHECKING:
    from workflows.engine.client import QueueClient
    from workflows.engine.reader import JobRow
    from workflows.farm.batch_page import BatchPage

REFRESH_S = 2.0
MAX_IDS, MAX_JOBS = 20, 100  # that are listed
QueueName = Literal["gpu", "rebuild"]
State = Literal["waiting", "running", "interrupted", "done", "failed", "cancelled"]
_FARM, _RUN, _FIT = FarmOptions(), RunOptions(), JobOptions()


@dataclass(frozen=True, kw_only=True)
class ListOptions:
    """A list of jobs.

    Attributes:
        jobs: List jobs instead: id, state, since when, stage and capture. The options below imply it.
        state: Only jobs in this state. interrupted: its process has ended, and another one will take it.
        subject: Only jobs of this subject: the name of the folder that holds its captures.
        text: Only jobs whose id, arguments or failure contain this text.
        limit: Number of jobs to list; 0: all.
    """

    jobs: bool = False
    state: Annotated[State | None, arg(help_behavior_hint=NOT_SET)] = None
    subject: Annotated[str | None, arg(metavar="NAME", help_behavior_hint=NOT_SET)] = None
    text: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint=NOT_SET)] = None
    limit: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 100)")] = None

    @property
    def wanted(self) -> bool:
        """Whether jobs are to be listed."""
        return self.jobs or any(value is not None for value in (self.state, self.subject, self.text, self.limit))


_LIST = ListOptions()


def worker(
    farm: FarmOptions = _FARM,
    root: Annotated[tuple[str, ...], arg(metavar="FOLDER|URL", help_behavior_hint=NOT_SET)] = (),
    gpu: Annotated[
        int | Literal["assigned"] | None, arg(metavar="N|assigned", help_behavior_hint="(default: no GPU)")
    ] = None,
    queue: Annotated[tuple[QueueName, ...], arg(metavar="{gpu,rebuild}")] = ("gpu",),
) -> int:
    """Execute jobs of the queue, one at a time, in a child process.

    Start one worker for each GPU, or for each share of the CPU cores and the memory.

    Args:
        farm: Which farm.
        root: Captures, models and results of jobs must lie below one of these folders and URLs or the farm's folder;
            other jobs are refused.
        gpu: Use this GPU only. assigned: the one that a scheduler such as Slurm assigned to this process.
        queue: Queues to take jobs from: gpu (registrations), rebuild (model building: much memory), or both.
    """
    if gpu != "assigned":
        os.environ["CUDA_VISIBLE_DEVICES"] = "" if gpu is None else str(gpu)  # before any library looks for a GPU
    from workflows.engine.process import EngineProcess, check_queues, serve
    from workflows.steps.table import STEPS

    folder = farm.directory.resolve()
    serve(
        EngineProcess(
            url=farm.url,
            queues=check_queues(queue),
            logs=folder / "logs",
            names=_worker_names(gpu),
            roots=(str(folder), *root),
            steps=STEPS,
            modules=("workflows.steps.register",),
        )
    )


def _worker_names(gpu: int | Literal["assigned"] | None) -> tuple[str, ...]:
    """Names that a worker may have: of a GPU the only one, so that two workers cannot share it."""
    from workflows.engine.process import names

    if gpu is None:
        return names("cpu")
    if gpu == "assigned":  # several jobs of a scheduler may each see their own GPU as the first
        return names(f"job{os.environ.get('SLURM_JOB_ID') or os.getpid()}-gpu", 1)
    return names("gpu")[gpu : gpu + 1]


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
    server: UploadOptions = NO_UPLOAD,
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
        server: Submit to a service; captures that it does not see are uploaded.
    """
    if server.server is not None:
        return remote.batch(server, captures, model, out, run, fit)
    from registration.progress import console_progress
    from workflows.engine.process import migrate
    from workflows.engine.reader import QueueReader
    from workflows.farm.batch import batch_jobs, made_and_kept, submit_batch
    from workflows.farm.batch_page import BatchPage
    from workflows.farm.local import LocalFarm, local_gpus, run_until_done
    from workflows.farm.status import status_lines

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
    page = BatchPage(url, jobs.run, out, jobs.left_out)
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
    lines = status_lines(QueueReader(url), jobs.run, folder / "logs")
    print("\n".join((*lines, *filter(None, [result.reason]))))
    made, kept = made_and_kept(url, jobs)
    print(f"{made} registered, {kept} kept, as their inputs did not change")
    return 0 if not jobs.remarks and result.counts.get("done", 0) == sum(result.counts.values()) else 1


def _say_page(page: "BatchPage", *, live: bool = True) -> None:
    """Write a batch's page, and print where it is or why there is none."""
    page.write(live=live)
    print(page.problem or page.location, file=sys.stderr if page.problem else sys.stdout, flush=True)


def status(
    farm: FarmOptions = _FARM,
    run: Annotated[str | None, arg(metavar="RUN", help_behavior_hint="(default: all runs)")] = None,
    watch: bool = False,
    page: Annotated[str | None, arg(metavar="DIR|URL", help_behavior_hint=NOT_SET)] = None,
    listed: ListOptions = _LIST,
    server: ServerOptions = NO_SERVER,
) -> int:
    """Show queue progress: counts, throughput, expected end, workers, failures.

    Args:
        farm: Which farm; its folder must be that of the workers' logs to show the stages of their jobs.
        run: Only this run, or part of a run such as RUN/it00.
        watch: Refresh every two seconds until Ctrl-C.
        page: Also write the page and the table of the batch RUN into the store of its results.
        listed: A list of jobs.
        server: Ask a service instead.
    """
    if server.server is not None:
        wanted = {"state": listed.state, "subject": listed.subject, "text": listed.text}
        return remote.status(server, run, wanted if listed.wanted else None, listed.limit)
    from workflows.engine.reader import QueueReader
    from workflows.farm.status import JobFilter, job_lines, status_lines

    reader, logs = QueueReader(farm.url), farm.directory / "logs"
    chosen = JobFilter(state=listed.state, subject=listed.subject, text=listed.text)
    limit = MAX_JOBS if listed.limit is None else listed.limit
    written = None
    if page is not None:
        from workflows.farm.batch_page import batch_page  # slow: it imports the steps

        written = batch_page(farm.url, run, page)
    while True:
        lines = job_lines(reader, run, chosen, logs, limit) if listed.wanted else status_lines(reader, run, logs)
        text = "\n".join(lines)
        if watch and sys.stdout.isatty():
            print("\033[H\033[J", end="", file=unescaped(sys.stdout))  # clears the screen
        print(text, flush=True)
        if written is not None:
            written.update()
            print(written.problem or written.location, flush=True)
        if not watch:
            return 0
        time.sleep(REFRESH_S)


def logs(job: JobId, /, farm: FarmOptions = _FARM, server: ServerOptions = NO_SERVER) -> int:
    """Print a job's state and its output; of a run, a round or a subject, its jobs.

    Args:
        job: An id as `gnmreg status --jobs` prints it, or its end if that is unique, such as ann/smile.
        farm: Which farm; its folder must be the one of the machine that executed the job, or shared with it.
        server: Ask a service instead; it takes whole ids only.
    """
    if server.server is not None:
        return remote.logs(server, job)
    from workflows.engine.reader import QueueReader
    from workflows.farm.status import find_jobs, group_lines
    from workflows.ids import check_id

    identity, rows = find_jobs(QueueReader(farm.url), job)
    if rows[0].id != identity or rows[0].kind != "job":
        print("\n".join(group_lines(identity, rows)))
        return 0
    row = rows[0]
    print(f"{row.id}: {row.state}" + (f" on {row.executor}" if row.executor else ""))
    if row.failure:
        print(f"{row.failure['status']}: {row.failure['reason']}")
    file = farm.directory / "logs" / f"{check_id(row.id)}.log"
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
        job: An id as `gnmreg status --jobs` prints it, or its end if that is unique. Of a run, a round or a subject,
            its failed job is repeated if there is only one.
        out: A new folder for the results: stages/, registration/, and inputs/ if they had to be downloaded.
        view: Also show the fit in the browser in 3D, with the scan and the cameras, until Ctrl-C.
        port: Port of that page on this machine's loopback interface; from elsewhere: ssh -L PORT:127.0.0.1:PORT HOST.
        farm: Which farm.
    """
    from registration.progress import console_progress
    from workflows.farm.debug import debug

    row = _job_to_repeat(farm.url, job)
    if row.failure:
        print(f"in the farm: {row.failure['status']}: {row.failure['reason']}")
    with console_progress() as progress:
        result = debug(row, out, progress, port=port if view else None)
    print(f"{result.summary}\n{out}", flush=True)
    if result.page is not None:
        print(f"Open {result.page.url} in a browser; stop with Ctrl-C.", flush=True)
        result.page.wait()
    return 0


def retry(
    run: RunName, /, cancelled: bool = False, farm: FarmOptions = _FARM, server: ServerOptions = NO_SERVER
) -> int:
    """Requeue the failed jobs of a run with their dependents; resume a parked run.

    Args:
        run: The run, or part of a run.
        cancelled: Also requeue cancelled jobs.
        farm: Which farm.
        server: Ask a service instead.
    """
    if server.server is not None:
        return remote.act(server, "retry", run, "requeued", cancelled=cancelled)
    _require(farm.url, run)
    with _queue(farm.url) as queue:
        requeued = queue.retry(run, failed=True, cancelled=cancelled)
    print(f"{len(requeued)} requeued" + "".join(f"\n  {identity}" for identity in requeued[:MAX_IDS]))
    return 0


def cancel(run: RunName, /, farm: FarmOptions = _FARM, server: ServerOptions = NO_SERVER) -> int:
    """Cancel a run, or part of it; running jobs are stopped within seconds.

    Args:
        run: The run, or part of a run such as RUN/it00/s00007.
        farm: Which farm.
        server: Ask a service instead.
    """
    if server.server is not None:
        return remote.act(server, "cancel", run, "cancelled")
    _require(farm.url, run)
    with _queue(farm.url) as queue:
        print(f"{queue.cancel(run)} cancelled")
    return 0


def _require(url: str, run: str) -> None:
    """Raise InputError, with near names, if there is no such run."""
    from workflows.engine.reader import QueueReader
    from workflows.farm.status import require_part

    require_part(QueueReader(url), run)


def _job_to_repeat(url: str, typed: str) -> "JobRow":
    from workflows.engine.reader import FAILED, QueueReader
    from workflows.farm.status import find_jobs

    identity, rows = find_jobs(QueueReader(url), typed)
    jobs = [row for row in rows if row.kind == "job"]
    if jobs and rows[0].id == identity and rows[0].kind == "job":
        return rows[0]
    failed = [row for row in jobs if row.state == FAILED]
    if len(failed) == 1:
        print(f"the failed job of {identity}: {failed[0].id}")
        return failed[0]
    raise InputError(
        "One job can be repeated, not a group",
        where="JOB",
        expected="the id of one job",
        got=f"{identity}, with {len(jobs)} jobs",
        fix=f"name one of {', '.join(row.id for row in (failed or jobs)[:10]) or 'another group'}",
    )


@contextmanager
def _queue(url: str) -> Iterator["QueueClient"]:
    from workflows.engine.client import QueueClient

    queue = QueueClient(url)
    try:
        yield queue
    finally:
        queue.close()
