"""Evaluation of head models on held-out subjects [GNM, Intrinsic Evaluation of GNM].

Generalization (distance of the best fit from a held-out head), compactness (variance of the first components) and
specificity (distance of random heads from real ones), against the number of components, with confidence intervals over
subjects, and tables by region, category and tag. Models are compared on the same subjects with the same numbers of
components.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate import linear_fit
from coregister.evaluate.confidence_intervals import (
    DRAWS,
    Interval,
    bootstrap_interval,
    bootstrap_statistic_interval,
)
from coregister.evaluate.linear_fit import ExpressionPart, LinearPart
from coregister.evaluate.scan_fit import fit_scan, points_on_skin
from coregister.evaluate.specificity import specificity_mm
from coregister.tag_groups import tag_group
from registration.errors import InputError
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.progress import NullProgress, Progress

NEUTRAL = "neutral"  # the neutral's category
_CATEGORY = "category"  # a tag of a capture, not of a subject


@dataclass(frozen=True, kw_only=True)
class HeldOutSubject:
    """A subject that was used to build no model. Metres; any frame, in which the skull does not move."""

    subject: str
    neutral: Float[np.ndarray, "V 3"]
    expressions: Float[np.ndarray, "S V 3"]
    categories: tuple[str, ...] = ()  # of the expressions
    tags: Mapping[str, Any] = field(default_factory=dict)
    scan: Float[np.ndarray, "P 3"] | None = None  # points of the neutral's raw scan that a model should explain


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Settings of an evaluation. All components of a model, or of a region, are evaluated too.

    Attributes:
        components: numbers of components, increasing.
        samples: number of random heads for specificity; 0: no specificity.
        draws: resamples of the subjects for confidence intervals.
        seed: of random heads, points and resamples.
    """

    components: tuple[int, ...] = (5, 10, 20, 40)
    samples: int = 200
    draws: int = DRAWS
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Distances against the number of components, millimetres."""

    components: tuple[int, ...]
    values_mm: Float[np.ndarray, "N k"]  # a row each subject, or each random head; NaN: has no such sample
    intervals: tuple[Interval, ...]

    def at_components(self, components: int) -> Float[np.ndarray, "N"]:
        """Return the values for one number of components."""
        return self.values_mm[:, self.components.index(components)]


@dataclass(frozen=True, kw_only=True)
class Compactness:
    """The part of a model's own variation that its first k components explain, on the part that is evaluated."""

    share: tuple[float, ...]  # cumulative, of the variance
    rms_mm: tuple[float, ...]  # cumulative: from rest, coefficients of unit variance


@dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One row of a table: mean distance in a region of the neutrals, or of a group of subjects or captures."""

    kind: str  # "region", "category" or a tag's name
    name: str
    subjects: int
    distance_mm: Interval


@dataclass(frozen=True, kw_only=True)
class ModelMetrics:
    """Metrics of one model."""

    content: str  # sha256 of the model
    identity: Curve  # neutrals, vertex to vertex
    scans: Curve | None  # neutrals, scan to surface; None: no subject has a scan
    expressions: Mapping[str, Curve]  # region of the skin -> displacements from the neutral, within the soft mask
    compactness: Mapping[str, Compactness]  # "identity" and the expression regions
    specificity: Curve | None
    rows: tuple[MetricRow, ...]
    vertex_mm: Float[np.ndarray, "V"]  # of the neutrals, mean over subjects, as in the tables; NaN off the head's skin
    unconverged: int  # number of fits that did not converge


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Relative reduction of a model's mean distance against the first model's, subjects paired."""

    model: str
    components: int
    difference_mm: Interval  # the first model's distance minus this one's
    gain: Interval


@dataclass(frozen=True, kw_only=True)
class ModelEvaluation:
    """Metrics of all models on all subjects."""

    subjects: tuple[str, ...]
    vertices: int  # number of vertices of the head's skin, where metrics in correspondence are computed
    models: Mapping[str, ModelMetrics]
    gains: tuple[Gain, ...]
    settings: EvaluationSettings

    @property
    def metrics(self) -> dict[str, Any]:
        """Everything for a manifest but the distances of single vertices."""
        models = {
            name: {f.name: getattr(model, f.name) for f in fields(model) if f.name != "vertex_mm"}
            for name, model in self.models.items()
        }
        return {"subjects": self.subjects, "vertices": self.vertices, "models": models, "gains": self.gains}


def evaluate(
    models: Mapping[str, GNMData],
    held_out: Sequence[HeldOutSubject],
    triangles: Int[np.ndarray, "F 3"],
    settings: EvaluationSettings | None = None,
    progress: Progress | None = None,
) -> ModelEvaluation:
    """Evaluate models on the same held-out subjects.

    Args:
        models: by name; the others are compared with the first.
        held_out: subjects whose meshes have the models' topology.
        triangles: of the subjects' meshes.
        settings: of the evaluation.
        progress: notified for every model and subject.

    Returns:
        Metrics of every model, in millimetres, with confidence intervals.

    Raises:
        InputError: as `check`, before anything is computed.
    """
    settings, progress = settings or EvaluationSettings(), progress or NullProgress()
    check(models, held_out, triangles, settings)
    metrics = {name: _model_metrics(name, data, held_out, settings, progress) for name, data in models.items()}
    (_, first), *others = metrics.items()
    gains = [
        _gain(name, first.identity, other.identity, k, settings) for name, other in others for k in settings.components
    ]
    return ModelEvaluation(
        subjects=tuple(subject.subject for subject in held_out),
        vertices=int(regions.head_skin(next(iter(models.values()))).sum()),
        models=metrics,
        gains=tuple(gains),
        settings=settings,
    )


def check(
    models: Mapping[str, GNMData],
    held_out: Sequence[HeldOutSubject],
    triangles: Int[np.ndarray, "F 3"],
    settings: EvaluationSettings,
) -> None:
    """Check the arguments of `evaluate`.

    Raises:
        InputError: no model; fewer than two subjects, or one twice; a model of another topology; meshes of another size
            or not finite; missing categories; numbers of components out of order, or more than a model has.
    """
    if not models:
        raise _input_error("There is no model to evaluate", "models", "at least one", "none", "give a model file")
    if len(held_out) < 2:
        got = held_out[0].subject if held_out else "none"
        fix = "hold out more subjects: an interval over subjects needs at least two"
        raise _input_error("There are too few held-out subjects", "held-out subjects", "at least two", got, fix)
    names = [subject.subject for subject in held_out]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        fix = "put all meshes of a subject together"
        raise _input_error("A held-out subject comes twice", "held-out subjects", "each once", duplicates[0], fix)
    components = settings.components
    if not components or components[0] < 1 or list(components) != sorted(set(components)):
        fix = "give whole numbers from 1, each larger than the one before"
        raise _input_error(
            "The numbers of components are out of order", "components", "such as 5 10 20", components, fix
        )
    if settings.samples < 0 or settings.draws < 100:
        expected = "samples from 0, draws from 100"
        raise _input_error("The settings are out of range", "settings", expected, settings, "change them")
    topology = gnm_npz.topology_hash(triangles)
    for name, data in models.items():
        if gnm_npz.topology_hash(data.triangles) != topology:
            expected = f"the held-out meshes' {len(triangles)} triangles"
            got = f"{len(data.triangles)} triangles, or another order"
            fix = "evaluate a model on registrations of its own topology"
            what = "The model has another topology than the held-out meshes"
            raise _input_error(what, name, expected, got, fix)
        if (count := len(linear_fit.identity_part(data).basis)) < components[-1]:
            what, fix = "The model has fewer identity components than requested", "request fewer with --components"
            raise _input_error(what, name, f"{components[-1]}", count, fix)
    shape = next(iter(models.values())).template_vertex_positions.shape
    for subject in held_out:
        _check_subject(subject, shape)


def _check_subject(subject: HeldOutSubject, shape: tuple[int, ...]) -> None:
    name, fix = subject.subject, "exclude the subject, or register it again"
    if subject.neutral.shape != shape or subject.expressions.shape[1:] != shape:
        got = f"neutral {subject.neutral.shape}, expressions {subject.expressions.shape}"
        what = "A held-out mesh has another size than the model"
        raise _input_error(what, name, f"{shape[0]} vertices", got, fix)
    if len(subject.categories) != len(subject.expressions):
        got = f"{len(subject.categories)} for {len(subject.expressions)} expressions"
        what = "A held-out subject's categories are incomplete"
        raise _input_error(what, name, "one category an expression", got, fix)
    points = [subject.neutral, subject.expressions] + ([] if subject.scan is None else [subject.scan])
    if not all(np.isfinite(values).all() for values in points):
        what, got = "A held-out mesh is not finite", "NaN or infinite numbers"
        raise _input_error(what, name, "finite coordinates", got, fix)
    if subject.scan is not None and not len(subject.scan):
        raise _input_error("A held-out scan is empty", name, "points", "none", fix)


def _input_error(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


def _model_metrics(
    name: str,
    data: GNMData,
    held_out: Sequence[HeldOutSubject],
    settings: EvaluationSettings,
    progress: Progress,
) -> ModelMetrics:
    distances = _ModelDistances(data, settings)
    for index, subject in enumerate(held_out):
        progress.update(index, len(held_out), f"{name}: {subject.subject}")
        distances.add(subject)
    part, counts = distances.identity, distances.counts
    parts = {"identity": part, **{region: expression.part for region, expression in distances.expressions.items()}}
    specificity = None
    if settings.samples:
        progress.update(len(held_out), len(held_out), f"{name}: {settings.samples} random heads")
        values = specificity_mm(
            part,
            np.stack([subject.neutral[part.rows] for subject in held_out]),
            counts,
            samples=settings.samples,
            seed=settings.seed,
        )
        specificity = _curve(counts, values, settings)
    scans_mm = np.array(distances.scans_mm)
    return ModelMetrics(
        content=gnm_npz.content_hash(data),
        identity=_curve(counts, np.array(distances.identity_mm), settings),
        scans=_curve(counts, scans_mm, settings) if np.isfinite(scans_mm).any() else None,
        expressions={
            region: _curve(distances.counts_of(expression), np.array(distances.expressions_mm[region]), settings)
            for region, expression in distances.expressions.items()
            if np.isfinite(distances.expressions_mm[region]).any()
        },
        compactness={region: _compactness(part) for region, part in parts.items()},
        specificity=specificity,
        rows=tuple(_rows(distances, held_out, settings)),
        vertex_mm=distances.vertex_mm,
        unconverged=distances.unconverged,
    )


class _ModelDistances:
    """Distances of one model from the subjects, added one subject at a time; keeps numbers, not meshes."""

    def __init__(self, data: GNMData, settings: EvaluationSettings) -> None:
        self.data, self.settings = data, settings
        self.identity, self.whole = linear_fit.identity_part(data), linear_fit.whole_part(data)
        self.outside = linear_fit.identity_part(data, regions.exterior(data))
        self.expressions = linear_fit.expression_parts(data)
        self.regions = {name: members[self.identity.rows] for name, members in regions.head_regions(data).items()}
        self.counts = self._counts(len(self.identity.basis))
        self.identity_mm: list[list[float]] = []
        self.scans_mm: list[list[float]] = []
        self.expressions_mm: dict[str, list[np.ndarray]] = {region: [] for region in self.expressions}
        self.by_region: list[dict[str, float]] = []
        self.by_category: list[dict[str, float]] = []
        self.unconverged = 0
        self._sum_mm = np.full(len(data.template_vertex_positions), np.nan)
        self._sum_mm[self.identity.rows] = 0

    def _counts(self, available: int) -> tuple[int, ...]:
        return (*(k for k in self.settings.components if k < available), available)

    def counts_of(self, expression: ExpressionPart) -> tuple[int, ...]:
        """Numbers of components of an expression region, up to those that it has."""
        return self._counts(len(expression.part.basis))

    @property
    def table_components(self) -> int:
        """The number of components of the tables by region and tag."""
        return self.settings.components[-1]

    @property
    def vertex_mm(self) -> Float[np.ndarray, "V"]:
        return self._sum_mm / len(self.identity_mm)

    def add(self, subject: HeldOutSubject) -> None:
        fits = linear_fit.fit_correspondence(self.identity, subject.neutral[self.identity.rows], self.counts)
        self.identity_mm.append([float(fit.distance_mm.mean()) for fit in fits])
        distance = fits[self.counts.index(self.table_components)].distance_mm
        self._sum_mm[self.identity.rows] += distance
        self.by_region.append({name: float(distance[m].mean()) for name, m in self.regions.items() if m.any()})
        scan_fits = []
        if subject.scan is not None:
            points = points_on_skin(subject.scan, subject.neutral, self.data)
            scan_fits = fit_scan(self.outside, points, fits, seed=self.settings.seed) if len(points) else []
        self.scans_mm.append([float(fit.distance_mm.mean()) for fit in scan_fits] or [np.nan] * len(self.counts))
        rotation = fits[-1].T_model_world[:3, :3].T
        self._add_expressions((subject.expressions.astype(np.float64) - subject.neutral) @ rotation)
        meshes = [subject.neutral, *subject.expressions]
        count = [len(self.whole.basis)]
        whole_fits = [linear_fit.fit_correspondence(self.whole, mesh[self.whole.rows], count)[0] for mesh in meshes]
        self.unconverged += sum(not fit.converged for fit in (*fits, *scan_fits, *whole_fits))
        by_category: dict[str, list[float]] = {}
        for category, fit in zip((NEUTRAL, *subject.categories), whole_fits, strict=True):
            by_category.setdefault(category, []).append(float(fit.distance_mm.mean()))
        self.by_category.append({category: float(np.mean(values)) for category, values in by_category.items()})

    def _add_expressions(self, displacements: Float[np.ndarray, "S V 3"]) -> None:
        for region, expression in self.expressions.items():
            counts = self.counts_of(expression)
            distance = expression.errors_mm(displacements, counts)
            self.expressions_mm[region].append(distance.mean(0) if len(distance) else np.full(len(counts), np.nan))


def _curve(components: tuple[int, ...], values: Float[np.ndarray, "N k"], settings: EvaluationSettings) -> Curve:
    intervals = (bootstrap_interval(column, seed=settings.seed, draws=settings.draws) for column in values.T)
    return Curve(components=components, values_mm=values, intervals=tuple(intervals))


def _compactness(part: LinearPart) -> Compactness:
    variance = np.cumsum(linear_fit.variance_mm2(part))
    return Compactness(share=tuple((variance / variance[-1]).tolist()), rms_mm=tuple(np.sqrt(variance).tolist()))


def _rows(
    distances: _ModelDistances, held_out: Sequence[HeldOutSubject], settings: EvaluationSettings
) -> Iterable[MetricRow]:
    """Regions and tags of the neutrals with the tables' number of components, categories with all components."""
    for kind, table in (("region", distances.by_region), (_CATEGORY, distances.by_category)):
        for name in dict.fromkeys(name for row in table for name in row):
            yield _row(kind, name, np.array([row[name] for row in table if name in row]), settings)
    neutrals = np.array(distances.identity_mm)[:, distances.counts.index(distances.table_components)]
    for tag in dict.fromkeys(tag for subject in held_out for tag in subject.tags if tag != _CATEGORY):
        groups = [tag_group(subject.tags[tag]) if tag in subject.tags else None for subject in held_out]
        names = sorted({group for group in groups if group is not None})
        if all(groups.count(name) == 1 for name in names):  # such as a name or a note: every group has one subject
            continue
        for name in names:
            yield _row(tag, name, neutrals[[group == name for group in groups]], settings)


def _row(kind: str, name: str, values: Float[np.ndarray, "N"], settings: EvaluationSettings) -> MetricRow:
    distance = bootstrap_interval(values, seed=settings.seed, draws=settings.draws)
    return MetricRow(kind=kind, name=name, subjects=len(values), distance_mm=distance)


def _gain(name: str, first: Curve, other: Curve, components: int, settings: EvaluationSettings) -> Gain:
    pairs = np.stack([first.at_components(components), other.at_components(components)], 1)
    seed, draws = settings.seed, settings.draws
    return Gain(
        model=name,
        components=components,
        difference_mm=bootstrap_statistic_interval(
            pairs, lambda means: means[..., 0] - means[..., 1], seed=seed, draws=draws
        ),
        gain=bootstrap_statistic_interval(
            pairs, lambda means: 1 - means[..., 1] / means[..., 0], seed=seed, draws=draws
        ),
    )
