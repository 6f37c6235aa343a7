"""Routes of the quality gate: what waits for a person, decisions, their log."""

from dataclasses import asdict
from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, Field

from registration.errors import InputError
from workflows.engine.reader import FAILED
from workflows.gate.decisions import MAX_REASON, DecisionEntry, Ruling
from workflows.gate.item import GateItem, Policy
from workflows.service.access import Identity, need
from workflows.service.api.jobs import Limit, Offset, find_entry
from workflows.service.gate_book import GateRun, Shown, fits
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState

router = APIRouter(tags=["gate"], dependencies=[Depends(need("viewer"))], responses=RESPONSES)
Reviewer = Annotated[Identity, Depends(need("reviewer"))]


class GateReason(BaseModel):
    """Why a verdict is not accept."""

    level: str
    text: str


class Decision(BaseModel):
    """An entry of the log of decisions."""

    sequence: int
    time: str
    who: str
    content_id: str
    name: str
    decision: str
    reason: str
    verdict: str
    thresholds: str


class GateRow(BaseModel):
    """A registration at the gate."""

    job: str
    name: str
    content_id: str
    status: str
    verdict: str = Field(description="of the rules: accept, look or reject")
    reasons: list[GateReason]
    sampled: bool = Field(description="accepted by the rules, and shown to a person to measure their error")
    waits: bool
    decision: Decision | None
    accepted: bool = Field(description="whether a model may be built from it")


class Error(BaseModel):
    """How many of the accepted are wrong, from the sample of them that a person was shown."""

    shown: int
    rejected: int
    low: float = Field(description="bounds of the share, 95 %")
    high: float


class GatePage(BaseModel):
    """A part of the registrations of a run."""

    total: int
    offset: int
    unread: int = Field(description="registrations that are not read yet: ask again")
    counts: dict[str, int]
    thresholds: str = Field(description="content id")
    error: Error | None = Field(description="the rules' own; null: no person was shown one of the accepted")
    items: list[GateRow]


class DecisionRequest(BaseModel):
    """A person's decision about a registration."""

    job: Annotated[str, Field(max_length=800, examples=["monday/ann/smile"])]
    content_id: Annotated[str, Field(max_length=200, description="of the registration that the person saw")]
    decision: Literal["accept", "reject", "undo"]
    reason: Annotated[str, Field(max_length=MAX_REASON)] = ""


class Decided(BaseModel):
    """What was recorded."""

    entry: Decision
    waiting: int = Field(description="registrations of the run that still wait for a person")
    can_continue: bool = Field(description="nothing waits any more, and the run is parked: retry continues it")


class LogPage(BaseModel):
    """A part of the log, the latest first."""

    total: int
    offset: int
    entries: list[Decision]


@router.get("/gate/items")
def items(
    state: Service,
    run: Annotated[str, Query(max_length=200)],
    show: Shown = "waiting",
    policy: Policy = "auto",
    offset: Offset = 0,
    limit: Limit = 100,
) -> GatePage:
    """List the registrations of a run, those that wait for a person first."""
    gate = gate_run(state, run)
    chosen = [(job, item) for job, item in gate.items.items() if fits(item, show)]
    return GatePage(
        total=len(chosen),
        offset=offset,
        unread=gate.unread,
        counts=dict(gate.counts),
        thresholds=gate.thresholds.content_id,
        error=None if gate.error is None else Error(**asdict(gate.error)),
        items=[_row(job, item, policy) for job, item in chosen[offset : offset + limit]],
    )


@router.post("/gate/decisions")
def decide(state: Service, request: Request, identity: Reviewer, given: DecisionRequest) -> Decided:
    """Accept or reject a registration, or undo the last decision about it."""
    run = find_entry(state, given.job).run
    gate = gate_run(state, run)
    item = gate.items.get(given.job)
    if item is None:
        raise Problem.missing("registration", given.job, "list them at /api/v1/gate/items")
    if item.content_id != given.content_id:
        raise Problem(
            HTTPStatus.CONFLICT,
            "The registration was computed again",
            where=item.name,
            expected=item.content_id,
            got=given.content_id[:200],
            fix="look at the new one",
        )
    ruling = Ruling(
        content_id=item.content_id,
        name=item.name,
        decision=given.decision,
        reason=given.reason,
        who=identity.name,
        thresholds=gate.thresholds.content_id,
        verdict=item.verdict.level,
    )
    try:
        entry = state.gate.log.append(ruling)
    except InputError as error:
        raise Problem.of_input(error, HTTPStatus.CONFLICT if given.decision == "undo" else HTTPStatus(422)) from None
    waiting = gate_run(state, run).counts["waiting"]
    return Decided(entry=_entry(entry), waiting=waiting, can_continue=can_continue(state, run, gate.unread + waiting))


@router.get("/gate/log")
def log(state: Service, offset: Offset = 0, limit: Limit = 100) -> LogPage:
    """Return the log of decisions, verified, the latest first."""
    entries = state.gate.log.read()
    chosen = entries[::-1][offset : offset + limit]
    return LogPage(total=len(entries), offset=offset, entries=[_entry(entry) for entry in chosen])


def gate_run(state: ServiceState, run: str) -> GateRun:
    """Return a run at the gate. Raises Problem if there is none."""
    if not any(entry.run == run for entry in state.board.entries.values()):
        raise Problem.missing("run", run, "list them at /api/v1/runs")
    return state.gate.of_run(state, run)


def can_continue(state: ServiceState, run: str, waiting: int) -> bool:
    """Return whether a run has been parked and no registration of it waits for a person."""
    driver = state.board.entries.get(run)
    return waiting == 0 and driver is not None and driver.times.kind == "flow" and driver.times.state == FAILED


def _row(job: str, item: GateItem, policy: Policy) -> GateRow:
    return GateRow(
        job=job,
        name=item.name,
        content_id=item.content_id,
        status=item.assessed.status,
        verdict=item.verdict.level,
        reasons=[GateReason(level=reason.level, text=reason.text) for reason in item.verdict.reasons],
        sampled=item.verdict.sampled,
        waits=item.waits,
        decision=None if item.decision is None else _entry(item.decision),
        accepted=item.accepted(policy),
    )


def _entry(entry: DecisionEntry) -> Decision:
    return Decision(**{name: getattr(entry, name) for name in Decision.model_fields})
