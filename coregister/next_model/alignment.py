"""Generalized Procrustes alignment of neutral heads with outlier rejection [GNM, Head Identity], [Gower 1975];
docs/algorithms.md, "Alignment of neutrals"."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from registration.frames import MM_PER_M, transform_points
from registration.geometry.large_steps import normalised_laplacian
from registration.geometry.rigid import align
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

_EPSILON = 1e-300  # below any weight
MIN_SAMPLES_FOR_OUTLIERS = 5  # a median of fewer is no reference


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """When alignment has converged, and when a mesh is an outlier.

    Attributes:
        tolerance_m: rms change of the mean at which iterations end.
        max_iterations: of the alignment.
        max_deviations: robust standard deviations of a statistic's logarithm; an outlier exceeds them, and
        min_ratio: this multiple of the statistic's median.
    """

    tolerance_m: float = 1e-6
    max_iterations: int = 100
    max_deviations: float = 5.0
    min_ratio: float = 2.0


@dataclass(frozen=True, kw_only=True)
class RejectedSubject:
    """A subject's neutral, or one of its expressions, that is excluded as an outlier."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignedNeutrals:
    """N heads in the frame of their mean, which is aligned with the template. Metres."""

    kept: Int[np.ndarray, "N"]  # indices into the heads that were given
    vertices: Float[np.ndarray, "N V 3"]  # float32
    T_model_head: Float[np.ndarray, "N 4 4"]
    mean: Float[np.ndarray, "V 3"]
    residual_mm: Float[np.ndarray, "N"]  # rms distance from the mean over the stable skin
    iterations: int
    rejected: tuple[RejectedSubject, ...]


def align_neutrals(
    vertices: Float[np.ndarray, "M V 3"],
    confidence: Float[np.ndarray, "M V"],
    names: Sequence[str],
    data: GNMData,
    settings: AlignmentSettings | None = None,
    *,
    mirrored: bool = False,
) -> AlignedNeutrals:
    """Align neutrals with their mean and reject outliers, one at a time.

    Rigid, without scale and without reflection, by the skin over the skull, weighted by area times confidence. After
    each alignment the worst outlier is excluded and the others are aligned again.

    Args:
        vertices: heads in the topology of `data`, metres, each in any frame.
        confidence: of the vertices, 0 to 1; 0: not observed.
        names: of the heads.
        data: the previous model, whose template defines the frame.
        settings: tolerances.
        mirrored: align with the mean of the heads and their mirror images about the model's plane x = 0.

    Returns:
        The aligned heads without outliers, and the outliers' names and reasons.
    """
    settings = settings or AlignmentSettings()
    template = data.template_vertex_positions.astype(np.float64)
    stable = SkullSkin.from_model(data).area
    statistics = OutlierStatistics(data)
    mirror = data.mirror_indices if mirrored else None
    kept, rejected = np.arange(len(vertices)), list[RejectedSubject]()
    while True:
        heads = vertices[kept] if rejected else vertices  # thousands of heads: no copy without need
        weights = confidence[kept] * stable.astype(np.float32)
        T, mean, iterations = generalized_procrustes(heads, weights, template, settings, mirror)
        aligned = np.empty(heads.shape, np.float32)
        for index, (t, head) in enumerate(zip(T, heads, strict=True)):
            aligned[index] = transform_points(t, head)
        rows = zip(aligned, confidence[kept], strict=True)
        values = np.stack([statistics(head - mean, observed) for head, observed in rows])
        outlier = find_outlier(values, "the mean", settings)
        if outlier is None:
            break
        index, reason = outlier
        rejected.append(RejectedSubject(name=names[kept[index]], reason=reason))
        kept = np.delete(kept, index)
    squares = np.stack([((head - mean) ** 2).sum(-1) @ stable for head in aligned])
    return AlignedNeutrals(
        kept=kept,
        vertices=aligned,
        T_model_head=T,
        mean=mean,
        residual_mm=MM_PER_M * np.sqrt(squares / stable.sum()),
        iterations=iterations,
        rejected=tuple(rejected),
    )


def generalized_procrustes(
    vertices: Float[np.ndarray, "N V 3"],
    weights: Float[np.ndarray, "N V"],
    template: Float[np.ndarray, "V 3"],
    settings: AlignmentSettings,
    mirror: Int[np.ndarray, "V"] | None = None,
) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "V 3"], int]:
    """Align all heads with their weighted mean, alternately, until the mean converges [Gower 1975].

    Every new mean is aligned with the template, which defines its frame.

    Args:
        vertices: of the heads, metres.
        weights: of the vertices.
        template: in the model's frame, metres.
        settings: tolerance and number of iterations.
        mirror: each vertex' mirror image; makes mean and template symmetric.

    Returns:
        T_model_head of every head, the mean of all vertices (metres), and the number of iterations.
    """
    weighted = np.asarray(weights.any(0))
    rows = np.flatnonzero(weighted if mirror is None else weighted | weighted[mirror])
    source, row_weights = vertices[:, rows], weights[:, rows]
    mirror_rows = None if mirror is None else np.searchsorted(rows, mirror[rows])
    total = row_weights.sum(0, dtype=np.float64)
    target = _symmetric_mean(template[rows], np.ones_like(total), mirror_rows)[0]
    mean, T, iteration = target, np.tile(np.eye(4), (len(vertices), 1, 1)), 0
    while iteration < settings.max_iterations:
        iteration += 1
        T = align(source, mean, row_weights)
        head_mean = np.zeros_like(mean)
        for t, points, weight in zip(T, source, row_weights, strict=True):
            head_mean += weight[:, None] * transform_points(t, points.astype(np.float64))
        head_mean /= np.maximum(total, _EPSILON)[:, None]
        new_mean, mean_weights = _symmetric_mean(head_mean, total, mirror_rows)
        T_template_mean = align(new_mean[None], target, mean_weights[None])[0]
        new_mean, T = transform_points(T_template_mean, new_mean), T_template_mean @ T
        change = np.sqrt(((new_mean - mean) ** 2).sum(1) @ mean_weights / mean_weights.sum())
        mean = new_mean
        if change < settings.tolerance_m:
            break
    mean_vertices = np.zeros_like(template)
    for t, head in zip(T, vertices, strict=True):
        mean_vertices += transform_points(t, head.astype(np.float64)) / len(vertices)
    return T, mean_vertices, iteration


def _symmetric_mean(
    points: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"], mirror_rows: Int[np.ndarray, "P"] | None
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """The weighted mean of points and their mirror images, and its weights; unchanged without `mirror_rows`."""
    if mirror_rows is None:
        return points, weights
    total = weights + weights[mirror_rows]
    mean = weights[:, None] * points + weights[mirror_rows, None] * points[mirror_rows] * (-1, 1, 1)
    return mean / np.maximum(total, _EPSILON)[:, None], total


class OutlierStatistics:
    """Statistics of the observed skin's distance from a reference, by which meshes of one kind are compared."""

    TITLES = ("lies {:.1f} mm (rms) from {}", "has a spot {:.1f} mm from {}", "is rough by {:.2f} mm (rms) against {}")

    def __init__(self, data: GNMData):
        self._exterior = regions.exterior(data)
        self._laplacian: csr_matrix = normalised_laplacian(data.triangles, len(self._exterior))

    def __call__(
        self, displacement: Float[np.ndarray, "V 3"], confidence: Float[np.ndarray, "V"]
    ) -> Float[np.ndarray, "3"]:
        """Return, in mm, rms and 99.5th percentile of the distance, and rms of the displacement's Laplacian.

        Args:
            displacement: from the reference, metres.
            confidence: 0: not observed. Without any observed skin all statistics are 0.
        """
        observed = self._exterior & (confidence > 0)
        if not observed.any():
            return np.zeros(len(self.TITLES))
        distance = MM_PER_M * np.linalg.norm(displacement[observed], axis=1)
        # At the border of observed skin the Laplacian would contain unobserved neighbours.
        inside = observed & (abs(self._laplacian) @ ~observed == 0)
        roughness = MM_PER_M * np.linalg.norm((self._laplacian @ displacement)[inside], axis=1)
        return np.array([_rms(distance), np.percentile(distance, 99.5), _rms(roughness)])


def find_outlier(
    statistics: Float[np.ndarray, "N 3"], reference: str, settings: AlignmentSettings
) -> tuple[int, str] | None:
    """Return the index of the mesh that deviates most from the median of a statistic, and the reason.

    Deviations are those of logarithms, in robust standard deviations (1.4826 MAD).

    Args:
        statistics: of N meshes, by `OutlierStatistics`.
        reference: what distances are from, for the reason.
        settings: limits.

    Returns:
        None if no mesh exceeds the limits, or among fewer than MIN_SAMPLES_FOR_OUTLIERS.
    """
    if len(statistics) < MIN_SAMPLES_FOR_OUTLIERS:
        return None
    logs = np.log(np.maximum(statistics, 1e-3))
    median = np.median(logs, axis=0)
    deviation = np.maximum(1.4826 * np.median(np.abs(logs - median), axis=0), 1e-2)
    excess = (logs - median) / deviation
    excess[logs - median <= np.log(settings.min_ratio)] = 0
    mesh, kind = np.unravel_index(excess.argmax(), excess.shape)
    if excess[mesh, kind] <= settings.max_deviations:
        return None
    words = OutlierStatistics.TITLES[kind].format(statistics[mesh, kind], reference)
    return int(mesh), f"{words}; the median is {np.exp(median[kind]):.2f} mm"


def _rms(values: Float[np.ndarray, "_"]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
