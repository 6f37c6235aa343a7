"""Routes that list subjects: groups of the captures that are registered."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query
from pydantic import BaseModel, Field

from workflows.service.access import need
from workflows.service.api.jobs import JobQuery, Limit, Name, Offset, plain_name
from workflows.service.problems import RESPONSES
from workflows.service.state import Service

router = APIRouter(tags=["runs and jobs"], dependencies=[Depends(need("viewer"))], responses=RESPONSES)


class Subject(BaseModel):
    """The captures of one subject in one run, or in one round of it."""

    id: str = Field(description="of the part of the run that holds its jobs")
    name: str
    counts: dict[str, int] = Field(description="state -> captures")
    statuses: dict[str, int] = Field(description="status -> captures")
    captures: list[str] = Field(description="ids of the jobs that register them")


class SubjectPage(BaseModel):
    """A part of a list."""

    total: int
    offset: int
    subjects: list[Subject]


@router.get("/subjects")
def subjects(
    state: Service,
    run: Annotated[str | None, Query(max_length=200, description="a run, or a part of one")] = None,
    name: Name = None,
    offset: Offset = 0,
    limit: Limit = 100,
) -> SubjectPage:
    """List the subjects whose captures are registered, by name."""
    groups: dict[str, Subject] = {}
    for entry in JobQuery(run=run, subject=name).jobs(state):
        if not entry.times.captures or entry.id.count("/") < 2:
            continue
        part = entry.id.rpartition("/")[0]
        group = groups.get(part)
        if group is None:
            shown = plain_name(part.rpartition("/")[2])
            group = groups[part] = Subject(id=part, name=shown, counts={}, statuses={}, captures=[])
        for counts, key in ((group.counts, entry.times.state), (group.statuses, entry.status)):
            counts[key] = counts.get(key, 0) + 1
        group.captures.append(entry.id)
    listed = sorted(groups.values(), key=lambda group: (group.name, group.id))
    return SubjectPage(total=len(listed), offset=offset, subjects=listed[offset : offset + limit])
