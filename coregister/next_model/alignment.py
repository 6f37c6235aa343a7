"""Neutral heads laid upon one another: generalised Procrustes alignment, and a test of who does not belong
[GNM, Head Identity], [Gower 1975]; docs/algorithms.md, "Alignment of neutrals"."""

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

_NONE = 1e-300  # a weight that nothing has
LEAST_TO_COMPARE = 5  # heads; among fewer nobody can tell which one is spoiled


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """How neutrals are aligned, and when one is refused."""

    tolerance_m: float = 1e-6  # rms change of the mean at which rounds end
    rounds: int = 100
    deviations: float = 5.0  # robust ones of a figure's logarithm, and
    times: float = 2.0  # as many times the others' median: then a head is spoiled


@dataclass(frozen=True, kw_only=True)
class Rejected:
    """A registration that is left out."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Aligned:
    """N heads in the frame of their mean, which lies on the template as it is best laid there. Metres."""

    kept: Int[np.ndarray, "N"]  # which of the heads that came in
    vertices: Float[np.ndarray, "N V 3"]  # float32
    T_model_head: Float[np.ndarray, "N 4 4"]
    mean: Float[np.ndarray, "V 3"]
    residual_mm: Float[np.ndarray, "N"]  # rms distance from the mean over the stable skin
    rounds: int
    rejected: tuple[Rejected, ...]


def align_neutrals(
    vertices: Float[np.ndarray, "M V 3"],
    confidence: Float[np.ndarray, "M V"],
    names: Sequence[str],
    data: GNMData,
    settings: Alignment | None = None,
    *,
    mirrored: bool = False,
) -> Aligned:
    """Rigid, never scaled, never a reflection, by the skin on the skull; weights are its area times the confidence.

    `mirrored`: to the mean of the heads and their mirror images, about the model's plane x = 0.

    Heads stand anywhere at first. After each alignment the head that stands out most from the others is left out, and
    the rest is aligned again, until none does: among at least LEAST_TO_COMPARE.
    """
    settings = settings or Alignment()
    template = data.template_vertex_positions.astype(np.float64)
    stable = SkullSkin.of(data).area
    looks = Looks(data)
    mirror = data.mirror_indices if mirrored else None
    kept, rejected = np.arange(len(vertices)), list[Rejected]()
    while True:
        T, mean, rounds = procrustes(vertices[kept], confidence[kept] * stable, template, settings, mirror)
        moved = np.stack([transform_points(t, v).astype(np.float32) for t, v in zip(T, vertices[kept], strict=True)])
        figures = np.stack([looks.figures(m - mean, sure) for m, sure in zip(moved, confidence[kept], strict=True)])
        found = spoiled(figures, "the mean", settings)
        if found is None:
            break
        worst, reason = found
        rejected.append(Rejected(name=names[kept[worst]], reason=reason))
        kept = np.delete(kept, worst)
    away = ((moved - mean) ** 2).sum(-1)
    return Aligned(
        kept=kept,
        vertices=moved,
        T_model_head=T,
        mean=mean,
        residual_mm=MM_PER_M * np.sqrt(away @ stable / stable.sum()),
        rounds=rounds,
        rejected=tuple(rejected),
    )


def procrustes(
    vertices: Float[np.ndarray, "N V 3"],
    weights: Float[np.ndarray, "N V"],
    template: Float[np.ndarray, "V 3"],
    settings: Alignment,
    mirror: Int[np.ndarray, "V"] | None = None,
) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "V 3"], int]:
    """T_model_head of each head, their mean (all vertices, metres), and how many rounds it took.

    In turn all heads are aligned with the mean and the mean is taken anew, each vertex' by its weights; it is then laid
    on the template, since nothing else says where it stands. `mirror` makes mean and template symmetric.
    """
    weighted = np.asarray(weights.any(0))
    rows = np.flatnonzero(weighted if mirror is None else weighted | weighted[mirror])
    source, own = vertices[:, rows].astype(np.float64), weights[:, rows]
    twins = None if mirror is None else np.searchsorted(rows, mirror[rows])
    total = own.sum(0)
    aim = _both_sides(template[rows], np.ones_like(total), twins)[0]
    mean, T, round_ = aim, np.tile(np.eye(4), (len(vertices), 1, 1)), 0
    while round_ < settings.rounds:
        round_ += 1
        T = align(source, mean, own)
        moved = np.einsum("ncd,npd->npc", T[:, :3, :3], source) + T[:, None, :3, 3]
        fresh, both = _both_sides(np.einsum("np,npc->pc", own, moved) / np.maximum(total, _NONE)[:, None], total, twins)
        home = align(fresh[None], aim, both[None])[0]
        fresh, T = transform_points(home, fresh), home @ T
        change = np.sqrt(((fresh - mean) ** 2).sum(1) @ both / both.sum())
        mean = fresh
        if change < settings.tolerance_m:
            break
    whole = np.zeros_like(template)
    for t, head in zip(T, vertices, strict=True):
        whole += transform_points(t, head.astype(np.float64)) / len(vertices)
    return T, whole, round_


def _both_sides(
    points: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"], twins: Int[np.ndarray, "P"] | None
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """The weighted mean of points and of their mirror images, and its weights; as they are without `twins`."""
    if twins is None:
        return points, weights
    both = weights + weights[twins]
    mean = weights[:, None] * points + weights[twins, None] * points[twins] * (-1, 1, 1)
    return mean / np.maximum(both, _NONE)[:, None], both


class Looks:
    """What meshes of one kind are compared by: how far the skin that is seen lies from where it should."""

    NAMES = ("lies {:.1f} mm (rms) from {}", "has a spot {:.1f} mm from {}", "is rough by {:.2f} mm (rms) against {}")

    def __init__(self, data: GNMData):
        self._outside = regions.exterior(data)
        self._laplacian: csr_matrix = normalised_laplacian(data.triangles, len(self._outside))

    def figures(self, away: Float[np.ndarray, "V 3"], confidence: Float[np.ndarray, "V"]) -> Float[np.ndarray, "3"]:
        """mm: rms of the distance, its 99.5th percentile, rms of its Laplacian; 0 where nothing is seen."""
        seen = self._outside & (confidence > 0)
        if not seen.any():
            return np.zeros(len(self.NAMES))
        distance = MM_PER_M * np.linalg.norm(away[seen], axis=1)
        # At a border with what is not seen the Laplacian would tell of that.
        inside = seen & (abs(self._laplacian) @ ~seen == 0)
        bent = MM_PER_M * np.linalg.norm((self._laplacian @ away)[inside], axis=1)
        return np.array([_rms(distance), np.percentile(distance, 99.5), _rms(bent)])


def spoiled(figures: Float[np.ndarray, "N 3"], origin: str, settings: Alignment) -> tuple[int, str] | None:
    """The mesh that stands out most from the median of a figure, by its logarithm's robust deviations, and why."""
    if len(figures) < LEAST_TO_COMPARE:
        return None
    logs = np.log(np.maximum(figures, 1e-3))
    middle = np.median(logs, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(logs - middle), axis=0), 1e-2)
    out = (logs - middle) / spread
    out[logs - middle <= np.log(settings.times)] = 0
    number, which = np.unravel_index(out.argmax(), out.shape)
    if out[number, which] <= settings.deviations:
        return None
    words = Looks.NAMES[which].format(figures[number, which], origin)
    return int(number), f"{words}; the median is {np.exp(middle[which]):.2f} mm"


def _rms(values: Float[np.ndarray, "_"]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
