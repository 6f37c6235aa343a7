"""Routes that submit runs: batches, subjects, coregistrations."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Response
from pydantic import BaseModel, ConfigDict, Field

from registration.errors import InputError
from registration.fit.recipes import RECIPES
from registration.terminal import printable
from workflows.farm.batch import batch_jobs, submit_batch
from workflows.ids import is_remote, redact
from workflows.service.access import need
from workflows.service.idempotency import RepeatableRoute, idempotency_key
from workflows.service.models import find_model
from workflows.service.places import FIRST, OFFICIAL
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState
from workflows.steps.job_options import from_job

MAX_CAPTURES = 20_000  # of one request
router = APIRouter(
    tags=["submit"],
    dependencies=[Depends(need("operator")), Depends(idempotency_key)],
    responses=RESPONSES,
    route_class=RepeatableRoute,
    max_body_size=16 * 2**20,
)
Place = Annotated[str, Field(min_length=1, max_length=2000)]
Count = Annotated[int, Field(ge=1, le=1000)]
RunName = Annotated[str, Field(max_length=100, pattern="^[A-Za-z0-9][A-Za-z0-9._-]*$", examples=["monday"])]
_MODEL = "name of one of the service's models, path or URL"
_OUT = "name below the service's results, path or URL; None: the run's name"


class Request(BaseModel):
    """A request without unknown fields."""

    model_config = ConfigDict(extra="forbid")


class FitOptions(Request):
    """How captures are registered; as the options of `gnmreg register`."""

    recipe: Literal[tuple(RECIPES)] = "draft"  # type: ignore[valid-type]  # import paths would run the sender's code
    views: Annotated[int, Field(ge=2, le=10_000)] | None = None
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    deterministic: bool = False
    variant: Literal["llvm", "cuda"] = "llvm"
    use_scan: Literal["auto", "always", "never"] = "auto"
    detect: bool = True
    stereo: bool = True
    camera_sigma_px: float = Field(default=0.0, ge=0.0, le=1000.0, allow_inf_nan=False)
    cranium: Literal["model", "off"] = "model"


class Submission(Request):
    """What every submission names."""

    model: Place = Field(description=_MODEL, examples=["first"])
    out: Place | None = Field(default=None, description=_OUT)
    options: FitOptions = FitOptions()


class BatchRequest(Submission):
    """Captures that are registered independently of one another."""

    captures: list[Place] = Field(
        min_length=1,
        max_length=MAX_CAPTURES,
        description="uploads as SUBJECT/NAME or SUBJECT, paths and URLs below the service's roots",
        examples=[["ann/smile", "bob"]],
    )
    run: RunName | None = Field(default=None, description="name of the run; None: that of the results")


class SubjectRequest(Submission):
    """A subject's captures: the neutral, then each expression from it."""

    subject: Place = Field(description="name of an uploaded subject, or the path of a folder", examples=["ann"])
    run: RunName
    neutral: Annotated[str, Field(max_length=200)] | None = Field(default=None, description="the neutral's folder")


class CoregistrationRequest(Submission):
    """Rounds of registration and model building over a dataset; as `gnmreg coregister`."""

    dataset: Place = Field(description='path of a folder of subjects; "captures": all uploads', examples=["captures"])
    run: RunName
    iterations: Annotated[int, Field(ge=1, le=100)] = 3
    all_iterations: bool = False
    model_recipe: Annotated[str, Field(max_length=200)] = "few_registrations"
    held_out: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    components: list[Count] = Field(default=[], max_length=100)
    anatomy: Literal["regenerate", "keep"] = "regenerate"
    gate: Literal["auto", "person"] = Field(
        default="auto",
        description="person: models are built when a reviewer has decided on all that the rules leave to one",
    )


class Submitted(BaseModel):
    """What is in the queue now."""

    run: str
    out: str = Field(description="place of the results")
    total: int = Field(description="captures in the queue")
    new: int = 0
    again: int = Field(default=0, description="submitted earlier, and again now")
    waiting: int = Field(default=0, description="submitted earlier, waiting or running")
    left_out: dict[str, str] = Field(default={}, description="capture -> why it has no job, or will fail")


class PlaceList(BaseModel):
    """Places that submissions may name."""

    roots: list[str]


@router.get("/places")
def places(state: Service) -> PlaceList:
    """List the folders and URLs below which submitted captures, models and results must lie."""
    return PlaceList(roots=state.places.offered)


@router.post("/batches", status_code=202)
def submit_captures(state: Service, request: BatchRequest, response: Response) -> Submitted:
    """Register captures. Those that cannot be used do not stop the others."""
    out = state.places.out(request.out, request.run)
    places, left_out = _captures(state, request.captures)
    if not places:
        got = "; ".join(left_out.values())[:400]
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, "There is nothing to register", where="captures", got=got)
    options = from_job(request.options.model_dump())
    batch = batch_jobs(places, model=_model(state, request.model), out=out, run=request.run, options=options)
    try:
        submission = submit_batch(state.settings.url, batch)
    except InputError as error:
        raise Problem.of_input(error, HTTPStatus.CONFLICT) from None
    left_out |= dict(batch.left_out) | {place: "no folder with capture.toml" for place in batch.missing}
    numbers = {"new": submission.new, "again": submission.again, "waiting": submission.waiting}
    return _submitted(state, response, batch.run, out, total=submission.total, left_out=left_out, **numbers)


@router.post("/subjects", status_code=202)
def submit_subject(state: Service, request: SubjectRequest, response: Response) -> Submitted:
    """Register a subject: the neutral, then each expression from it."""
    places = {
        "subject": state.places.subject(request.subject),
        "model": _local(_model(state, request.model), "model"),
        "out": _local(state.places.out(request.out, request.run), "out"),
    }
    done = state.submitting.call(
        "submit_one_subject",
        url=state.settings.url,
        run=request.run,
        places=places,
        options=request.options.model_dump(),
        neutral=request.neutral,
    )
    return _submitted(state, response, request.run, places["out"], new=done["total"], **done)


@router.post("/coregistrations", status_code=202)
def submit_coregistration(state: Service, request: CoregistrationRequest, response: Response) -> Submitted:
    """Build a head model from a dataset in rounds."""
    places = {
        "dataset": state.places.folder(request.dataset, "dataset"),
        "model": _local(_model(state, request.model), "model"),
        "out": _local(state.places.out(request.out, request.run), "out"),
    }
    rounds = ("iterations", "all_iterations", "model_recipe", "held_out", "components", "anatomy", "gate")
    done = state.submitting.call(
        "submit_rounds",
        url=state.settings.url,
        run=request.run,
        places=places,
        options=request.options.model_dump(),
        rounds={name: getattr(request, name) for name in rounds},
        farm=str(state.settings.folder),
    )
    return _submitted(state, response, request.run, places["out"], new=done["total"], **done)


def _captures(state: ServiceState, words: list[str]) -> tuple[list[str], dict[str, str]]:
    """The places that words name, and word -> why it names none. Raises Problem for a place outside the roots."""
    places: list[str] = []
    left_out: dict[str, str] = {}
    for word in words:
        try:
            places += state.places.capture(word)
        except InputError as error:
            left_out[printable(redact(word))[:200]] = error.line
    return places, left_out


def _model(state: ServiceState, name: str) -> str:
    """The place of a model; one of this machine's cache is copied to where workers may read it. Raises Problem."""
    place = state.places.model(name)
    if place is None and "/" in name:
        built = find_model(state, name)
        place = None if built is None else str(built.file)
    if place is None and name in (FIRST, OFFICIAL):
        folder = state.places.models / name
        place = state.submitting.call("store_cached_model", name=name, folder=str(folder))
    if place is None:
        raise Problem.missing("model", name, "list them at /api/v1/models")
    return place


def _local(place: str, where: str) -> str:
    if is_remote(place):
        expected = "a path: subjects and coregistrations need folders that all processes see"
        raise Problem(
            HTTPStatus.UNPROCESSABLE_ENTITY, "A folder is needed", where=where, expected=expected, got="a URL"
        )
    return place


def _submitted(state: ServiceState, response: Response, run: str, out: str, **numbers: Any) -> Submitted:
    state.board.refresh()
    response.headers["Location"] = f"/api/v1/runs/{run}"
    left_out: Mapping[str, str] = numbers.pop("left_out")
    shown = {printable(redact(name)): reason for name, reason in left_out.items()}
    return Submitted(run=run, out=redact(out), left_out=shown, **numbers)
