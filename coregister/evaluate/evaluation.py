"""What head models are worth on people that they were not made from [GNM, Intrinsic Evaluation of GNM].

Generalization (how near a model comes to a held-out head), compactness (how few components hold its variance) and
specificity (how near its random heads come to real ones), against the number of components, with intervals over
subjects and tables by region, category and tag. Several models are compared on the same subjects with the same number
of components.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate import linear_fit as general
from coregister.evaluate.confidence_intervals import DRAWS, Interval, interval, interval_of
from coregister.evaluate.linear_fit import ExpressionPart, LinearPart
from coregister.evaluate.scan_fit import fit_scan
from coregister.evaluate.specificity import specificity_mm
from registration.errors import InputError
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.progress import Progress, Silent

NEUTRAL = "neutral"  # the neutral's category
_CATEGORY = "category"  # a tag of a capture, not of a subject


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """One subject that no model has seen. Metres; one frame of its own, in which the skull stands still."""

    subject: str
    neutral: Float[np.ndarray, "V 3"]
    expressions: Float[np.ndarray, "S V 3"]
    categories: tuple[str, ...] = ()  # of the expressions
    tags: Mapping[str, Any] = field(default_factory=dict)
    scan: Float[np.ndarray, "P 3"] | None = None  # points of the neutral's raw scan that a model should explain


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is evaluated, resolved. All components of a model, or of a region, are evaluated besides."""

    components: tuple[int, ...] = (5, 10, 20, 40)
    samples: int = 200  # random heads for specificity; 0: none
    shortlist: int = 3  # real heads that each is compared with exactly
    draws: int = DRAWS  # of subjects, for intervals
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Distances against the number of components, millimetres."""

    components: tuple[int, ...]
    values_mm: Float[np.ndarray, "N k"]  # a row each subject, or each random head; NaN: has no such sample
    intervals: tuple[Interval, ...]

    def at(self, components: int) -> Float[np.ndarray, "N"]:
        return self.values_mm[:, self.components.index(components)]


@dataclass(frozen=True, kw_only=True)
class Compactness:
    """How much of a model's own variation the first k components hold, on the part where they are measured."""

    share: tuple[float, ...]  # cumulative, of the variance
    rms_mm: tuple[float, ...]  # cumulative: from rest, coefficients of unit variance


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of a table: distance in a region of the neutrals, or of subjects or captures that share something."""

    kind: str  # "region", "category" or a tag's name
    name: str
    subjects: int
    distance_mm: Interval


@dataclass(frozen=True, kw_only=True)
class ModelFigures:
    """One model."""

    content: str  # sha256 of the model
    identity: Curve  # neutrals, vertex to vertex
    scans: Curve | None  # neutrals, scan to surface; None where subjects have no scans
    expressions: Mapping[str, Curve]  # region of the skin -> displacements from the neutral, within the soft mask
    compactness: Mapping[str, Compactness]  # "identity" and the expression regions
    specificity: Curve | None
    rows: tuple[Row, ...]
    vertex_mm: Float[np.ndarray, "V"]  # of the neutrals, mean over subjects, as in the tables; NaN off the head's skin
    unconverged: int  # fits that ended before they settled


@dataclass(frozen=True, kw_only=True)
class Gain:
    """By which share a model's mean distance is smaller than the first model's, subjects paired."""

    model: str
    components: int
    difference_mm: Interval  # the first model's less this one's
    gain: Interval


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """All models on all subjects."""

    subjects: tuple[str, ...]
    vertices: int  # that figures in correspondence are taken at: the head's skin
    models: Mapping[str, ModelFigures]
    gains: tuple[Gain, ...]
    settings: Settings

    @property
    def figures(self) -> dict[str, Any]:
        """For a manifest: everything but the distances of single vertices."""
        models = {name: {f.name: getattr(one, f.name) for f in fields(one)} for name, one in self.models.items()}
        for one in models.values():
            one.pop("vertex_mm")
        return {"subjects": self.subjects, "vertices": self.vertices, "models": models, "gains": self.gains}


def evaluate(
    models: Mapping[str, GNMData],
    held_out: Sequence[HeldOut],
    triangles: Int[np.ndarray, "F 3"],
    settings: Settings | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Evaluate models, by name, on the same held-out subjects, whose meshes have these triangles.

    Raises:
        InputError: as `check`, before anything is computed.
    """
    settings, progress = settings or Settings(), progress or Silent()
    check(models, held_out, triangles, settings)
    found = {name: _model(name, data, held_out, settings, progress) for name, data in models.items()}
    first = next(iter(found.values()))
    others = list(found.items())[1:]
    gains = [
        _gain(name, first.identity, other.identity, k, settings) for name, other in others for k in settings.components
    ]
    return Evaluation(
        subjects=tuple(one.subject for one in held_out),
        vertices=int(regions.head_skin(next(iter(models.values()))).sum()),
        models=found,
        gains=tuple(gains),
        settings=settings,
    )


def check(
    models: Mapping[str, GNMData], held_out: Sequence[HeldOut], triangles: Int[np.ndarray, "F 3"], settings: Settings
) -> None:
    """Raise InputError for what cannot be evaluated.

    No model; fewer than two subjects, or one twice; a model of another topology; meshes of another size or not finite;
    categories missing; numbers of components out of order, or more than a model has.
    """
    if not models:
        raise _bad("There is no model to evaluate", "models", "at least one", "none", "give a model file")
    if len(held_out) < 2:
        got = held_out[0].subject if held_out else "none"
        fix = "hold out more subjects: an interval over subjects needs at least two"
        raise _bad("There are too few held-out subjects", "held-out subjects", "at least two", got, fix)
    names = [one.subject for one in held_out]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        fix = "put all meshes of a subject together"
        raise _bad("A held-out subject comes twice", "held-out subjects", "each once", twice[0], fix)
    asked = settings.components
    if not asked or asked[0] < 1 or list(asked) != sorted(set(asked)):
        fix = "give whole numbers from 1, each larger than the one before"
        raise _bad("The numbers of components are out of order", "components", "such as 5 10 20", asked, fix)
    if settings.samples < 0 or settings.shortlist < 1 or settings.draws < 100:
        expected = "samples from 0, a shortlist from 1, draws from 100"
        raise _bad("The settings are out of range", "settings", expected, settings, "change them")
    wanted = gnm_npz.topology_hash(triangles)
    for name, data in models.items():
        if gnm_npz.topology_hash(data.triangles) != wanted:
            expected = f"the held-out meshes' {len(triangles)} triangles"
            got = f"{len(data.triangles)} triangles, or another order"
            fix = "evaluate a model on registrations of its own topology"
            raise _bad("The model has another topology than the held-out meshes", name, expected, got, fix)
        if (count := len(general.identity_part(data).basis)) < asked[-1]:
            fix = "ask for fewer with --components"
            raise _bad("The model has fewer identity components than asked for", name, f"{asked[-1]}", count, fix)
    shape = next(iter(models.values())).template_vertex_positions.shape
    for one in held_out:
        _check_subject(one, shape)


def _check_subject(one: HeldOut, shape: tuple[int, ...]) -> None:
    fix = "leave the subject out, or register it again"
    if one.neutral.shape != shape or one.expressions.shape[1:] != shape:
        got = f"neutral {one.neutral.shape}, expressions {one.expressions.shape}"
        raise _bad("A held-out mesh has another size than the model", one.subject, f"{shape[0]} vertices", got, fix)
    if len(one.categories) != len(one.expressions):
        got = f"{len(one.categories)} for {len(one.expressions)} expressions"
        raise _bad("A held-out subject's categories are incomplete", one.subject, "one an expression", got, fix)
    points = [one.neutral, one.expressions] + ([] if one.scan is None else [one.scan])
    if not all(np.isfinite(values).all() for values in points):
        raise _bad("A held-out mesh is not finite", one.subject, "finite coordinates", "NaN or infinite numbers", fix)
    if one.scan is not None and not len(one.scan):
        raise _bad("A held-out scan is empty", one.subject, "points", "none", fix)


def _bad(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


def _model(
    name: str, data: GNMData, held_out: Sequence[HeldOut], settings: Settings, progress: Progress
) -> ModelFigures:
    subjects = _Subjects(data, settings)
    for number, one in enumerate(held_out):
        progress.at(number, len(held_out), f"{name}: {one.subject}")
        subjects.add(one)
    part, counts = subjects.identity, subjects.counts
    compact = {"identity": part, **{region: found.part for region, found in subjects.expressions.items()}}
    specific = None
    if settings.samples:
        progress.at(len(held_out), len(held_out), f"{name}: {settings.samples} random heads")
        distance = specificity_mm(
            part,
            np.stack([one.neutral[part.rows] for one in held_out]),
            counts,
            samples=settings.samples,
            shortlist=settings.shortlist,
            seed=settings.seed,
        )
        specific = _curve(counts, distance, settings)
    return ModelFigures(
        content=gnm_npz.content_hash(data),
        identity=_curve(counts, np.array(subjects.identity_mm), settings),
        scans=_curve(counts, np.array(subjects.scans_mm), settings) if np.isfinite(subjects.scans_mm).any() else None,
        expressions={
            region: _curve(subjects.counts_of(found), np.array(subjects.expressions_mm[region]), settings)
            for region, found in subjects.expressions.items()
            if np.isfinite(subjects.expressions_mm[region]).any()
        },
        compactness={region: _compactness(found) for region, found in compact.items()},
        specificity=specific,
        rows=tuple(_rows(subjects, held_out, settings)),
        vertex_mm=subjects.vertex_mm,
        unconverged=subjects.unconverged,
    )


class _Subjects:
    """One model's distances, a subject at a time: only numbers are kept."""

    def __init__(self, data: GNMData, settings: Settings) -> None:
        self.settings = settings
        self.identity, self.whole = general.identity_part(data), general.whole_part(data)
        self.outside = general.identity_part(data, regions.exterior(data))
        self.expressions = general.expression_parts(data)
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

    def _counts(self, most: int) -> tuple[int, ...]:
        return (*(k for k in self.settings.components if k < most), most)

    def counts_of(self, found: ExpressionPart) -> tuple[int, ...]:
        """Numbers of components of an expression region, as far as it has them."""
        return self._counts(len(found.part.basis))

    @property
    def table(self) -> int:
        """The number of components that tables by region and tag are of."""
        return self.settings.components[-1]

    @property
    def vertex_mm(self) -> Float[np.ndarray, "V"]:
        return self._sum_mm / len(self.identity_mm)

    def add(self, one: HeldOut) -> None:
        fits = general.fit(self.identity, one.neutral[self.identity.rows], self.counts)
        self.identity_mm.append([float(found.distance_mm.mean()) for found in fits])
        tabled = fits[self.counts.index(self.table)].distance_mm
        self._sum_mm[self.identity.rows] += tabled
        self.by_region.append({name: float(tabled[m].mean()) for name, m in self.regions.items() if m.any()})
        scanned = []
        if one.scan is not None:
            scanned = fit_scan(self.outside, one.scan, fits, seed=self.settings.seed)
        self.scans_mm.append([float(found.distance_mm.mean()) for found in scanned] or [np.nan] * len(self.counts))
        turn = fits[-1].T_model_world[:3, :3].T
        displacements = (one.expressions.astype(np.float64) - one.neutral) @ turn
        for region, part in self.expressions.items():
            columns = self.counts_of(part)
            distance = part.errors_mm(displacements, columns)
            self.expressions_mm[region].append(distance.mean(0) if len(distance) else np.full(len(columns), np.nan))
        everything = [len(self.whole.basis)]
        meshes = [one.neutral, *one.expressions]
        wholes = [general.fit(self.whole, mesh[self.whole.rows], everything)[0] for mesh in meshes]
        self.unconverged += sum(not found.converged for found in (*fits, *scanned, *wholes))
        grouped: dict[str, list[float]] = {}
        for category, found in zip((NEUTRAL, *one.categories), wholes, strict=True):
            grouped.setdefault(category, []).append(float(found.distance_mm.mean()))
        self.by_category.append({category: float(np.mean(values)) for category, values in grouped.items()})


def _curve(components: tuple[int, ...], values: Float[np.ndarray, "N k"], settings: Settings) -> Curve:
    intervals = (interval(column, seed=settings.seed, draws=settings.draws) for column in values.T)
    return Curve(components=components, values_mm=values, intervals=tuple(intervals))


def _compactness(part: LinearPart) -> Compactness:
    variance = np.cumsum(general.variance_mm2(part))
    return Compactness(share=tuple((variance / variance[-1]).tolist()), rms_mm=tuple(np.sqrt(variance).tolist()))


def _rows(subjects: _Subjects, held_out: Sequence[HeldOut], settings: Settings) -> Iterable[Row]:
    """Regions and tags of the neutrals with the table's number of components, categories with all components."""
    for kind, table in (("region", subjects.by_region), (_CATEGORY, subjects.by_category)):
        for name in dict.fromkeys(name for row in table for name in row):
            yield _row(kind, name, np.array([row[name] for row in table if name in row]), settings)
    neutrals = np.array(subjects.identity_mm)[:, subjects.counts.index(subjects.table)]
    for tag in dict.fromkeys(tag for one in held_out for tag in one.tags if tag != _CATEGORY):
        groups = [_group(one.tags[tag]) if tag in one.tags else None for one in held_out]
        names = sorted({group for group in groups if group is not None})
        if all(groups.count(name) == 1 for name in names):  # a name or a note: it groups nobody
            continue
        for name in names:
            yield _row(tag, name, neutrals[[group == name for group in groups]], settings)


def _row(kind: str, name: str, values: Float[np.ndarray, "N"], settings: Settings) -> Row:
    distance = interval(values, seed=settings.seed, draws=settings.draws)
    return Row(kind=kind, name=name, subjects=len(values), distance_mm=distance)


def _group(value: Any) -> str:
    """Numbers are grouped by tens: an age of its own would be a table of single subjects."""
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        low = int(value // 10 * 10)
        return f"{low} to {low + 9}"
    return str(value)


def _gain(name: str, first: Curve, other: Curve, components: int, settings: Settings) -> Gain:
    pairs = np.stack([first.at(components), other.at(components)], 1)
    seed, draws = settings.seed, settings.draws
    return Gain(
        model=name,
        components=components,
        difference_mm=interval_of(pairs, lambda means: means[..., 0] - means[..., 1], seed=seed, draws=draws),
        gain=interval_of(pairs, lambda means: 1 - means[..., 1] / means[..., 0], seed=seed, draws=draws),
    )
