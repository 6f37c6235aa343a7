"""The results of a coregistration's steps, as they are in `step.json`, in the queue and in `coregistration.json`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from registration.storage.records import Record

Policy = Literal["auto", "person"]
Curves = Mapping[str, Mapping[str, float | None]]  # model -> number of components -> mm


@dataclass(frozen=True, kw_only=True)
class StepResult(Record, title="step's result", fix="delete the file to have its product computed again"):
    """Base of the results: the hash of everything that determines the product."""

    input_hash: str


@dataclass(frozen=True, kw_only=True)
class CaptureResult:
    """The registration of one capture, in brief."""

    status: str
    reason: str
    usable: bool


@dataclass(frozen=True, kw_only=True)
class CollectResult(StepResult):
    """Of the step that registers, or finds, all captures of a subject."""

    out: str  # the subject's folder
    rows: Mapping[str, CaptureResult]  # capture -> its registration
    contents: Mapping[str, str]  # capture -> content id, of the registrations that exist
    seconds: float  # duration of all registrations when they were computed


@dataclass(frozen=True, kw_only=True)
class HoldOutResult(StepResult):
    """Of the step that gathers held-out subjects."""

    file: str  # NPZ
    sources: Mapping[str, str]  # subject -> "true meshes" or "registrations"
    lost: tuple[str, ...] = ()  # subjects that have neither


@dataclass(frozen=True, kw_only=True)
class StabilizeResult(Record, title="step's result"):
    """Of the step that stabilizes a run's registrations."""

    out: str | None  # the stabilized set; None: too few expressions to stabilize
    reason: str = ""  # why there is none
    content_id: str | None = None
    input_hash: str | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class GateDecision:
    """A person's decision that holds, about a registration of the run."""

    name: str
    content_id: str
    decision: str  # accept or reject
    who: str
    reason: str
    time: str  # UTC
    sequence: int  # in the log
    verdict: str  # of the rules, with the thresholds of the run


@dataclass(frozen=True, kw_only=True)
class GateResult(Record, title="gate's record", fix="delete its folder to have it made again"):
    """Of the step that decides which registrations a model is built from: `gate.json`."""

    policy: Policy
    thresholds: str  # content id
    thresholds_name: str
    verdicts: Mapping[str, int]  # accept, look, reject -> number of registrations
    accepted: int  # registrations that are used
    accepted_id: str  # of the set of these
    waiting: int  # registrations that are for a person and not decided; with the policy "auto" they are used
    left_out: Mapping[str, str] = field(default_factory=dict)  # SUBJECT/CAPTURE -> why it is not used
    decisions: tuple[GateDecision, ...] = ()
    log_head: str | None = None  # sha256 of the last entry of the log of decisions; None: there is no log
    sample_shown: int = 0  # registrations that the rules accept and a person was shown nevertheless, and decided
    sample_rejected: int = 0  # of these
    left_out_count: int = 0  # their number

    def brief(self) -> "GateResult":
        """Return the result without what there may be many of."""
        return replace(self, left_out={}, decisions=())


@dataclass(frozen=True, kw_only=True)
class RejectedRegistration:
    """A registration that is in no model."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class BuildResult(StepResult):
    """Of the step that builds a model."""

    model: str  # its file
    content_id: str
    registered: int  # registrations that it was built from
    rejected: tuple[RejectedRegistration, ...]
    components: int  # of the identity basis
    drift_mm: float


@dataclass(frozen=True, kw_only=True)
class EvaluateResult(StepResult):
    """Of the step that evaluates all models so far."""

    out: str  # the folder of the evaluation
    components: tuple[int, ...]  # numbers of components that all models have
    at: int  # the largest of them, which the stopping rule uses
    generalization_mm: Curves
    specificity_mm: Curves
