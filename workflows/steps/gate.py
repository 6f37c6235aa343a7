"""The step that decides which registrations of a round its model is built from."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from registration.progress import Progress
from registration.storage.files import atomic_directory
from workflows.engine.jobs import PermanentStepError
from workflows.gate.decisions import DecisionLog, current
from workflows.gate.item import GateItem, gate_error
from workflows.gate.items import gate_items, subject_registrations
from workflows.gate.rules import GateThresholds
from workflows.gate.table import accepted_id, counts, to_csv
from workflows.ids import check_name
from workflows.records.step_results import GateDecision, GateResult, Policy
from workflows.records.subject import read_usable
from workflows.steps.coregistration_page import shown_on_page

RECORD, TABLE = "gate.json", "verdicts.csv"


@shown_on_page()
def gate_registrations(
    *,
    run: str,
    names: Sequence[str],
    policy: Policy,
    thresholds: Mapping[str, Any],
    decisions: str | None,
    out: str,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Judge the usable registrations of a run, and write which of them a model may be built from.

    Args:
        run: folder of the subject folders.
        names: of the subject folders.
        policy: "auto": what is for a person is used until a person rejects it. "person": all of it must be decided.
        thresholds: a `GateThresholds` as JSON.
        decisions: folder of the log of decisions; None: there are none.
        out: folder of the record and the table.
        progress: unused; the step is short.

    Returns:
        A `GateResult` as JSON, without the registrations that are left out, of which there may be many: the record
        has them.

    Raises:
        InputError: a record, the thresholds or the log is damaged.
        PermanentStepError: registrations wait for a person; the record and the table say which.
    """
    limits = GateThresholds.from_json(thresholds, where="the job's thresholds")
    log = None if decisions is None else DecisionLog(Path(decisions))
    held = {} if log is None else current(log.read())
    items: list[GateItem] = []
    left_out: dict[str, str] = {}
    for name in names:
        folder = Path(run) / check_name(name, "names")
        usable = read_usable(folder)
        if usable is None:
            continue
        wanted = {f"{name}/{one}" for one in usable.names}
        found = [one for one in subject_registrations(folder, name) if one.name in wanted]
        of_subject = gate_items(found, limits, held)
        items += of_subject
        left_out |= _left_out(of_subject, f"{name}/{usable.neutral}", policy)
    result = _result(items, left_out, policy, limits, log)
    with atomic_directory(Path(out)) as temporary:
        result.write(temporary / RECORD)
        (temporary / TABLE).write_text(to_csv(items, policy), encoding="utf-8")
    if policy == "person" and result.waiting:
        noun = "registration waits" if result.waiting == 1 else "registrations wait"
        raise PermanentStepError(f"{result.waiting} {noun} for a person; decide, then `gnmreg retry`")
    return result.brief().to_json()


def read_gate(folder: str | None) -> GateResult | None:
    """Return the record in a folder that the step wrote; None without a folder.

    Raises:
        InputError: there is none, or it is malformed.
    """
    return None if folder is None else GateResult.read(Path(folder) / RECORD)


def _left_out(items: Sequence[GateItem], neutral: str, policy: Policy) -> dict[str, str]:
    """Name -> reason of a subject's registrations that are not used: without its neutral an expression is nothing."""
    reasons = {item.name: _reason(item) for item in items if not item.accepted(policy)}
    if neutral in reasons:
        reasons |= {item.name: "its neutral is left out" for item in items if item.name not in reasons}
    return reasons


def _reason(item: GateItem) -> str:
    if item.decision is not None:
        return f"{item.decision.who}: {item.decision.reason or 'rejected'}"
    return item.verdict.text


def _result(
    items: Sequence[GateItem],
    left_out: Mapping[str, str],
    policy: Policy,
    thresholds: GateThresholds,
    log: DecisionLog | None,
) -> GateResult:
    error = gate_error(items)
    return GateResult(
        policy=policy,
        thresholds=thresholds.content_id,
        thresholds_name=thresholds.name,
        verdicts=counts(items),
        accepted=len(items) - len(left_out),
        accepted_id=accepted_id([item for item in items if item.name not in left_out], policy),
        waiting=sum(item.waits and item.verdict.level == "look" for item in items),
        left_out=left_out,
        left_out_count=len(left_out),
        decisions=tuple(
            GateDecision(
                name=item.name,
                content_id=item.content_id,
                decision=item.decision.decision,
                who=item.decision.who,
                reason=item.decision.reason,
                time=item.decision.time,
                sequence=item.decision.sequence,
                verdict=item.verdict.level,
            )
            for item in items
            if item.decision is not None
        ),
        log_head=None if log is None else log.head.sha256,
        sample_shown=0 if error is None else error.shown,
        sample_rejected=0 if error is None else error.rejected,
    )
