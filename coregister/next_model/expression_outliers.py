"""Expressions that went wrong, by what their surface does [GNM, Head Expression]; docs/algorithms.md, "Outliers among
expressions".

A rare expression, such as a wide open jaw, moves the skin far; a spoiled mesh tears, folds and roughens it, moves skin
that lies on bone, or misses its own pictures. Samples are compared within their label, so that none is rejected for
what its expression does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from coregister.next_model.alignment import MIN_SAMPLES_FOR_OUTLIERS, AlignmentSettings, RejectedSubject
from registration.evaluate.names import SHARP_FOLD_DEG
from registration.frames import MM_PER_M
from registration.geometry.folds import Creases, turn_cosines
from registration.geometry.large_steps import normalised_laplacian
from registration.geometry.topology import edges
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

_RARE_QUANTILE = 0.9  # of all samples: the reference of a label with too few samples for a median of its own,
_RARE_RATIO = 3.0  # and the multiple of it that an outlier exceeds


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """A statistic of a mesh; larger is worse."""

    words: str  # of a reason, with the value
    negligible: float  # smaller values count as this one


_SURFACE = (
    _Kind(words="moves the skin over the skull by {:.1f} mm (rms)", negligible=1.0),
    _Kind(words="stretches the skin by a factor of {:.2f} (rms)", negligible=1.05),
    _Kind(words="is rough by {:.2f} mm (rms)", negligible=0.05),
    _Kind(words="folds the skin along {:.0f} mm", negligible=30.0),
)
# What a registration may report of itself (`TrainingMesh.figures`).
_REPORTED: Mapping[str, _Kind] = {
    "scan_mm": _Kind(words="lies {:.2f} mm from its scan", negligible=0.1),
    "depth_mm": _Kind(words="lies {:.2f} mm from its depth maps", negligible=0.1),
    "normals_deg": _Kind(words="differs from its normals by {:.1f} degrees", negligible=2.0),
    "colour_levels": _Kind(words="differs from its pictures by {:.1f} levels", negligible=3.0),
    "intersecting_vertices": _Kind(words="has {:.0f} vertices in other parts", negligible=100.0),
}
REPORTED_FIGURES = tuple(_REPORTED)
_KINDS = (*_SURFACE, *_REPORTED.values())


class ExpressionStatistics:
    """What an expression does to the observed outer skin of its subject's neutral."""

    def __init__(self, data: GNMData):
        """Prepare the topology of a model."""
        self._exterior = regions.exterior(data)
        self._skull = SkullSkin.from_model(data).area
        self._laplacian = normalised_laplacian(data.triangles, len(self._exterior))
        self._neighbours = abs(self._laplacian)
        self._edges = edges(data.triangles[self._exterior[data.triangles].all(1)]).vertices
        self._creases = Creases.of(data.triangles, data.template_vertex_positions, self._exterior)

    def __call__(
        self,
        neutral: Float[np.ndarray, "V 3"],
        displacement: Float[np.ndarray, "V 3"],
        confidence: Float[np.ndarray, "V"],
        figures: Mapping[str, float],
    ) -> Float[np.ndarray, "_"]:
        """Return the statistics in the order of their kinds; NaN: not reported. Without observed skin they are 0.

        Skull: rms motion of the skin over it, mm. Stretch: exp of the rms of log edge lengths over the neutral's, edges
        by their length. Roughness: rms of the displacement's Laplacian, mm. Folds: length of the edges that only the
        expression folds by more than SHARP_FOLD_DEG, mm.

        Args:
            neutral: metres, in the frame of the displacement.
            displacement: of the expression, metres.
            confidence: 0: not observed.
            figures: that the registration reports.
        """
        observed = self._exterior & (confidence > 0)
        reported = [figures.get(name, np.nan) for name in _REPORTED]
        seen = observed[self._edges].all(1)
        if not seen.any():
            return np.array([0.0] * len(_SURFACE) + reported)
        weights = self._skull * observed
        skull = MM_PER_M * np.sqrt(weights @ (displacement**2).sum(1) / max(weights.sum(), 1e-12))
        expression = neutral + displacement
        before, after = (np.linalg.norm(np.diff(v[self._edges], axis=1)[:, 0], axis=1) for v in (neutral, expression))
        logs = np.log(np.maximum(after[seen], 1e-9) / np.maximum(before[seen], 1e-9))
        stretch = np.exp(np.sqrt(np.average(logs**2, weights=before[seen])))
        # At the border of observed skin the Laplacian would contain unobserved neighbours.
        inside = observed & (self._neighbours @ ~observed == 0)
        roughness = (self._laplacian @ displacement)[inside] if inside.any() else np.zeros((1, 3))
        folds = np.flatnonzero(self._folded(expression, self._creases.faces))
        faces = self._creases.faces[folds]
        folds = folds[observed[faces].all((1, 2)) & ~self._folded(neutral, faces)]
        surface = [
            skull,
            stretch,
            MM_PER_M * np.sqrt((roughness**2).sum(1).mean()),
            MM_PER_M * np.linalg.norm(np.diff(neutral[self._creases.vertices[folds]], axis=1), axis=2).sum(),
        ]
        return np.array(surface + reported)

    @staticmethod
    def _folded(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "E 2 3"]) -> Bool[np.ndarray, "E"]:
        cosines = turn_cosines(torch.as_tensor(vertices), torch.as_tensor(faces))
        return np.asarray(cosines.numpy() < np.cos(np.radians(SHARP_FOLD_DEG)))


def reject_expressions(
    statistics: Sequence[Float[np.ndarray, "k"]],
    labels: Sequence[str],
    names: Sequence[str],
    settings: AlignmentSettings,
) -> tuple[Int[np.ndarray, "_"], tuple[RejectedSubject, ...]]:
    """Return the indices of the expressions to keep, and the others with their reasons.

    A statistic's logarithm is compared with its label's median: an outlier exceeds it by `max_deviations` robust
    standard deviations of all samples from their labels' medians (1.4826 MAD), and by `min_ratio`. A label with too
    few samples for a median is compared with the statistic's 90th percentile over all samples: an outlier exceeds
    three times that. Rounds end when none is rejected.

    Args:
        statistics: of N expressions, by `ExpressionStatistics`.
        labels: of the expressions.
        names: of the expressions.
        settings: limits.
    """
    kept, rejected = np.arange(len(names)), list[RejectedSubject]()
    if len(kept) < MIN_SAMPLES_FOR_OUTLIERS:
        return kept, ()
    logs = np.log(np.maximum(np.stack(statistics), [kind.negligible for kind in _KINDS]))
    groups = np.unique(np.asarray(labels, str), return_inverse=True)[1]
    while len(kept) >= MIN_SAMPLES_FOR_OUTLIERS:
        reference, limit = _limits(logs[kept], groups[kept], settings)
        with np.errstate(invalid="ignore"):
            excess = np.nan_to_num(logs[kept] - limit, nan=-np.inf)
        outliers = np.flatnonzero(excess.max(1) > 0)
        if not len(outliers):
            break
        for row in outliers.tolist():
            kind = int(excess[row].argmax())
            words = _KINDS[kind].words.format(statistics[kept[row]][kind])
            reason = f"{words}; {np.exp(reference[row, kind]):.2f} is usual for {labels[kept[row]]}"
            rejected.append(RejectedSubject(name=names[kept[row]], reason=reason))
        kept = np.delete(kept, outliers)
    return kept, tuple(rejected)


def _limits(
    logs: Float[np.ndarray, "N k"], groups: Int[np.ndarray, "N"], settings: AlignmentSettings
) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "N k"]]:
    """Each sample's reference, and what an outlier exceeds; logarithms. NaN: no sample reports the statistic."""
    reference, limit = np.full_like(logs, np.nan), np.full_like(logs, np.nan)
    for kind in range(logs.shape[1]):
        known = np.flatnonzero(np.isfinite(logs[:, kind]))
        if len(known) < MIN_SAMPLES_FOR_OUTLIERS:
            continue
        values, group = logs[known, kind], groups[known]
        usual = np.full(len(known), np.quantile(values, _RARE_QUANTILE))
        common = np.bincount(group)[group] >= MIN_SAMPLES_FOR_OUTLIERS
        for label in np.unique(group[common]):
            usual[group == label] = np.median(values[group == label])
        deviation = 1.4826 * np.median(np.abs(values - usual)[common]) if common.any() else 0.0
        margin = max(settings.max_deviations * deviation, np.log(settings.min_ratio))
        reference[known, kind] = usual
        limit[known, kind] = usual + np.where(common, margin, np.log(_RARE_RATIO))
    return reference, limit
