"""Routes that act on runs: cancel, retry, prioritize."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import APIRouter, Depends
from pydantic import BaseModel, Field

from registration.errors import InputError
from workflows.engine.client import MAX_PRIORITY, QueueClient
from workflows.farm.status import require_part
from workflows.service.access import need
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState

router = APIRouter(tags=["actions"], dependencies=[Depends(need("operator"))], responses=RESPONSES, max_body_size=2**16)
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
