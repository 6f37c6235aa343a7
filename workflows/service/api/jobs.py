"""Routes that list and show runs and jobs."""

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query
from pydantic import BaseModel, Field

from registration.errors import InputError
from workflows.engine.failures import kind_of
from workflows.engine.reader import CANCELLED, DONE, FAILED, INTERRUPTED, RUNNING, WAITING
from workflows.ids import check_id, redact
from workflows.service.access import need
from workflows.service.board import Entry
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState

router = APIRouter(tags=["runs and jobs"], dependencies=[Depends(need("viewer"))], responses=RESPONSES)
MAX_PAGE = 500
MAX_LOG_BYTES = 256 * 1024  # of one answer
State = Literal["waiting", "running", "interrupted", "done", "failed", "cancelled"]  # those of engine.reader
Offset = Annotated[int, Query(ge=0, le=2**31)]
Limit = Annotated[int, Query(ge=1, le=MAX_PAGE)]
Name = Annotated[str | None, Query(max_length=200)]


class Run(BaseModel):
    """A run: a batch, a subject or a coregistration."""

    id: str
    kind: str = Field(description="batch, subject, coregister; empty for a run whose driver is gone")
    state: str = Field(description="of the run's driver")
    reason: str = Field(description="why the driver failed or parked the run")
    created: float = Field(description="seconds since 1970")
    counts: dict[str, int] = Field(description="state -> jobs")


class Job(BaseModel):
    """A job or flow, in short."""

    id: str
    kind: str
    state: str
    status: str
    reason: str
    verdict: str
    executor: str | None
    created: float
    started: float | None
    ended: float | None
    content_id: str


class JobPage(BaseModel):
    """A part of a list."""

    total: int
    offset: int
    jobs: list[Job]


class JobDetails(Job):
    """A job with its arguments and its result."""

    spec: dict[str, Any]
    result: dict[str, Any] | None
    failure: dict[str, Any] | None


class LogPart(BaseModel):
    """A part of a job's output."""

    offset: int
    next_offset: int
    text: str


@router.get("/runs")
def runs(
    state: Service,
    kind: Annotated[str | None, Query(max_length=40, description="batch, subject, coregister")] = None,
    run_state: Annotated[State | None, Query(alias="state", description="of the run's driver")] = None,
    offset: Offset = 0,
    limit: Limit = 100,
) -> list[Run]:
    """List runs, the newest first."""
    chosen = [run for run in list_runs(state) if kind in (None, run.kind) and run_state in (None, run.state)]
    return chosen[offset : offset + limit]


@router.get("/runs/{run}")
def run(state: Service, run: str) -> Run:
    """Show one run."""
    found = list_runs(state, run)
    if not found:
        raise Problem.missing("run", run, "list them at /api/v1/runs")
    return found[0]


@router.get("/jobs")
def jobs(
    state: Service,
    run: Annotated[str | None, Query(max_length=200, description="a run, or a part of one")] = None,
    job_state: Annotated[State | None, Query(alias="state")] = None,
    status: Name = None,
    subject: Name = None,
    text: Annotated[str | None, Query(max_length=200, description="in the id or the reason")] = None,
    offset: Offset = 0,
    limit: Limit = 100,
) -> JobPage:
    """List jobs, those that need a look first."""
    chosen = JobQuery(run=run, state=job_state, status=status, subject=subject, text=text).jobs(state)
    page = [Job(**entry.brief()) for entry in chosen[offset : offset + limit]]
    return JobPage(total=len(chosen), offset=offset, jobs=page)


@router.get("/jobs/{job:path}")
def job(state: Service, job: str) -> JobDetails:
    """Show a job with its arguments and its result."""
    entry = find_entry(state, job)
    row = state.reader.rows([job]).get(job)
    if row is None:
        raise Problem.missing("job", job)
    return JobDetails(**entry.brief(), spec=_redacted(row.spec), result=_redacted(row.result), failure=row.failure)


@router.get("/logs/{job:path}")
def log(state: Service, job: str, offset: Offset = 0) -> LogPart:
    """Return the part of a job's output that begins at a byte offset."""
    find_entry(state, job)
    file = state.settings.folder / "logs" / f"{check_id(job)}.log"
    if not file.is_file():
        return LogPart(offset=offset, next_offset=offset, text="")
    with file.open("rb") as stream:
        stream.seek(offset)
        part = stream.read(MAX_LOG_BYTES)
    return LogPart(offset=offset, next_offset=offset + len(part), text=redact(part.decode("utf-8", "replace")))


class JobQuery(BaseModel):
    """Which jobs are listed."""

    run: str | None = None
    state: str | None = None
    status: str | None = None
    subject: str | None = None
    expression: str | None = None
    kind: str | None = None  # of a failure, as `engine.failures.kind_of` returns it
    text: str | None = None

    def entries(self, state: ServiceState) -> list[Entry]:
        """Return the jobs of the run or part, whatever else is asked for, those that need a look first.

        Raises:
            Problem: there is no such run.
        """
        board, run = state.board.entries, self.run
        entries = state.board.derived.get(board, ("jobs", run), lambda: _ranked_jobs(board, run))
        if run is not None and not entries and run not in board:
            raise Problem.missing("run", run, "list them at /api/v1/runs")
        return entries

    def jobs(self, state: ServiceState, among: list[Entry] | None = None) -> list[Entry]:
        """Return the jobs, those that need a look first; `among`: what `entries` returns, if that is known."""
        entries = self.entries(state) if among is None else among
        every = self.model_dump(exclude={"run"}, exclude_none=True) == {}
        return entries if every else list(filter(self._accepts, entries))

    def _accepts(self, entry: Entry) -> bool:
        if self.state is not None and entry.times.state != self.state:
            return False
        if self.status is not None and self.status not in (entry.status, entry.level):
            return False
        if self.subject is not None and self.subject not in subject_names(entry.id):
            return False
        if self.expression is not None and self.expression != expression_name(entry.id):
            return False
        if self.kind is not None:
            failure = entry.times.failure
            if entry.times.state != FAILED or failure is None or kind_of(failure) != self.kind:
                return False
        return self.text is None or self.text.lower() in f"{entry.id}\n{entry.reason}".lower()


def subject_names(identity: str) -> Iterator[str]:
    """The names of folders in a job's id that may be a subject's, with and without number."""
    for part in identity.split("/")[1:]:
        yield part
        yield plain_name(part)


def plain_name(part: str) -> str:
    """Return a part of a job's id without the number of the subject or expression."""
    head, _, name = part.partition("-")
    return name if name and head[:1] in ("s", "e") and head[1:].isdigit() else part


def expression_name(identity: str) -> str:
    """Return the name of a capture's folder in a job's id, without number."""
    return re.sub(r"^(?:e\d{3}|neutral)-(?=.)", "", identity.rpartition("/")[2])


def list_runs(state: ServiceState, only: str | None = None) -> list[Run]:
    """Return all runs, the newest first; or `only` the run of this name, if there is one."""
    board = state.board.entries
    runs = state.board.derived.get(board, ("runs",), lambda: _runs(state, board))
    return runs if only is None else [run for run in runs if run.id == only]


def _runs(state: ServiceState, board: Mapping[str, Entry]) -> list[Run]:
    counts: dict[str, dict[str, int]] = {}
    created: dict[str, float] = {}
    for entry in board.values():
        own = counts.setdefault(entry.run, {})
        if entry.times.kind == "job":
            own[entry.times.state] = own.get(entry.times.state, 0) + 1
        created[entry.run] = min(created.get(entry.run, entry.times.created), entry.times.created)
    drivers = state.reader.rows([name for name in counts if name in board])
    listed = []
    for name, by_state in counts.items():
        driver, row = board.get(name), drivers.get(name)
        kind = str(row.spec.get("flow", "")) if row is not None else ""
        listed.append(
            Run(
                id=name,
                kind=kind,
                state=driver.times.state if driver else "",
                reason=driver.reason if driver else "",
                created=created[name],
                counts=by_state,
            )
        )
    return sorted(listed, key=lambda item: -item.created)


def find_entry(state: ServiceState, job: str) -> Entry:
    """Return the entry of a job's id. Raises Problem if there is none."""
    try:
        entry = state.board.entries.get(check_id(job))
    except InputError:
        entry = None
    if entry is None:
        raise Problem.missing("job", job, "list them at /api/v1/jobs")
    return entry


_ORDER = (FAILED, RUNNING, INTERRUPTED, DONE, WAITING, CANCELLED)
_LEVELS = ("wrong", "look")


def _ranked_jobs(board: Mapping[str, Entry], run: str | None) -> list[Entry]:
    """The jobs of a run or part, or of all, those that need a look first."""
    below = "" if run is None else f"{run}/"
    jobs = (entry for entry in board.values() if entry.times.kind == "job")
    return sorted((job for job in jobs if run is None or job.id == run or job.id.startswith(below)), key=_rank)


def _rank(entry: Entry) -> tuple[int, int, str]:
    level = _LEVELS.index(entry.level) if entry.level in _LEVELS else len(_LEVELS)
    return _ORDER.index(entry.times.state), level, entry.id


def _redacted(value: Any) -> Any:
    """A JSON value without the passwords of its URLs."""
    if isinstance(value, str):
        return redact(value)
    if isinstance(value, dict):
        return {redact(str(key)): _redacted(item) for key, item in value.items()}
    return [_redacted(item) for item in value] if isinstance(value, list) else value
