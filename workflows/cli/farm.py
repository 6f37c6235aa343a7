"""The farm's commands: workers and coordinators, batches, and what an operator asks and does. See docs/operations.md.

Like `cli.py`: nothing heavy is imported but inside the commands.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from registration.errors import InputError
from workflows.cli import store

if TYPE_CHECKING:
    from workflows.engine.client import Queue
    from workflows.engine.reader import Figures, Row

A_DAY = 10_000  # captures: what a farm is measured against
Folder = Annotated[Path, arg(metavar="DIR")]
Database = Annotated[str | None, arg(metavar="URL")]
RunName = Annotated[str | None, arg(metavar="RUN")]


def worker(
    folder: Folder = Path("."),
    db: Database = None,
    root: Annotated[tuple[str, ...], arg(metavar="PLACE")] = (),
    gpu: Annotated[int | None, arg(metavar="N")] = None,
    queue: Annotated[tuple[str, ...], arg(metavar="NAME")] = ("gpu",),
) -> int:
    """Take jobs from the queue and run them, one at a time, in a child process. One worker for each GPU or CPU place.

    Args:
        folder: The farm's folder: its logs, and its queue if no database is named.
        db: The queue's database, better in the environment as GNMREG_DB if it holds a password.
        root: Captures, models and results of jobs must lie below one of these folders and URLs; the farm's folder is
            one. May come several times.
        gpu: Use this GPU only; without it, none.
        queue: Which jobs to take: gpu (registrations), rebuild (models: much memory), or both.
    """
    os.environ["CUDA_VISIBLE_DEVICES"] = "" if gpu is None else str(gpu)  # before anything looks for a GPU
    from workflows.engine.process import Process, known_queues, names, serve
    from workflows.steps.table import STEPS

    serve(
        Process(
            url=_url(folder, db),
            queues=known_queues(queue),
            logs=folder.resolve() / "logs",
            names=names("cpu") if gpu is None else names("gpu")[gpu : gpu + 1],
            roots=(str(folder.resolve()), *root),
            steps=STEPS,
            modules=("workflows.steps.register",),
        )
    )


def coordinator(folder: Folder = Path("."), db: Database = None) -> int:
    """Run the flows of the queue: batches, subjects, coregistrations. One is enough; a second takes over if it dies.

    Args:
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    from workflows.engine.jobs import DRIVER, SUBJECTS
    from workflows.engine.process import Process, names, serve
    from workflows.farm.flows import FLOWS

    serve(
        Process(
            url=_url(folder, db),
            queues=(DRIVER, SUBJECTS),
            logs=folder.resolve() / "logs",
            names=names("coordinator"),
            flows=FLOWS,
        )
    )


def migrate(folder: Folder = Path("."), db: Database = None) -> int:
    """Create the queue's tables or bring them up to date. Workers and coordinators do so too when they start.

    Args:
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    from workflows.engine.database import redacted_url
    from workflows.engine.process import migrate

    url = _url(folder, db)
    migrate(url)
    print(f"the queue is ready: {redacted_url(url)}")
    return 0


def batch(
    captures: Positional[Annotated[tuple[str, ...], arg(metavar="CAPTURE")]],
    /,
    model: Annotated[str, arg(metavar="NPZ")],
    out: Annotated[str, arg(metavar="DIR|URL")],
    recipe: Literal["preview", "draft", "studio", "in_model"] = "draft",
    views: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    variant: Literal["llvm", "cuda"] = "llvm",
    run: RunName = None,
    local: bool = False,
    workers: Annotated[int, arg(metavar="N")] = 1,
    folder: Annotated[Path | None, arg(metavar="DIR")] = None,
    db: Database = None,
) -> int:
    """Register many captures, each by itself: put them into the queue, and with --local do them here and now.

    Args:
        captures: Capture folders or URLs of such, or files with one a line, named @FILE.
        model: The head model, a GNM NPZ file or its URL.
        out: The store to publish results in, a folder or an s3:// URL.
        recipe: As for register.
        views: As for register.
        seed: As for register.
        variant: Render on the CPU (llvm) or on NVIDIA GPUs (cuda).
        run: Name of the run; by default that of the store. The same run again adds what is new.
        local: Start a coordinator and workers on this machine, wait, and end them.
        workers: With --local, captures side by side; with cuda, one for each GPU instead.
        folder: The farm's folder; by default DIR.farm beside the results with --local, else here.
        db: The queue's database, as for worker.
    """
    from registration.progress import shown
    from workflows.engine.process import migrate
    from workflows.farm.batch import batch_jobs, put_batch
    from workflows.farm.local import LocalFarm, gpus_here, run_until_done

    made = batch_jobs(captures, model=model, out=out, run=run, recipe=recipe, views=views, seed=seed, variant=variant)
    farm = folder or (_farm_beside(out) if local else Path("."))
    url = _url(farm, db)
    if local:
        migrate(url)
    count = put_batch(url, made)
    print(f"{made.run}: {count} captures are in the queue", flush=True)
    if not local:
        return 0
    roots = (*made.roots, str(farm.resolve()))
    gpus = gpus_here(None) if variant == "cuda" else ()
    with shown() as progress:
        ended = run_until_done(
            LocalFarm(url=url, folder=farm, roots=roots, workers=workers, gpus=gpus), made.run, progress
        )
    print("\n".join((*_lines(_figures(url, made.run)), *filter(None, [ended.reason]))))
    return 0 if ended.counts.get("done", 0) == sum(ended.counts.values()) else 1


def coregister(
    dataset: Positional[Annotated[Path, arg(metavar="DATASET")]],
    /,
    model: Annotated[Path, arg(metavar="NPZ")],
    out: Annotated[Path, arg(metavar="DIR")],
    iterations: Annotated[int, arg(metavar="K")] = 3,
    all_iterations: bool = False,
    recipe: Literal["preview", "draft", "studio", "in_model"] = "draft",
    held_out: Annotated[str | None, arg(metavar="SHARE|FILE")] = None,
    seed: Annotated[int, arg(metavar="S")] = 0,
    views: Annotated[int | None, arg(metavar="N")] = None,
    components: Annotated[tuple[int, ...], arg(metavar="K")] = (),
    variant: Literal["llvm", "cuda"] = "llvm",
    local: bool = False,
    workers: Annotated[int, arg(metavar="N")] = 1,
    folder: Annotated[Path | None, arg(metavar="DIR")] = None,
    db: Database = None,
) -> int:
    """Register a dataset, build the next model from it, measure it on people held out, and again. It can be resumed.

    Args:
        dataset: A folder of subject folders, each of capture folders.
        model: The first head model, a GNM NPZ file with its landmark schemes beside it.
        out: The folder to write; one that this command wrote before is gone on with.
        iterations: At most so many rounds; it stops earlier when another one is not worth it.
        all_iterations: Do not stop earlier, unless too many captures fail.
        recipe: As for register.
        held_out: A share of the subjects, such as 0.2, or a file with a subject's folder name a line. Without it, those
            whose neutral has the tag held_out, or else a fifth.
        seed: Seed of everything random.
        views: Use only this many views of each capture.
        components: Numbers of identity components to measure models with; the largest decides.
        variant: As for batch.
        local: Start a coordinator and workers on this machine, wait, and end them; otherwise a farm's do it.
        workers: As for batch.
        folder: As for batch.
        db: The queue's database, as for worker.
    """
    from coregister.stopping_rule import Rule
    from registration.progress import shown
    from workflows.engine.process import migrate
    from workflows.farm.coregistration import coregister, put_coregistration
    from workflows.farm.local import gpus_here
    from workflows.farm.plan import make_plan
    from workflows.records.coregistration import PAGE

    plan = make_plan(
        dataset,
        model_path=model,
        out=out,
        recipe=recipe,
        held_out=_share_or_file(held_out),
        seed=seed,
        views=views,
        components=components or None,
        rule=Rule(rounds=iterations, early=not all_iterations),
    )
    farm = folder or (_farm_beside(str(out)) if local else Path("."))
    url = _url(farm, db)
    if not local:
        print(f"{put_coregistration(url, plan, variant=variant)} is in the queue; see gnmreg status")
        return 0
    migrate(url)
    gpus = gpus_here(None) if variant == "cuda" else ()
    with shown() as progress:
        told = coregister(plan, url=url, folder=farm, workers=workers, gpus=gpus, progress=progress)
    for name, figures in told["generalization_mm"].items():
        print(f"{name}, {told['at']} components: generalization {figures[str(told['at'])]:.3f} mm")
    print(f"{told.get('stopped') or told['verdict']['reason']}\n{out / PAGE}")
    return 1 if "stopped" in told else 0


def status(folder: Folder = Path("."), db: Database = None, run: RunName = None, watch: bool = False) -> int:
    """Tell how far the queue is: counts, throughput, what failed and why, who works.

    Args:
        folder: The farm's folder.
        db: The queue's database, as for worker.
        run: Of this run, or part of a run, only.
        watch: Tell again every two seconds, until Ctrl-C.
    """
    url = _url(folder, db)
    while True:
        text = "\n".join(_lines(_figures(url, run)))
        print(f"\033[H\033[J{text}" if watch and sys.stdout.isatty() else text, flush=True)
        if not watch:
            return 0
        time.sleep(2.0)


def logs(
    job: Positional[Annotated[str, arg(metavar="JOB")]], /, folder: Folder = Path("."), db: Database = None
) -> int:
    """Print what became of a job, and all that it printed.

    Args:
        job: Its id, such as RUN/it00/s00007/e003.
        folder: The farm's folder, on the machine that ran it or shared.
        db: The queue's database, as for worker.
    """
    from workflows.ids import check_id

    row = _row(folder, db, job)
    print(f"{row.id}: {row.state}" + (f" on {row.executor}" if row.executor else ""))
    if row.failure:
        print(f"{row.failure['status']}: {row.failure['reason']}")
    file = folder / "logs" / f"{check_id(job)}.log"
    print(file.read_text("utf-8", "replace") if file.is_file() else f"no log here: {file}", end="")
    return 0


def debug(
    job: Positional[Annotated[str, arg(metavar="JOB")]],
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    view: bool = False,
    port: Annotated[int, arg(metavar="PORT")] = 8080,
    folder: Folder = Path("."),
    db: Database = None,
) -> int:
    """Run a job again, here and now, with a picture after every stage. The queue and its results stay as they are.

    Args:
        job: Its id.
        out: A new folder for what it makes: stages/, registration/, and inputs/ if they had to be fetched.
        view: Also show the fit in the browser, in three dimensions, with the scan and the cameras; stops with Ctrl-C.
        port: Where to serve that, on this machine only; from elsewhere: ssh -L PORT:127.0.0.1:PORT HOST.
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    from registration.progress import shown
    from workflows.farm.debug import debug

    row = _row(folder, db, job)
    if row.failure:
        print(f"in the farm: {row.failure['status']}: {row.failure['reason']}")
    with shown() as progress:
        done = debug(row, out, progress, port=port if view else None)
    print(f"{done.told}\n{out}", flush=True)
    if done.page is not None:
        print(f"Open {done.page.url} in a browser; Ctrl-C ends.", flush=True)
        done.page.wait()
    return 0


def retry(
    run: Positional[Annotated[str, arg(metavar="RUN")]],
    /,
    failed: bool = False,
    cancelled: bool = False,
    folder: Folder = Path("."),
    db: Database = None,
) -> int:
    """Put what failed in a run into the queue again, in place, with what followed from it. Also unparks a run.

    Args:
        run: The run, or a part of it.
        failed: Retry what failed (there is nothing else to retry, but it should be said).
        cancelled: Also what was cancelled.
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    if not failed and not cancelled:
        raise InputError(
            "Nothing is chosen to be retried",
            where="retry",
            expected="--failed, --cancelled or both",
            got="neither",
            fix="add --failed",
        )
    with _queue(folder, db) as queue:
        again = queue.retry(run, failed=failed, cancelled=cancelled)
    print(f"{len(again)} again" + "".join(f"\n  {identity}" for identity in again[:20]))
    return 0


def cancel(
    run: Positional[Annotated[str, arg(metavar="RUN")]], /, folder: Folder = Path("."), db: Database = None
) -> int:
    """End a run, or a part of it: nothing more of it starts, and what is running is stopped within seconds.

    Args:
        run: The run, or a part of it such as RUN/it00/s00007.
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    with _queue(folder, db) as queue:
        print(f"{queue.cancel(run)} cancelled")
    return 0


COMMANDS: Mapping[str, Callable[..., int] | tuple[str, Mapping[str, Callable[..., int]]]] = {
    "batch": batch,
    "coregister": coregister,
    "worker": worker,
    "coordinator": coordinator,
    "status": status,
    "logs": logs,
    "debug": debug,
    "retry": retry,
    "cancel": cancel,
    "migrate": migrate,
    "store": ("Look after published results.", {"verify": store.verify, "retire": store.retire}),
}


def _lines(figures: "Figures") -> list[str]:
    """What status prints."""
    total = sum(figures.counts.values())
    counts = ", ".join(f"{figures.counts[state]} {state}" for state in sorted(figures.counts)) or "none"
    flows = ", ".join(f"{figures.flows[state]} {state}" for state in sorted(figures.flows)) or "none"
    lines = [f"jobs: {total} ({counts})", f"flows: {sum(figures.flows.values())} ({flows})"]
    share = 100 * figures.a_day / A_DAY
    rate = f"done at a rate of {figures.a_day:,.0f} a day, {share:.0f} % of {A_DAY:,}"
    lines.append(f"{rate}; {figures.ended_last_hour} ended in the last hour")
    lines += [f"{name}: {count} running" for name, count in sorted(figures.workers.items())]
    if figures.failures:
        lines.append("failed:")
        lines += [f"{count:7d}  {reason[:200]}" for reason, count in list(figures.failures.items())[:20]]
    return lines


def _figures(url: str, run: str | None) -> "Figures":
    from workflows.engine.reader import Reader

    return Reader(url).figures(run)


def _row(folder: Path, db: str | None, job: str) -> "Row":
    from workflows.engine.reader import Reader

    row = Reader(_url(folder, db)).rows([job]).get(job)
    if row is None:
        raise InputError(
            "There is no such job", where="JOB", expected="an id that the queue knows", got=job, fix="see gnmreg status"
        )
    return row


@contextmanager
def _queue(folder: Path, db: str | None) -> Iterator["Queue"]:
    from workflows.engine.client import Queue

    queue = Queue(_url(folder, db))
    try:
        yield queue
    finally:
        queue.close()


def _url(folder: Path, db: str | None) -> str:
    from workflows.engine.database import ENVIRONMENT, checked_url, default_url

    return checked_url(db or os.environ.get(ENVIRONMENT) or default_url(folder))


def _share_or_file(text: str | None) -> float | Path | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return Path(str(text))


def _farm_beside(out: str) -> Path:
    from workflows.records.remote import is_remote, local_path

    if is_remote(out):
        raise InputError(
            "A farm on this machine needs a folder",
            where="--folder",
            expected="a folder for its queue and logs, as the results go to a URL",
            got="none",
            fix="add --folder DIR",
        )
    place = local_path(out).resolve()
    return place.with_name(f"{place.name}.farm")
