"""The captures of a run, or of all runs, as a wall of pictures: filters, counts, actions."""

from collections import Counter
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, Field
from starlette.responses import Response

from workflows.engine.reader import CANCELLED, DONE, FAILED, INTERRUPTED, RUNNING, WAITING
from workflows.ids import redact
from workflows.service.access import need
from workflows.service.api.jobs import JobQuery, Run, expression_name, list_runs
from workflows.service.board import Entry
from workflows.service.pages.base import look_of_entry, page
from workflows.service.pages.files import thumbnail_url
from workflows.service.problems import Problem
from workflows.service.state import Service, ServiceState

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
PAGE = 120  # captures of one page
STATES = (FAILED, RUNNING, INTERRUPTED, DONE, WAITING, CANCELLED)
Word = Annotated[str, Field(max_length=400)]


class Filters(BaseModel):
    """Which jobs are shown, and which part of their list; empty words are no filters."""

    kind: Word = ""  # of a failure
    state: Word = ""
    status: Word = ""
    subject: Word = ""
    expression: Word = ""
    text: Word = ""
    number: Annotated[int, Field(ge=1, le=100_000)] = 1  # of the page


@router.get("/runs/{run}")
def run_page(state: Service, request: Request, run: str, chosen: Annotated[Filters, Query()]) -> Response:
    """Show a run."""
    listed = next((item for item in list_runs(state, run)), None)
    if listed is None:
        raise Problem.missing("run", run, "see the overview")
    return _wall(state, request, chosen, listed)


@router.get("/jobs")
def all_jobs(state: Service, request: Request, chosen: Annotated[Filters, Query()]) -> Response:
    """Show the jobs of all runs."""
    return _wall(state, request, chosen, None)


def _wall(state: ServiceState, request: Request, chosen: Filters, run: Run | None) -> Response:
    filters = {name: value for name, value in chosen.model_dump(exclude={"number"}).items() if value}
    query = JobQuery(run=None if run is None else run.id, **filters)
    everything = JobQuery(run=query.run).entries(state)
    key = ("wall", query.run)
    counts, levels = state.board.derived.get(state.board.entries, key, lambda: _counts(everything))
    found = query.jobs(state, everything)
    pages = max(1, -(-len(found) // PAGE))
    number = min(chosen.number, pages)

    def address(page_number: int) -> str:
        return f"{request.url.path}?{urlencode({**filters, 'number': page_number})}"

    return page(
        request,
        "wall.html",
        run=run,
        chosen=chosen,
        counts=counts.most_common(),
        levels=sorted(levels.items()),
        total=len(everything),
        found=len(found),
        tiles=[_tile(entry) for entry in found[(number - 1) * PAGE : number * PAGE]],
        number=number,
        pages=pages,
        before=address(number - 1) if number > 1 else "",
        after=address(number + 1) if number < pages else "",
        filtered=bool(filters),
        path=request.url.path,
    )


def _counts(entries: list[Entry]) -> tuple[Counter[str], Counter[str]]:
    """Numbers of jobs by status, and by those levels of the verdict that ask for a look."""
    levels = Counter(entry.level for entry in entries if entry.level in ("look", "wrong"))
    return Counter(entry.status for entry in entries), levels


def _tile(entry: Entry) -> dict[str, Any]:
    return {
        "id": entry.id,
        "subject": entry.id.rpartition("/")[0].rpartition("/")[2],
        "name": expression_name(entry.id),
        "word": entry.status,
        "level": entry.level if entry.level in ("look", "wrong") else "",
        "look": look_of_entry(entry),
        "reason": redact(entry.reason),
        "thumbnail": thumbnail_url(entry.id, entry.content_id) if entry.thumbnail else "",
    }
