"""The step that ends a round: the stopping rule, the record of the coregistration and its page."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coregister.stopping_rule import RoundMetrics, apply_stopping_rule
from registration.errors import InputError
from registration.progress import Progress
from registration.storage.records import structure, to_json
from workflows.ids import check_name
from workflows.records.coregistration import (
    CoregistrationPlan,
    CoregistrationState,
    RoundProducts,
    RoundRecord,
    initial_state,
)
from workflows.records.round_files import FIRST_MODEL, model_name
from workflows.records.step_results import CaptureResult, EvaluateResult, HoldOutResult
from workflows.records.subject import read_subject
from workflows.steps.coregistration_page import write_record


def end_round(
    *,
    plan: str,
    held_out: Mapping[str, Any],
    rounds: Sequence[Mapping[str, Any]],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Apply the stopping rule after a round, and write the record and the page of the coregistration.

    Args:
        plan: the file `plan.json`.
        held_out: a `HoldOutResult` as JSON.
        rounds: all rounds so far, each a `RoundProducts` as JSON; the records of their subjects are read from disk.
        progress: unused; the step is short.

    Returns:
        A `StoppingVerdict` as JSON.

    Raises:
        InputError: the plan, an argument or a subject's record is malformed.
    """
    where = "arguments of the step"
    record = CoregistrationPlan.read(Path(plan))
    _check_places(record, Path(plan))
    held_out_result = HoldOutResult.from_json(held_out, where=where)
    products: tuple[RoundProducts, ...] = structure(rounds, tuple[RoundProducts, ...], where=where, title="rounds")
    for product in products:
        check_name(product.name, "rounds")
    state = apply_verdict(initial_state(record, held_out_result), products)
    write_record(state)
    verdict: dict[str, Any] = to_json(state.verdict)
    return verdict


def _check_places(record: CoregistrationPlan, file: Path) -> None:
    """Refuse a plan of another folder: the file's place was checked, what it says was not."""
    if Path(os.path.realpath(record.out)) != Path(os.path.realpath(file)).parent:
        raise InputError(
            "The plan is of another coregistration",
            where=file,
            expected=f"the plan of {file.parent}",
            got=record.out,
            fix="run `gnmreg coregister` again",
        )
    for name in (*record.split.training, *record.split.held_out):
        check_name(name, "plan: split")


def apply_verdict(state: CoregistrationState, products: Sequence[RoundProducts]) -> CoregistrationState:
    """Return the state after some rounds: their models and records, the latest evaluation, and the verdict.

    Args:
        state: before the first round.
        products: of all rounds so far.

    Raises:
        InputError: a subject's record is malformed.
    """
    plan, latest = state.plan, products[-1].evaluate
    rounds = []
    for number, product in enumerate(products, 1):
        run = plan.out / product.name / "registrations"
        register = {name: _capture_results(run / name) for name in plan.split.training}
        metrics = _metrics(product, register, latest, number)
        rounds.append(RoundRecord(**vars(product), register=register, decide=metrics))
    first_mm = latest.generalization_mm[FIRST_MODEL][str(latest.at)]
    assert first_mm is not None
    return replace(
        state,
        models={FIRST_MODEL: str(plan.model)} | {model_name(n): p.build.model for n, p in enumerate(products, 1)},
        rounds=tuple(rounds),
        generalization_mm=latest.generalization_mm,
        specificity_mm=latest.specificity_mm,
        at=latest.at,
        verdict=apply_stopping_rule(first_mm, [round_.decide for round_ in rounds], plan.rule),
    )


def _metrics(
    product: RoundProducts, register: Mapping[str, Mapping[str, CaptureResult]], latest: EvaluateResult, number: int
) -> RoundMetrics:
    """What the stopping rule needs of a round. All models are evaluated alike, in the latest evaluation."""
    generalization_mm = latest.generalization_mm[model_name(number)][str(latest.at)]
    assert generalization_mm is not None
    failed = sum(not capture.usable for captures in register.values() for capture in captures.values())
    return RoundMetrics(
        generalization_mm=generalization_mm,
        drift_mm=product.build.drift_mm,
        registered=product.build.registered,
        failed=failed + len(product.build.rejected) + (product.gate.left_out_count if product.gate else 0),
    )


def _capture_results(folder: Path) -> dict[str, CaptureResult]:
    """The registrations of a subject; without a record, none of its jobs came so far as to write one."""
    record = read_subject(folder)
    if record is None:
        return {"all": CaptureResult(status="error", reason="its jobs failed", usable=False)}
    return {row.name: CaptureResult(status=row.status, reason=row.reason, usable=row.usable) for row in record.rows}
