"""A route that opens the page of a stabilization review, which viser serves on the loopback interface."""

import shlex
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends
from pydantic import BaseModel, Field

from workflows.service.access import need
from workflows.service.coregistrations import Coregistration, coregistration
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service

router = APIRouter(tags=["reviews"], dependencies=[Depends(need("reviewer"))], responses=RESPONSES)


class ReviewRequest(BaseModel):
    """Which round is reviewed."""

    run: Annotated[str, Field(max_length=200, examples=["week7"], description="a coregistration")]
    round: Annotated[int, Field(ge=0, le=99, description="its number, from 0")]


class OpenedReview(BaseModel):
    """Where the page is."""

    url: str = Field(description="on this machine's loopback interface, with the page's token; it ends after two hours")


@router.post("/reviews")
def open_review(state: Service, request: ReviewRequest) -> OpenedReview:
    """Open the review of a round's expressions, for the one who asks."""
    found = coregistration(state, request.run)
    run, model = review_inputs(found, request.round)
    if not run.is_dir():
        raise Problem.missing("round", f"it{request.round:02d}", "wait until its captures are registered")
    if not state.settings.is_loopback:
        raise Problem(
            HTTPStatus.CONFLICT,
            "The review is on the loopback interface of the machine that has the results",
            expected="a service on 127.0.0.1",
            got=state.settings.host,
            fix=f"run there: {command(run, model)}",
        )
    return OpenedReview(url=state.reviews.open(run, model))


def review_inputs(found: Coregistration, number: int) -> tuple[Path, Path]:
    """Return the folder of a round's registrations and their model. Raises Problem."""
    return found.folder / f"it{number:02d}" / "registrations", found.model_of_round(number)


def command(run: Path, model: Path) -> str:
    """Return what a reviewer types instead."""
    return shlex.join(["gnmreg", "stabilize", "review", str(run), "--model", str(model), "--skip-failed"])
