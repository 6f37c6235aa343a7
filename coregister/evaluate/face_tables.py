"""Tables and curves of the face protocol over all samples, with confidence intervals by bootstrap over subjects.

Distances are pooled over points as in [GNM, Generalization to Novel Shapes]; every sample has equal weight. The
interval of a mean is over subjects; median and standard deviation have none.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from coregister.evaluate.confidence_intervals import Interval, bootstrap_interval, bootstrap_statistic_interval
from coregister.evaluate.face_data import FACE, FaceReference, FaceSample
from coregister.evaluate.face_model import FaceModel
from coregister.evaluate.face_protocol import (
    ADAM,
    STAGES,
    ProtocolSettings,
    SampleResult,
    curve_counts,
)
from coregister.tag_groups import tag_group

DENSITY_EDGES_MM = np.linspace(0, 3, 61)
_RESERVED = ("category",)


@dataclass(frozen=True, kw_only=True)
class FaceRow:
    """One row of the tables: a model's distances in one group of points or samples, millimetres."""

    model: str
    stage: str  # "stage1", "stage2", "adam_stage1", "adam_stage2"
    kind: str  # "face", "region", "category", or a tag's name
    name: str
    mean: Interval  # pooled mean of the samples' means; interval over subjects
    median: float
    std: float
    subjects: int
    samples: int


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How near Adam comes to least squares, on the samples that both fitted."""

    model: str
    stage: str
    samples: int
    least_squares_mm: float  # mean distance of the scan's points
    adam_mm: float
    rms_least_squares_mm: float  # of what the stage minimizes, mean over samples
    rms_adam_mm: float
    ratio: Interval  # adam / least squares of the mean distances, interval over subjects
    settled: int  # samples whose last tenth of Adam's steps changed the cost by less than 0.1 %


@dataclass(frozen=True, kw_only=True)
class FaceCurve:
    """Mean distance by number of components of one part of a model."""

    model: str
    part: str
    components: tuple[int, ...]
    intervals: tuple[Interval, ...]
    subjects: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Density:
    """Share of the measured points by distance; the last bin holds all farther ones."""

    model: str
    stage: str
    share: Float[np.ndarray, "60"]


class FaceTables:
    """Aggregates the results of one model."""

    def __init__(
        self,
        model: str,
        samples: Sequence[FaceSample],
        results: Sequence[SampleResult],
        reference: FaceReference,
        settings: ProtocolSettings,
    ) -> None:
        self.model, self.samples, self.results = model, samples, results
        self.reference, self.settings = reference, settings
        self.subjects = np.array([sample.subject for sample in samples])

    def rows(self) -> Iterable[FaceRow]:
        """Yield the whole face of all stages, and by group of stage 2."""
        everything = [True] * len(self.samples)
        for stage in (*STAGES, *(ADAM + stage for stage in STAGES)):
            yield from self._row(stage, "face", "face", everything, 0)
        last = STAGES[-1]
        for number, region in enumerate(self.reference.members):
            if region != FACE:
                yield from self._row(last, "region", region, everything, number)
        for kind, groups in self._groups():
            for name in sorted(set(groups) - {None}, key=str):
                yield from self._row(last, kind, str(name), [group == name for group in groups], 0)

    def density(self) -> Iterable[Density]:
        """Yield the density of both stages."""
        for stage in STAGES:
            parts = [np.histogram(np.minimum(r.distances_mm[stage], 2.999), DENSITY_EDGES_MM)[0] for r in self.results]
            share = np.mean([part / part.sum() for part in parts], 0)
            yield Density(model=self.model, stage=stage, share=share)

    def vertex_mm(self) -> Float[np.ndarray, "V"]:
        """Return the mean distance of stage 2 of the points at each of the reference's vertices; NaN: no points."""
        count = len(self.reference.template)
        total, number = np.zeros(count), np.zeros(count)
        for result in self.results:
            total += np.bincount(result.nearest, result.distances_mm[STAGES[-1]], count)
            number += np.bincount(result.nearest, minlength=count)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    def curves(self, model: FaceModel) -> Iterable[FaceCurve]:
        """Yield the generalization curves."""
        for part in model.components:
            kept = [k for k, result in enumerate(self.results) if part in result.curves_mm]
            if not kept:
                continue
            values = np.array([self.results[k].curves_mm[part] for k in kept])
            means = self._by_subject(values, self.subjects[kept])
            if not np.isfinite(means).any():
                continue
            yield FaceCurve(
                model=self.model,
                part=part,
                components=curve_counts(model, part, self.settings.components),
                intervals=tuple(self._interval(column) for column in means.T),
                subjects=len(means),
            )

    def agreements(self) -> Iterable[Agreement]:
        """Yield the comparison of Adam with least squares."""
        for stage in STAGES:
            kept = [k for k, result in enumerate(self.results) if ADAM + stage in result.distances_mm]
            if not kept:
                continue
            results = [self.results[k] for k in kept]
            pairs = np.array([[r.distances_mm[n].mean() for n in (stage, ADAM + stage)] for r in results])
            rms = np.array([[r.rms_mm[n] for n in (stage, ADAM + stage)] for r in results]).mean(0)
            yield Agreement(
                model=self.model,
                stage=stage,
                samples=len(kept),
                least_squares_mm=float(pairs[:, 0].mean()),
                adam_mm=float(pairs[:, 1].mean()),
                rms_least_squares_mm=float(rms[0]),
                rms_adam_mm=float(rms[1]),
                ratio=bootstrap_statistic_interval(
                    self._by_subject(pairs, self.subjects[kept]),
                    lambda means: means[..., 1] / means[..., 0],
                    seed=self.settings.seed,
                    draws=self.settings.draws,
                ),
                settled=sum(r.converged[ADAM + stage] for r in results),
            )

    def _groups(self) -> Iterable[tuple[str, list[str | None]]]:
        """Kind -> each sample's group: the category of the expression, and all tags but those of single subjects."""
        yield "category", [sample.category for sample in self.samples]
        for tag in dict.fromkeys(tag for sample in self.samples for tag in sample.tags if tag not in _RESERVED):
            groups = [tag_group(s.tags[tag]) if tag in s.tags else None for s in self.samples]
            sizes = {name: len(set(self.subjects[[g == name for g in groups]])) for name in set(groups) - {None}}
            if max(sizes.values(), default=0) > 1:
                yield tag, groups

    def _row(self, stage: str, kind: str, name: str, members: Sequence[bool], region: int) -> Iterable[FaceRow]:
        kept = [k for k, member in enumerate(members) if member and stage in self.results[k].distances_mm]
        values = [self.results[k].distances_mm[stage][_points(self.results[k], region)] for k in kept]
        kept = [k for k, value in zip(kept, values, strict=True) if len(value)]
        values = [value for value in values if len(value)]
        if not kept:
            return
        pooled = np.concatenate(values).astype(np.float64)
        weights = np.concatenate([np.full(len(value), 1 / len(value)) for value in values])
        mean = np.average(pooled, weights=weights)
        order = np.argsort(pooled)
        cumulative = np.cumsum(weights[order])
        median = pooled[order][np.searchsorted(cumulative, cumulative[-1] / 2)]
        subjects = self.subjects[kept]
        by_subject = self._by_subject(np.array([[value.mean()] for value in values], np.float64), subjects)
        interval = self._interval(by_subject[:, 0])
        yield FaceRow(
            model=self.model,
            stage=stage,
            kind=kind,
            name=name,
            mean=Interval(mean=float(mean), low=interval.low, high=interval.high),
            median=float(median),
            std=float(np.sqrt(np.average((pooled - mean) ** 2, weights=weights))),
            subjects=len(by_subject),
            samples=len(kept),
        )

    def _interval(self, values: Float[np.ndarray, "N"]) -> Interval:
        return bootstrap_interval(values, seed=self.settings.seed, draws=self.settings.draws)

    @staticmethod
    def _by_subject(values: Float[np.ndarray, "S C"], subjects: np.ndarray) -> Float[np.ndarray, "N C"]:
        """The means of each subject's samples."""
        return np.array([values[subjects == subject].mean(0) for subject in dict.fromkeys(subjects.tolist())])


def _points(result: SampleResult, region: int) -> Bool[np.ndarray, "N"]:
    return result.members[region]


def compactness_mm(model: FaceModel) -> Mapping[str, Float[np.ndarray, "k"]]:
    """Return the root mean square of what the first k components of each part add on the face, coefficients N(0, 1)."""
    tables = {}
    for part, members in model.components.items():
        squares = (model.basis[members][:, model.face] ** 2).sum(2).mean(1)
        tables[part] = 1e3 * np.sqrt(np.cumsum(squares))
    return tables
