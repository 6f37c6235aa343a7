"""Build the auxiliary model that completes craniums, from whole heads of one topology [Ploumpis 2019].

Rank and noise are those of the least leave-one-out error. See docs/algorithms.md, "Cranium".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.cranium.auxiliary_model import CraniumModel
from registration.cranium.conditional import patch_areas, predict, twist_fields
from registration.errors import InputError
from registration.geometry import rigid
from registration.geometry.pca import dense_components
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData, topology_hash
from registration.render.studio.skin import depth_inside_hairline

MIN_HEADS = 30
RANKS = (20, 40, 60, 80, 100)
NOISES_MM = (0.5, 1.0, 2.0, 4.0, 8.0)  # of a square centimetre of skin; less than a registration's is not tried
_ROUNDING = 1e-5  # of the largest standard deviation of a component


def under_hair(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Return the part of the cranium that short hair hides: above the hairline and behind the ears."""
    return regions.cranium(data) & (depth_inside_hairline(data) > 0)


def build_cranium_model(
    data: GNMData,
    heads: Float[np.ndarray, "N V 3"],
    *,
    seed: int,
    source: str,
    ranks: Sequence[int] = RANKS,
    noises_mm: Sequence[float] = NOISES_MM,
) -> CraniumModel:
    """Build an auxiliary model from heads and their mirror images.

    Args:
        data: the head model of the topology.
        heads: whole neutral heads of different people, in any pose of the whole head; metres.
        seed: of the heads; -1: they were files.
        source: of the heads, for people.
        ranks: to try.
        noises_mm: standard deviations to try.

    Raises:
        InputError: there are fewer than 30 heads.
    """
    if len(heads) < MIN_HEADS:
        raise InputError(
            "There are too few heads for an auxiliary model of the cranium",
            where=source,
            expected=f"at least {MIN_HEADS} heads",
            got=len(heads),
            fix="add heads of other people",
        )
    count = len(heads)
    heads = np.concatenate([heads, heads[:, data.mirror_indices] * np.array([-1, 1, 1], heads.dtype)])
    exterior = regions.exterior(data)
    face = exterior & ~regions.cranium(data) & ~regions.neck_other(data)
    area = vertex_areas(data.template_vertex_positions.astype(np.float64), data.triangles)
    aligned = _aligned(heads, area * face)
    mean = aligned.mean(0)
    rows = np.flatnonzero(exterior)
    deviations = (aligned - mean)[:, rows]
    roots = np.repeat(np.sqrt(area[rows]), 3)
    components, spread = dense_components(deviations.reshape(len(heads), -1) * roots, 1.0, centred=True)
    most = min(int((spread > _ROUNDING * spread[0]).sum()), count - 2)  # fewer than heads if they are of a model
    ranks = [rank for rank in ranks if rank <= most] or [most]
    products = _Products.of(data, mean, deviations, rows, max(ranks))
    tried = [(rank, noise / 1000) for rank in ranks for noise in noises_mm]
    errors = np.array([products.hidden_error(*setting) for setting in tried])
    rank, noise = tried[int(errors.argmin())]
    basis, residual = np.zeros((rank, *mean.shape)), np.zeros(len(mean))
    basis[:, rows] = (components[:rank] / roots).reshape(rank, -1, 3)
    left = products.left_out(rank, noise, products.seen)[:, : len(heads)] @ deviations.reshape(len(heads), -1)
    residual[rows] = np.sqrt(np.square(left).reshape(count, -1, 3).sum(2).mean(0))
    model = CraniumModel(
        topology=topology_hash(data.triangles),
        mean=mean,
        basis=basis,
        residual=residual,
        noise=noise,
        heads=count,
        seed=seed,
        source=source,
        tried_ranks=np.array([setting[0] for setting in tried]),
        tried_noises=np.array([setting[1] for setting in tried]),
        tried_errors=errors,
    )
    # Left-out heads err by the posterior deviation and by what the components lack: the latter is the residual.
    patches = patch_areas(mean, data.triangles) * (regions.head_skin(data) & ~under_hair(data))
    posterior = np.square(predict(replace(model, residual=np.zeros(len(mean))), mean, patches).deviation)
    return replace(model, residual=np.sqrt(np.maximum(np.square(residual) - posterior, 0)))


def _aligned(heads: Float[np.ndarray, "N V 3"], weights: Float[np.ndarray, "V"]) -> Float[np.ndarray, "N V 3"]:
    """The heads, aligned rigidly to their mean by the weighted vertices."""
    heads = heads.astype(np.float64)
    target = heads[0]
    for _ in range(3):
        T = rigid.align(heads, target, np.tile(weights, (len(heads), 1)))
        heads = np.einsum("sij,svj->svi", T[:, :3, :3], heads) + T[:, None, :3, 3]
        target = heads.mean(0)
    return heads


@dataclass(frozen=True, kw_only=True, eq=False)
class _Products:
    """Inner products of N heads, their images and six motions: all leave-one-out fits follow without their vertices.

    Rows and columns: deviations from the mean of the heads, then of their mirror images; then the fields of six twists.
    """

    count: int  # N
    rank: int  # the largest that will be asked for
    shape: Float[np.ndarray, "M M"]  # over all skin, by area: what the components explain
    seen: Float[np.ndarray, "M M"]  # over the skin that hair does not hide, by patches
    hidden: Float[np.ndarray, "M M"]  # over the cranium that hair hides, by share of its area

    @classmethod
    def of(
        cls,
        data: GNMData,
        mean: Float[np.ndarray, "V 3"],
        deviations: Float[np.ndarray, "M E 3"],
        rows: Int[np.ndarray, "E"],
        rank: int,
    ) -> "_Products":
        patches = patch_areas(mean, data.triangles)
        hair, head = under_hair(data), regions.head_skin(data)
        centre = np.average(mean, axis=0, weights=patches * head)
        vectors = np.concatenate([deviations, twist_fields(mean, centre)[:, rows]])

        def products(weights: np.ndarray) -> np.ndarray:
            weighted = (vectors * weights[rows][:, None]).reshape(len(vectors), -1)
            return np.asarray(weighted @ vectors.reshape(len(vectors), -1).T)

        return cls(
            count=len(deviations) // 2,
            rank=rank,
            shape=products(patches),
            seen=products(patches * (head & ~hair)),
            hidden=products(patches * hair / max(patches[hair].sum(), 1e-12)),
        )

    @cached_property
    def _spectra(self) -> list[tuple[Float[np.ndarray, "M"], Float[np.ndarray, "K M"]]]:
        """For each head the mean and the components of the others and their images."""
        spectra = []
        for left_out in range(self.count):
            others = np.delete(np.arange(2 * self.count), [left_out, left_out + self.count])
            mean = np.zeros(len(self.shape))
            mean[others] = 1 / len(others)
            centred = np.eye(len(self.shape))[others] - mean
            _, vectors = np.linalg.eigh(centred @ self.shape @ centred.T)
            spectra.append((mean, vectors[:, : -self.rank - 1 : -1].T @ centred / np.sqrt(len(others) - 1)))
        return spectra

    def hidden_error(self, rank: int, noise: float) -> float:
        """The rms distance of left-out heads from their predictions under the hair, metres."""
        left = self.left_out(rank, noise, self.seen)
        return float(np.sqrt(np.einsum("nm,mk,nk->n", left, self.hidden, left, optimize=True).mean()))

    def left_out(self, rank: int, noise: float, observed: Float[np.ndarray, "M M"]) -> Float[np.ndarray, "N M"]:
        """Each head minus its prediction by a model of the others, as a combination of deviations and motions."""
        motions = np.eye(len(self.shape))[2 * self.count :]
        result = np.zeros((self.count, len(self.shape)))
        for index, (mean, components) in enumerate(self._spectra):
            basis = np.concatenate([components[:rank], motions])
            target = -mean
            target[index] += 1
            weighted = basis @ observed
            system = weighted @ basis.T + noise**2 * np.eye(len(basis))
            result[index] = target - np.linalg.solve(system, weighted @ target) @ basis
        return result
