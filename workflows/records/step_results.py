"""The results of a coregistration's steps, as they are in `step.json`, in the queue and in `coregistration.json`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from registration.storage.records import Record

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
