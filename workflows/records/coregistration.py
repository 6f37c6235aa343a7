"""The record of a coregistration, `coregistration.json`, and its plan, `plan.json`, for coordinators and workers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coregister.anatomy.part_basis import PartName
from coregister.next_model.recipes import ModelRecipe
from coregister.stopping_rule import RoundMetrics, StoppingRule, StoppingVerdict
from registration.options import RegisterOptions
from registration.storage.files import refuse_foreign
from registration.storage.hashing import versions
from registration.storage.records import Record
from workflows.records.dataset import Split
from workflows.records.round_files import FIRST_MODEL, MANIFEST
from workflows.records.step_results import (
    BuildResult,
    CaptureResult,
    Curves,
    EvaluateResult,
    GateResult,
    HoldOutResult,
    Policy,
    StabilizeResult,
)


@dataclass(frozen=True, kw_only=True)
class GateSettings:
    """Which registrations models are built from."""

    policy: Policy
    thresholds: Mapping[str, Any]  # a `GateThresholds` as JSON
    decisions: Path | None = None  # folder of the log of decisions; None: there are none


@dataclass(frozen=True, kw_only=True)
class CoregistrationPlan(
    Record, kind="gnm-coregistration-plan", title="coregistration's plan", fix="run `gnmreg coregister` again"
):
    """Everything that is decided before the first step: `plan.json`. Paths are absolute."""

    dataset: Path
    model: Path  # the first one
    out: Path
    options: RegisterOptions  # of all registrations
    model_recipe: ModelRecipe
    components: tuple[int, ...]  # numbers of components that models are evaluated with
    samples: int  # random heads of each model, for specificity
    rule: StoppingRule
    split: Split
    captures: Mapping[str, tuple[str, ...]]  # subject -> folders of captures, the neutral's first
    without_truth: tuple[str, ...]  # held-out subjects whose captures have no true meshes
    anatomy: tuple[PartName, ...] = ()  # parts that the first round regenerates in its model
    gate: GateSettings | None = None  # None: all usable registrations are used

    @property
    def seed(self) -> int:
        """The seed of everything random."""
        return self.options.seed


@dataclass(frozen=True, kw_only=True)
class RoundProducts:
    """The results of a round's steps, as its flow has them."""

    name: str  # "it00", the name of its folder
    stabilize: StabilizeResult
    build: BuildResult
    evaluate: EvaluateResult
    gate: GateResult | None = None  # in brief; None: there was no gate


@dataclass(frozen=True, kw_only=True)
class RoundRecord(RoundProducts):
    """A round, with what the stopping rule was applied to."""

    register: Mapping[str, Mapping[str, CaptureResult]]  # subject -> capture -> its registration
    decide: RoundMetrics


@dataclass(frozen=True, kw_only=True)
class CoregistrationState(
    Record, kind="gnm-coregistration", schema=2, title="coregistration's record", fix="run `gnmreg coregister` again"
):
    """All rounds so far: `coregistration.json`."""

    plan: CoregistrationPlan
    sources: Mapping[str, str] = field(default_factory=dict)  # held-out subject -> what it is evaluated on
    lost: tuple[str, ...] = ()  # held-out subjects that have nothing to be evaluated on
    models: Mapping[str, str] = field(default_factory=dict)  # name -> file
    rounds: tuple[RoundRecord, ...] = ()
    generalization_mm: Curves = field(default_factory=dict)
    specificity_mm: Curves = field(default_factory=dict)
    at: int = 0  # the number of components that the stopping rule uses
    verdict: StoppingVerdict | None = None
    stopped: str = ""  # why the run ended without a verdict on its last round, as far as the command knows
    versions: Mapping[str, str] = field(default_factory=versions)


def initial_state(plan: CoregistrationPlan, held_out: HoldOutResult | None = None) -> CoregistrationState:
    """Return the state before the first round."""
    return CoregistrationState(
        plan=plan,
        sources={} if held_out is None else held_out.sources,
        lost=() if held_out is None else held_out.lost,
        models={FIRST_MODEL: str(plan.model)},
    )


def write_state(state: CoregistrationState) -> None:
    """Write `coregistration.json` into the plan's output folder, in one rename."""
    out = state.plan.out
    out.mkdir(parents=True, exist_ok=True)
    state.write(out / MANIFEST)


def check_out(out: Path) -> None:
    """Refuse, before any work, an output folder that is not a coregistration's. Raises InputError."""
    refuse_foreign(out, kind=CoregistrationState.KIND, command="coregister", manifest=MANIFEST)
