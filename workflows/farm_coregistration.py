"""The coregistration loop put into a farm's queue, instead of run as a plain loop."""

from dataclasses import replace

from workflows.coregistration import FIRST, Plan, State, save
from workflows.engine.control import Queue
from workflows.farm_steps import write_plan
from workflows.jobs import DRIVER, FlowJob, check_id

PLAN = "plan.json"  # in the output folder: what coordinators and workers read


def put_coregistration(url: str, plan: Plan, *, run: str | None = None, variant: str = "llvm") -> str:
    """Write the plan into its output folder and put the driver into the queue at `url`. Returns the run's name.

    All processes of the farm must see the dataset, the model and the output folder under the same paths. A run that
    ended is gone on with: what was made from the same inputs is not made anew.

    Raises:
        InputError: there is no queue, or the name cannot be used.
    """
    name = check_id(run or plan.out.resolve().name)
    queue = Queue(url)
    try:
        plan = replace(plan, dataset=plan.dataset.resolve(), model=plan.model.resolve(), out=plan.out.resolve())
        save(State(plan=plan, models={FIRST: str(plan.model)}))
        write_plan(plan, plan.out / PLAN)
        arguments = {"plan": str(plan.out / PLAN), "variant": variant}
        queue.put([FlowJob(id=name, flow="coregister", arguments=arguments, queue=DRIVER)])
        queue.again([name])
    finally:
        queue.close()
    return name
