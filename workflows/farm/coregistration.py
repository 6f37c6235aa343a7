"""Submission of a coregistration to a farm's queue, or to a farm of its own on this machine."""

from dataclasses import dataclass, replace
from pathlib import Path

from registration.errors import InputError
from registration.progress import NullProgress, Progress
from workflows.engine.client import QueueClient
from workflows.engine.jobs import DRIVER, FlowJob
from workflows.engine.reader import QueueReader
from workflows.farm.local import LocalFarm, run_until_done
from workflows.ids import check_id
from workflows.records.coregistration import (
    CoregistrationPlan,
    CoregistrationState,
    initial_state,
)
from workflows.records.round_files import MANIFEST, PLAN
from workflows.steps.coregistration_page import write_record


@dataclass(frozen=True, kw_only=True)
class CoregistrationResult:
    """The state of a coregistration whose run has ended."""

    state: CoregistrationState
    stopped: str = ""  # why the run ended without a verdict of its last round, if it did


def submit_coregistration(url: str, plan: CoregistrationPlan, *, run: str | None = None) -> str:
    """Write the plan into its output folder and put the driver into the queue at `url`. Returns the run's name.

    All processes of the farm must see the dataset, the model and the output folder under the same paths. The queue's
    rows of an earlier run of this name are deleted: every job checks again whether its product exists, so that only
    missing or changed products are computed.

    Raises:
        InputError: there is no queue, the name is invalid, or a run of this name has not ended or is a batch.
    """
    name = check_id(run or plan.out.name)
    queue = QueueClient(url)
    try:
        _refuse_batch(url, name)
        queue.forget(name)
        arguments = {"plan": str(start_coregistration(plan))}
        queue.submit([FlowJob(id=name, flow="coregister", arguments=arguments, queue=DRIVER)])
    finally:
        queue.close()
    return name


def _refuse_batch(url: str, name: str) -> None:
    """Raise InputError if a run is a batch: its rows are not a coregistration's to cancel and delete."""
    row = QueueReader(url, known=True).rows([name]).get(name)
    if row is not None and row.spec.get("flow") == "batch":
        raise InputError(
            "The run is a batch",
            where=name,
            expected="a new name, or that of a coregistration",
            got="a batch in this queue",
            fix="choose an output folder of another name, or another queue with --folder",
        )


def start_coregistration(plan: CoregistrationPlan) -> Path:
    """Write the record before the first round, and the plan, whose file is returned."""
    file = plan.out / PLAN
    plan.out.mkdir(parents=True, exist_ok=True)
    plan.write(file)
    write_record(initial_state(plan))
    return file


def coregister(
    plan: CoregistrationPlan,
    *,
    url: str,
    folder: Path,
    workers: int = 1,
    gpus: tuple[int, ...] = (),
    progress: Progress | None = None,
) -> CoregistrationResult:
    """Execute a plan on this machine: start a coordinator and workers, wait for the run, end them.

    A repeated call resumes: products of the same inputs are not computed again.

    Args:
        plan: of the coregistration.
        url: of the queue, which `engine.process.migrate` created; no other process serves it.
        folder: of the jobs' logs, and of the queue if that is a file.
        workers: number of captures that are registered in parallel; with `gpus` one for each of them instead.
        gpus: numbers of the GPUs to use; none: the CPU.
        progress: where to report to.

    Raises:
        InputError: as `submit_coregistration`, or a process refused to start.
    """
    plan = replace(plan, options=replace(plan.options, variant="cuda" if gpus else "llvm"))
    queue = QueueClient(url)
    try:
        _refuse_batch(url, check_id(plan.out.name))
        queue.cancel(plan.out.name)  # the run of an earlier command that was killed
    finally:
        queue.close()
    name = submit_coregistration(url, plan)
    roots = tuple(str(path) for path in (plan.dataset, plan.model.parent, plan.out, folder.resolve()))
    farm = LocalFarm(url=url, folder=folder, roots=roots, workers=workers, gpus=gpus)
    try:
        stopped = run_until_done(farm, name, progress or NullProgress()).reason
    except BaseException:
        _write_stopped(plan, "the command ended before the run; the same command continues it")
        raise
    state = _write_stopped(plan, stopped)
    return CoregistrationResult(state=state, stopped=stopped)


def _write_stopped(plan: CoregistrationPlan, reason: str) -> CoregistrationState:
    """Note in the record and on the page why the run has ended, if that was without a verdict on its last round."""
    state = replace(CoregistrationState.read(plan.out / MANIFEST), stopped=reason)
    write_record(state)
    return state
