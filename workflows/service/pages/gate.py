"""The pages of the quality gate: which runs wait for a person, and one registration after the other with pictures."""

import re
import time
from collections.abc import Sequence
from typing import Annotated, Any
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from registration.errors import InputError
from workflows.gate.figures import FIGURES
from workflows.gate.item import GateItem
from workflows.service.access import need
from workflows.service.api.gate import can_continue, gate_run
from workflows.service.api.jobs import expression_name, list_runs
from workflows.service.gate_book import GateRun, Shown, fits
from workflows.service.pages.base import page
from workflows.service.pages.files import picture_url, pictures, row_of
from workflows.service.problems import Problem
from workflows.service.results import results_of
from workflows.service.state import Service, ServiceState

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
MAX_RUNS, RUNS_S = 12, 0.2  # runs on the first page, and for how long it waits for all of them
VIEWS = 3  # of the cameras
LISTED = 60  # registrations that are listed beside the one that is shown
LOGGED = 40
_VIEW = re.compile(r"(?P<view>.+): colour, (?P<what>.+)", re.DOTALL)
_FRONT, _HEAT = "texture, front", ("subject's right", "front", "subject's left")
_NEUTRAL = ("neutral", "rest")


@router.get("/gate")
def gate_page(state: Service, request: Request) -> Response:
    """Show the runs at the gate, and the last decisions."""
    runs, problem, until_s = [], "", time.monotonic() + RUNS_S
    try:
        for run in list_runs(state)[:MAX_RUNS]:
            gate = state.gate.of_run(state, run.id, max(0.0, until_s - time.monotonic()))
            if gate.items or gate.unread:
                runs.append({"id": run.id, "counts": gate.counts, "unread": gate.unread, "total": len(gate.items)})
        log = state.gate.log.read()[::-1][:LOGGED]
    except InputError as error:
        log, problem = (), error.line
    return page(request, "gate.html", runs=runs, log=log, problem=problem)


@router.get("/gate/{run}")
def review(
    state: Service,
    request: Request,
    run: str,
    show: Shown = "waiting",
    job: Annotated[str, Query(max_length=800)] = "",
) -> Response:
    """Show one registration of a run at the gate: `job`, or the first that a filter shows."""
    gate = gate_run(state, run)
    chosen = [name for name, item in gate.items.items() if fits(item, show)]
    if job and job not in gate.items:
        raise Problem.missing("registration", job, "see the run's page at the gate")
    shown = job or (chosen[0] if chosen else "")
    at = chosen.index(shown) if shown in chosen else -1
    item = gate.items.get(shown)

    def address(name: str) -> str:
        return f"/gate/{quote(run)}?{urlencode({'show': show, 'job': name})}"

    return page(
        request,
        "gate_review.html",
        run=run,
        show=show,
        counts=gate.counts,
        error=gate.error,
        total=len(gate.items),
        unread=gate.unread,
        job=shown,
        item=item,
        figures=[] if item is None else _figures(item),
        neutral="" if item is None else _neutral(gate, shown),
        sheets=[] if item is None else _sheets(state, gate, shown, item),
        next=address(chosen[at + 1]) if 0 <= at < len(chosen) - 1 else f"/gate/{quote(run)}?show={show}",
        before=address(chosen[at - 1]) if at > 0 else "",
        listed=[(name, gate.items[name], address(name)) for name in chosen[max(0, at - 5) : max(0, at - 5) + LISTED]],
        found=len(chosen),
        at=at + 1,
        last=_last_decision(state, request, gate),
        can_continue=can_continue(state, run, gate.unread + gate.counts["waiting"]),
    )


def _figures(item: GateItem) -> list[dict[str, Any]]:
    """The figures with what the rules say of each, the worst first."""
    levels = {reason.figure: reason for reason in item.verdict.reasons if reason.figure}
    rows = []
    for name, value in item.figures.known().items():
        kind, reason = FIGURES[name], levels.get(name)
        rows.append(
            {
                "title": kind.title,
                "text": kind.text(value),
                "meaning": kind.meaning,
                "level": reason.level if reason else "accept",
                "limit": "" if reason is None or reason.limit is None else kind.text(reason.limit),
            }
        )
    return sorted(rows, key=lambda row: ("reject", "look", "accept").index(row["level"]))


def _sheets(state: ServiceState, gate: GateRun, job: str, item: GateItem) -> list[dict[str, Any]]:
    """Rows of pictures: the neutral beside the expression, the cameras, the heat map."""
    own = _pictures(state, job, item)
    neutral = _neutral(gate, job)
    rows = []
    pair = []
    if neutral:
        pair = [(f"the neutral: {caption}", url) for caption, url in _pictures(state, neutral, gate.items[neutral])]
        pair = [(caption, url) for caption, url in pair if caption.endswith(_FRONT)]
    front = [(caption, url) for caption, url in own if caption in (_FRONT, "mesh, front")]
    if front:
        rows.append({"title": "Neutral beside expression" if pair else "Mesh", "pictures": [*pair, *front]})
    views: dict[str, list[tuple[str, str]]] = {}
    for caption, url in own:
        if match := _VIEW.fullmatch(caption):
            views.setdefault(match["view"], []).append((match["what"], url))
    rows += [{"title": view, "pictures": found[:3]} for view, found in list(views.items())[:VIEWS]]
    heat = [(caption, url) for caption, url in own if caption in _HEAT]
    if heat:
        rows.append({"title": "Distance from the scan", "pictures": heat})
    return rows


def _pictures(state: ServiceState, job: str, item: GateItem) -> Sequence[tuple[str, str]]:
    try:
        found = results_of(state, row_of(state, job))
    except Problem:
        return ()
    listed = () if found is None else pictures(state, found.report)
    return [(one.caption, picture_url(job, number, item.content_id)) for number, one in enumerate(listed)]


def _neutral(gate: GateRun, job: str) -> str:
    """The job of the neutral of the same subject; empty if there is none, or it is this one."""
    beside = job.rpartition("/")[0]
    others = [name for name in gate.items if name.rpartition("/")[0] == beside and name != job]
    return next((name for name in others if expression_name(name).lower() in _NEUTRAL), "")


def _last_decision(state: ServiceState, request: Request, gate: GateRun) -> dict[str, str] | None:
    """What undo takes back: the last decision of this person about a registration of the run that still holds."""
    jobs = {item.content_id: job for job, item in gate.items.items()}
    for entry in reversed(state.gate.log.read()):
        job = jobs.get(entry.content_id)
        if job is not None and entry.who == request.state.identity.name:
            held = gate.items[job].decision
            if held is not None and held.sequence == entry.sequence:
                return {"job": job, "content_id": entry.content_id, "decision": entry.decision, "name": entry.name}
    return None
