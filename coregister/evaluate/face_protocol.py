"""The evaluation protocol of [GNM, Intrinsic Evaluation of GNM] on one registered scan and one model.

Stage 1 fits the model to the registered mesh, stage 2 to the raw scan; distances are of points of the scan that no fit
has seen. Least squares gives both; Adam, with the paper's settings, shows how far its 5,000 steps come.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from coregister.evaluate.confidence_intervals import DRAWS
from coregister.evaluate.face_adam import AdamSettings, adam
from coregister.evaluate.face_data import FACE, ComparedModel, FacePoints, FaceReference, FaceSample, face_points
from coregister.evaluate.face_fit import (
    RegisteredStage,
    ScanStage,
    distance_mm,
    fit_registered,
    least_squares,
)
from coregister.evaluate.face_model import IDENTITY, FaceModel
from registration.errors import InputError
from registration.frames import MM_PER_M

CODE = 2  # raised when the same scan, model and settings give other results: kept ones are computed again
NEUTRAL = "neutral"
STAGES = ("stage1", "stage2")
ADAM = "adam_"  # prefix of a stage by Adam
_LEAST_POINTS = 100


@dataclass(frozen=True, kw_only=True)
class ProtocolSettings:
    """Settings of the protocol.

    Attributes:
        points: points of each scan to fit, and as many others to measure at.
        adam: the paper's optimizer.
        adam_samples: samples, the first ones, that Adam fits too, both stages.
        components: numbers of components of the generalization curves; all are added.
        curve_samples: neutrals, and expressions, the first ones, of these curves.
        random_heads: for specificity.
        draws: resamples of the subjects for confidence intervals.
        seed: of points and resamples.
    """

    points: int = 3000
    adam: AdamSettings = field(default_factory=AdamSettings)
    adam_samples: int = 15
    components: tuple[int, ...] = (5, 10, 20, 40)
    curve_samples: int = 40
    random_heads: int = 2000
    draws: int = DRAWS
    seed: int = 0

    def check(self) -> None:
        """Raise InputError if a number is out of range, or the numbers of components are out of order."""
        counts = self.components
        if not counts or counts[0] < 1 or list(counts) != sorted(set(counts)):
            expected, got = "whole numbers from 1, each larger than the one before", counts
            what, fix = "The numbers of components are out of order", "give them as 5 10 20"
            raise InputError(what, where="components", expected=expected, got=got, fix=fix)
        least = (self.adam_samples, self.curve_samples, self.random_heads, self.adam.steps)
        if self.points < _LEAST_POINTS or min(least) < 0 or not self.adam.rate > 0 or self.draws < 100:
            expected = f"points from {_LEAST_POINTS}, draws from 100, a positive rate, others from 0"
            fix = "change them"
            raise InputError("The settings are out of range", where="settings", expected=expected, got=self, fix=fix)


@dataclass(frozen=True, kw_only=True)
class SampleTasks:
    """What is computed of a sample besides both stages by least squares."""

    adam: bool = False
    curve: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleResult:
    """Distances of one sample from one model, millimetres."""

    distances_mm: Mapping[str, Float[np.ndarray, "N"]]  # "stage1", "stage2", "adam_stage1", ... -> measured points
    rms_mm: Mapping[str, float]  # the same stages -> root of what the stage minimizes
    members: Bool[np.ndarray, "R N"]  # regions of the measured points, in the reference's order
    nearest: Int[np.ndarray, "N"]  # the reference's vertex that each measured point is at
    curves_mm: Mapping[str, Float[np.ndarray, "k"]]  # "identity", or a region of the expression -> by components
    converged: Mapping[str, bool]
    largest: float  # largest coefficient of stage 2, standard deviations: there is no regularizer
    left_out: int  # points near the face that were not measured


def curve_counts(model: FaceModel, part: str, components: tuple[int, ...]) -> tuple[int, ...]:
    """Return the numbers of components of a curve; those of an expression begin with none."""
    available = len(model.components[part])
    first = () if part == IDENTITY else (0,)
    return (*first, *(k for k in components if k < available), available)


def evaluate_sample(
    sample: FaceSample,
    model: ComparedModel,
    reference: FaceReference,
    settings: ProtocolSettings,
    tasks: SampleTasks,
) -> SampleResult:
    """Fit a model to one registered scan.

    Args:
        sample: the registered scan.
        model: the model.
        reference: topology of the registered mesh.
        settings: of the protocol.
        tasks: what to compute.

    Raises:
        InputError: the scan has fewer than 100 points to fit, or the model has no vertex there.
    """
    face = model.face
    points = face_points(sample, reference, settings.points, settings.seed)
    if len(points.measured) < _LEAST_POINTS or not face.face.any():
        raise InputError(
            "A registered scan cannot be compared with a model on the face",
            where=f"{sample.name}, {face.name}",
            expected=f"at least {2 * _LEAST_POINTS} points of the scan on the registered face",
            got=f"{2 * len(points.measured)} points, {int(face.face.sum())} vertices of the model",
            fix="check that scan and registration are in one frame and in metres",
        )
    target = model.target(sample.vertices)[face.face]
    mesh, scan = RegisteredStage(model=face, rows=face.face, target=target), ScanStage(model=face, points=points.fit)
    first = fit_registered(mesh)
    fits = {"stage1": first, "stage2": least_squares(scan, first)}
    if settings.adam.steps and tasks.adam:
        fits["adam_stage1"] = adam(mesh, mesh.start(), settings.adam)
        fits["adam_stage2"] = adam(scan, fits["adam_stage1"], settings.adam)
    curves = _curves(sample.category, face, target, points, reference, settings) if tasks.curve else {}
    stages = {name: mesh if name.endswith("1") else scan for name in fits}
    return SampleResult(
        distances_mm={name: distance_mm(scan, fit, points.measured).astype(np.float32) for name, fit in fits.items()},
        rms_mm={name: MM_PER_M * float(np.sqrt(stages[name].cost(fit))) for name, fit in fits.items()},
        members=points.members,
        nearest=points.nearest,
        curves_mm=curves,
        converged={name: fit.converged for name, fit in fits.items()},
        largest=float(np.abs(fits["stage2"].coefficients).max(initial=0)),
        left_out=points.left_out,
    )


def _curves(
    category: str,
    face: FaceModel,
    target: Float[np.ndarray, "Q 3"],
    points: FacePoints,
    reference: FaceReference,
    settings: ProtocolSettings,
) -> dict[str, Float[np.ndarray, "k"]]:
    """Mean distances by number of components: of a neutral with identity alone, measured on the face; of an expression
    with all components but some of one region's, measured on the region. After stage 1."""
    names = list(reference.members)
    parts = [IDENTITY] if category == NEUTRAL else [n for n in face.components if n != IDENTITY]
    curves = {}
    for part in parts:
        own = face.components[part]
        others = np.zeros(0, np.int64)
        if part != IDENTITY:
            others = np.setdiff1d(np.concatenate(list(face.components.values())), own)
        region = points.members[names.index(part if part in names else FACE)]
        values = []
        for count in curve_counts(face, part, settings.components):
            active = np.sort(np.concatenate([others, own[:count]]))
            fit = fit_registered(RegisteredStage(model=face, rows=face.face, target=target), active)
            measured = points.measured[region]
            scan = ScanStage(model=face, points=measured)
            values.append(distance_mm(scan, fit, measured).mean() if len(measured) else np.nan)
        curves[part] = np.array(values)
    return curves


def planned_tasks(samples: list[FaceSample], settings: ProtocolSettings) -> list[SampleTasks]:
    """Return the tasks of each sample."""
    seen = {True: 0, False: 0}
    tasks = []
    for number, sample in enumerate(samples):
        neutral = sample.category == NEUTRAL
        curve = seen[neutral] < settings.curve_samples
        seen[neutral] += 1
        tasks.append(SampleTasks(adam=number < settings.adam_samples, curve=curve))
    return tasks
