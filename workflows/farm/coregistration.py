"""A coregistration put into a farm's queue, or into one of its own on this machine."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from registration.progress import Progress, Silent
from workflows.engine.client import QueueClient
from workflows.engine.jobs import DRIVER, FlowJob
from workflows.farm.local import LocalFarm, run_until_done
from workflows.ids import check_id
from workflows.pages.coregistration import write_coregistration_page
from workflows.records.coregistration import FIRST, MANIFEST, Plan, State, write_plan, write_state

PLAN = "plan.json"  # in the output folder: what coordinators and workers read


def submit_coregistration(url: str, plan: Plan, *, run: str | None = None, variant: str = "llvm") -> str:
    """Write the plan into its output folder and put the driver into the queue at `url`. Returns the run's name.

    All processes of the farm must see the dataset, the model and the output folder under the same paths. What the
    queue knows of a run of this name that ended is forgotten: every job looks anew whether its product is there, made
    from the same inputs, so that only what is missing or changed is computed.

    Raises:
        InputError: there is no queue, the name cannot be used, or a run of this name has not ended.
    """
    name = check_id(run or plan.out.resolve().name)
    queue = QueueClient(url)
    try:
        queue.forget(name)
        arguments = {"plan": str(begin(plan)), "variant": variant}
        queue.submit([FlowJob(id=name, flow="coregister", arguments=arguments, queue=DRIVER)])
    finally:
        queue.close()
    return name


def begin(plan: Plan) -> Path:
    """Write the record without rounds, and the plan, whose file is returned."""
    plan = replace(plan, dataset=plan.dataset.resolve(), model=plan.model.resolve(), out=plan.out.resolve())
    write_state(State(plan=plan, models={FIRST: str(plan.model)}), write_coregistration_page)
    write_plan(plan, plan.out / PLAN)
    return plan.out / PLAN


def coregister(
    plan: Plan,
    *,
    url: str,
    folder: Path,
    workers: int = 1,
    gpus: tuple[int, ...] = (),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Go round on this machine: a coordinator and workers, started and ended. Returns `coregistration.json`.

    Called again it goes on where it was interrupted: what was made from the same inputs is not made anew. If the run
    ended without a verdict, the entry "stopped" tells why.

    Args:
        url: of the queue, which `engine.durable.migrate` made; no other process serves it.
        folder: for the logs of jobs, with the queue if that is a file.
        workers: captures side by side; with `gpus` one for each of them instead.

    Raises:
        InputError: as `submit_coregistration`, or a process refused to start.
    """
    queue = QueueClient(url)
    try:
        queue.cancel(check_id(plan.out.resolve().name))  # of a command that was killed
    finally:
        queue.close()
    name = submit_coregistration(url, plan, variant="cuda" if gpus else "llvm")
    places = (plan.dataset, plan.model.parent, plan.out, folder)
    roots = tuple(str(place.resolve()) for place in places)
    farm = LocalFarm(url=url, folder=folder, roots=roots, workers=workers, gpus=gpus)
    stopped = run_until_done(farm, name, progress or Silent()).reason
    told: dict[str, Any] = json.loads((plan.out / MANIFEST).read_text("utf-8"))
    return told | ({"stopped": stopped} if stopped else {})
