"""The model's shape and a similarity fitted to a raw scan by robust closest points, without correspondences.

Only to place the model: which part of the scan is the face, how large it is, which parts cannot be skin. The
registration proper starts from the pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from registration.geometry.rigid import motion_fields
from registration.model.gnm_npz import GNMData
from registration.model.regions import head_regions

_EXPRESSION_SIGMA = 0.3  # of the coefficients; those of identity have 1
_SCALE_SIGMA = 0.08  # of the logarithm of a head's size relative to the model's
NOISE_M = 1.5e-3  # of a scan's distance from the model's span
STIFF_M = 8e-3  # the same where the model must not bend to what is no face
_COMPATIBLE = 0.5  # least cosine between the normals of a pair


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points of a scan with normals, prepared for closest points; metres."""

    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]  # unit; their sign is not used
    border: Bool[np.ndarray, "P"]  # on a border or beside it: pairs with it do not count
    tree: cKDTree

    @classmethod
    def of(
        cls,
        points: Float[np.ndarray, "V 3"],
        normals: Float[np.ndarray, "V 3"],
        border: Bool[np.ndarray, "V"],
        cell_m: float,
    ) -> "SurfacePoints":
        """Keep one point in each cell of this size."""
        keys = np.floor((points - points.min(0)) / cell_m).astype(np.int64)
        _, first = np.unique(keys, axis=0, return_index=True)
        return cls(points=points[first], normals=normals[first], border=border[first], tree=cKDTree(points[first]))


@dataclass(frozen=True, kw_only=True)
class ModelSample:
    """Some vertices of the model's skin, and how they move."""

    vertices: Int[np.ndarray, "S"]
    template: Float[np.ndarray, "S 3"]
    normals: Float[np.ndarray, "S 3"]
    basis: Float[np.ndarray, "K S 3"]  # identity, then expression times its standard deviation
    components: Int[np.ndarray, "K"]  # of the basis: numbers among identity and expression together
    face: Bool[np.ndarray, "S"]  # on the face itself, which every usable scan has

    @classmethod
    def of(cls, data: GNMData, normals: Float[np.ndarray, "V 3"], spacing_m: float, *, shape: bool) -> "ModelSample":
        """Choose vertices about evenly: of the face alone, or with `shape` of the head's skin and with the bases."""
        regions = head_regions(data)
        wanted = np.any([*regions.values()], axis=0) if shape else regions["face"]
        index = np.flatnonzero(wanted)
        points = data.template_vertex_positions.astype(np.float64)
        _, first = np.unique(np.floor(points[index] / spacing_m).astype(np.int64), axis=0, return_index=True)
        index = index[np.sort(first)]
        basis, components = np.zeros((0, len(index), 3)), np.zeros(0, np.int64)
        if shape:
            identity, expression = data.vertex_identity_basis[:, index], data.expression_basis[:, index]
            basis = np.concatenate([identity, _EXPRESSION_SIGMA * expression]).astype(np.float64)
            components = np.flatnonzero(np.abs(basis).max((1, 2)) > 1e-6)
            basis = basis[components]
        return cls(
            vertices=index,
            template=points[index],
            normals=normals[index],
            basis=basis,
            components=components,
            face=regions["face"][index],
        )


@dataclass(frozen=True, kw_only=True)
class Placement:
    """A similarity and a shape; scan = scale * rotation @ model + shift, metres."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    scale: float = 1.0
    coefficients: Float[np.ndarray, "K"] | None = None

    def points(self, sample: ModelSample) -> Float[np.ndarray, "S 3"]:
        """The sample's points in the scan's frame."""
        shape = sample.template
        if self.coefficients is not None and len(self.coefficients) == len(sample.basis):
            shape = shape + np.tensordot(self.coefficients, sample.basis, 1)
        return self.scale * shape @ self.rotation.T + self.shift

    def mesh(self, sample: ModelSample, data: GNMData) -> Float[np.ndarray, "V 3"]:
        """All vertices of the model, in the scan's frame; `sample` is the one whose coefficients these are."""
        shape, count = data.template_vertex_positions.astype(np.float64), len(data.vertex_identity_basis)
        if self.coefficients is not None and len(self.coefficients) == len(sample.basis):
            full = np.zeros(count + len(data.expression_basis))
            full[sample.components] = self.coefficients
            shape = shape + np.tensordot(full[:count], data.vertex_identity_basis, 1)
            shape += np.tensordot(_EXPRESSION_SIGMA * full[count:], data.expression_basis, 1)
        return self.scale * shape @ self.rotation.T + self.shift


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Closest points of a placed sample."""

    residual: Float[np.ndarray, "S"]  # of each point along the scan's normal, metres
    normal: Float[np.ndarray, "S 3"]  # of the scan
    distance: Float[np.ndarray, "S"]
    valid: Bool[np.ndarray, "S"]  # compatible normals, not on a border
    outward: Float[np.ndarray, "S"]  # cosine between the normals: negative where the scan is inside out


def pair(placement: Placement, sample: ModelSample, scan: SurfacePoints, points: Float[np.ndarray, "S 3"]) -> Pairs:
    """Find the closest scan points of the sample's points, which lie at `points`."""
    distance, nearest = scan.tree.query(points)
    normal = scan.normals[nearest]
    cosine = np.einsum("sc,sc->s", normal, sample.normals @ placement.rotation.T)
    return Pairs(
        residual=np.einsum("sc,sc->s", points - scan.points[nearest], normal),
        normal=normal,
        distance=distance,
        valid=(np.abs(cosine) > _COMPATIBLE) & ~scan.border[nearest],
        outward=cosine,
    )


def refine(
    placement: Placement,
    sample: ModelSample,
    scan: SurfacePoints,
    reaches_m: Sequence[float],
    *,
    free_scale: bool = True,
    noise_m: float = NOISE_M,
) -> Placement:
    """Improve a placement by Gauss-Newton steps on point-to-plane distances, with a prior on shape and size.

    Args:
        placement: to start from.
        sample: of the model; without a basis only the similarity is estimated.
        scan: the surface.
        reaches_m: of each step: pairs farther apart do not count, nearer ones gradually more.
        free_scale: estimate the size too.
        noise_m: standard deviation of the distances, against the prior's of the shape.
    """
    count = len(sample.basis)
    if placement.coefficients is None or len(placement.coefficients) != count:  # of another sample
        placement = replace(placement, coefficients=np.zeros(count))
    assert placement.coefficients is not None
    for reach in reaches_m:
        points = placement.points(sample)
        found = pair(placement, sample, scan, points)
        weight = np.where(found.valid, np.clip(1 - (found.distance / reach) ** 2, 0, None) ** 2, 0.0)
        if (weight > 0).sum() < 12:
            return placement
        centre = points.mean(0)
        motion = np.einsum("kpc,pc->pk", motion_fields(points - centre), found.normal)
        size = np.einsum("pc,pc->p", points - centre, found.normal)[:, None] * float(free_scale)
        shape = np.einsum("kpc,pc->pk", placement.scale * sample.basis @ placement.rotation.T, found.normal)
        rows = np.concatenate([motion, size, shape], 1) * np.sqrt(weight)[:, None] / noise_m
        right = -found.residual * np.sqrt(weight) / noise_m
        prior = np.r_[np.full(6, 1e-6), 1 / _SCALE_SIGMA**2, np.ones(count)]
        pull = np.r_[np.zeros(6), -np.log(placement.scale) / _SCALE_SIGMA**2, -placement.coefficients]
        step = np.linalg.solve(rows.T @ rows + np.diag(prior), rows.T @ right + pull)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        growth = float(np.exp(np.clip(step[6], -0.1, 0.1))) if free_scale else 1.0
        # Rotation and growth are about the sample's centre.
        shift = growth * turn @ (placement.shift - centre) + centre + step[3:6]
        placement = Placement(
            rotation=turn @ placement.rotation,
            shift=shift,
            scale=placement.scale * growth,
            coefficients=placement.coefficients + step[7:],
        )
    return placement
