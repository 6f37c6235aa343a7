"""Routes that act on runs: cancel, retry, prioritize."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import APIRouter, Depends
from pydantic import BaseModel, Field

from registration.errors import InputError
from registration.fit.recipes import RECIPES
from workflows.engine.client import MAX_PRIORITY, QueueClient
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.farm.status import require_part
from workflows.service.access import need
from workflows.service.idempotency import RepeatableRoute, idempotency_key
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState

router = APIRouter(
    tags=["actions"],
    dependencies=[Depends(need("operator")), Depends(idempotency_key)],
    responses=RESPONSES,
    route_class=RepeatableRoute,
    max_body_size=2**16,
)
Part = Annotated[str, Field(max_length=800, examples=["monday"], description="a run, a part of one, or a job")]


class CancelRequest(BaseModel):
    """What to cancel."""

    run: Part


class RetryRequest(BaseModel):
    """What to retry."""

    run: Part
    cancelled: bool = Field(False, description="also requeue cancelled jobs")


class PriorityRequest(BaseModel):
    """Which waiting jobs get which priority."""

    run: Part
    priority: int = Field(ge=1, le=MAX_PRIORITY, description="the lowest number is taken first")


class RegisterAgainRequest(BaseModel):
    """Which capture of a batch is registered again, and how."""

    job: Part
    recipe: str = Field(max_length=100, examples=["final"])


class Acted(BaseModel):
    """How many jobs and flows were changed."""

    count: int


@router.post("/cancel")
def cancel(state: Service, request: CancelRequest) -> Acted:
    """Cancel a run or a part of it; running jobs are stopped within seconds."""
    with queue(state, request.run) as client:
        return Acted(count=client.cancel(request.run))


@router.post("/retry")
def retry(state: Service, request: RetryRequest) -> Acted:
    """Requeue the failed jobs of a run with their dependents; resume a parked run."""
    with queue(state, request.run) as client:
        return Acted(count=len(client.retry(request.run, cancelled=request.cancelled)))


@router.post("/priority")
def prioritize(state: Service, request: PriorityRequest) -> Acted:
    """Change the priority of waiting jobs."""
    with queue(state, request.run) as client:
        return Acted(count=client.prioritize(request.run, request.priority))


@router.post("/reregister")
def register_again(state: Service, request: RegisterAgainRequest) -> Acted:
    """Register a capture of a batch again, with another recipe."""
    if request.recipe not in RECIPES:
        expected = ", ".join(sorted(RECIPES))
        raise InputError("There is no such recipe", where="recipe", expected=expected, got=request.recipe)
    with queue(state, request.job) as client:
        run = request.job.partition("/")[0]
        rows = state.reader.rows([request.job, run])
        row, driver = rows.get(request.job), FlowJob(id=run, flow="batch", queue=DRIVER)
        if row is None or row.kind != "job" or run not in rows or rows[run].spec != driver.spec():
            raise InputError(
                "The job cannot be given another recipe",
                where=request.job,
                expected="a capture of a batch",
                got="part of another run, whose captures all have one recipe" if row is not None else "no single job",
                fix="submit the run again with this recipe",
            )
        arguments = row.spec["arguments"]
        options = {**(arguments.get("options") or {}), "recipe": request.recipe}
        again = Job(id=row.id, step=row.spec["step"], arguments={**arguments, "options": options})
        client.resubmit([again])
        client.resubmit([driver])  # one that had ended waits for the job
    return Acted(count=1)


@contextmanager
def queue(state: ServiceState, part: str) -> Iterator[QueueClient]:
    """A connection to the queue, which has the named run or part; the board shows what was done. Raises Problem."""
    try:
        require_part(state.reader, part)
    except InputError:
        raise Problem.missing("run", part, "list them at /api/v1/runs") from None
    client = QueueClient(state.settings.url, known=True)
    try:
        yield client
    finally:
        client.close()
    state.board.refresh()
