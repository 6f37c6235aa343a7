"""How near a linear model comes to heads that it was not made from (docs/algorithms.md, "Generalization").

Where vertices correspond, coefficients and rigid motion together are a small least-squares problem, solved to the end:
nothing is regularised and nothing depends on a step length. Bases are not orthogonal, across regions nor on a part of
the mesh, so every projection solves normal equations. [GNM,
Generalization to Novel Shapes] runs Adam for 5,000 steps to the same minimum.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import align, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

_SETTLED = 1e-9  # metres: no vertex of a step moves farther
_MOST_STEPS = 60
_NOTHING = 1e-24  # of the largest: a column's square sum that is rounding, and must not be scaled up
_DEPENDENT = 1e-10  # of the largest eigenvalue, columns scaled to one: below it a direction is not determined


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearPart:
    """A linear model on some of its vertices: rest + coefficients @ basis. Metres, model frame, float64."""

    rows: Int[np.ndarray, "P"]  # of the model's vertices
    rest: Float[np.ndarray, "P 3"]
    basis: Float[np.ndarray, "K P 3"]
    triangles: Int[np.ndarray, "F 3"]  # between the part's own vertices
    weights: Float[np.ndarray, "P"] | None = None  # of squared distances in a fit, mean 1; None: all alike

    @cached_property
    def root(self) -> Float[np.ndarray, "P 1"]:
        """What distances are multiplied by before they are squared."""
        return np.ones((len(self.rows), 1)) if self.weights is None else np.sqrt(self.weights)[:, None]

    @cached_property
    def gram(self) -> Float[np.ndarray, "K K"]:
        flat = (self.basis * self.root).reshape(len(self.basis), -1)
        return flat @ flat.T

    def mean(self, values: Float[np.ndarray, "P"]) -> float:
        """Mean over the vertices, as they weigh."""
        return float(np.average(values, weights=self.weights))

    def shape(self, coefficients: Float[np.ndarray, "K"]) -> Float[np.ndarray, "P 3"]:
        used = len(coefficients)
        return self.rest + np.tensordot(coefficients, self.basis[:used], 1)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The model's head nearest to a target, with the first `len(coefficients)` components."""

    coefficients: Float[np.ndarray, "k"]
    T_model_world: Float[np.ndarray, "4 4"]  # lays the target onto the model
    distance_mm: Float[np.ndarray, "P"]  # of each vertex from the target's
    converged: bool


def identity_part(data: GNMData, rows: Bool[np.ndarray, "V"] | None = None) -> LinearPart:
    """All identity components that move the skin, on these vertices, by default the head's skin.

    Components of eyeballs or teeth alone are not among them.
    """
    return _part(data, regions.head_skin(data) if rows is None else rows, data.vertex_identity_basis)


def surface_part(data: GNMData) -> LinearPart:
    """The same components on the whole outer skin, neck and all, where vertices weigh as the area they stand for."""
    part = identity_part(data, regions.exterior(data))
    area = vertex_areas(data.template_vertex_positions, data.triangles)[part.rows]
    return replace(part, weights=area / area.mean())


def whole_part(data: GNMData) -> LinearPart:
    """Identity and expression together on the head's skin, as in [GNM, Generalization to Novel Shapes]."""
    return _part(data, regions.head_skin(data), data.vertex_identity_basis, data.expression_basis)


def _part(data: GNMData, members: Bool[np.ndarray, "V"], *bases: Float[np.ndarray, "_ V 3"]) -> LinearPart:
    rows, skin = np.flatnonzero(members), regions.exterior(data)
    moving = [basis[np.abs(basis[:, skin]).max((1, 2), initial=0) > 0][:, rows] for basis in bases]
    return LinearPart(
        rows=rows,
        rest=data.template_vertex_positions[rows].astype(np.float64),
        basis=np.concatenate(moving).astype(np.float64),
        triangles=_between(data, rows),
    )


def _between(data: GNMData, rows: Int[np.ndarray, "P"]) -> Int[np.ndarray, "F 3"]:
    """The triangles whose corners are all among these vertices, as indices into them."""
    place = np.full(len(data.template_vertex_positions), -1)
    place[rows] = np.arange(len(rows))
    local = place[data.triangles]
    return local[(local >= 0).all(1)]


def fit(part: LinearPart, target: Float[np.ndarray, "P 3"], components: Sequence[int]) -> list[Fit]:
    """The nearest heads to a mesh in correspondence, for each number of components, the smallest first.

    `target`: the part's vertices, metres, any frame; neither its turn nor its place matters, its size does.
    Coefficients and rigid motion are solved together by Gauss-Newton steps, each number starting from the one before.
    Where the part does not determine a coefficient, it is the least that there is.
    """
    target = np.asarray(target, np.float64)
    pose = align(target[None], part.rest, part.root.T**2)[0]
    coefficients = np.zeros(0)
    found = []
    for count in components:
        coefficients = np.concatenate([coefficients, np.zeros(count - len(coefficients))])
        found.append(_nearest(part, target, coefficients, pose))
        coefficients, pose = found[-1].coefficients, found[-1].T_model_world
    return found


def _nearest(
    part: LinearPart,
    target: Float[np.ndarray, "P 3"],
    coefficients: Float[np.ndarray, "k"],
    pose: Float[np.ndarray, "4 4"],
) -> Fit:
    count, settled = len(coefficients), False
    flat = (part.basis[:count] * part.root).reshape(count, -1)
    shape, placed = part.shape(coefficients), transform_points(pose, target)
    for _ in range(_MOST_STEPS):
        away = ((placed - shape) * part.root).ravel()
        fields = (motion_fields(placed) * part.root).reshape(6, -1)
        mixed = -flat @ fields.T
        matrix = np.block([[part.gram[:count, :count], mixed], [mixed.T, fields @ fields.T]])
        step = solve(matrix, np.concatenate([flat @ away, -fields @ away])[:, None])[:, 0]
        coefficients = coefficients + step[:count]
        pose = twisted(step[count:]) @ pose
        moved, turned = part.shape(coefficients), transform_points(pose, target)
        change = max(np.abs(moved - shape).max(initial=0), np.abs(turned - placed).max())
        shape, placed = moved, turned
        if change < _SETTLED:
            settled = True
            break
    distance = np.linalg.norm(placed - shape, axis=1) * MM_PER_M
    return Fit(coefficients=coefficients, T_model_world=pose, distance_mm=distance, converged=settled)


def solve(matrix: Float[np.ndarray, "N N"], right: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "N S"]:
    """Normal equations, columns scaled to one; columns of zeros, and directions left open, get the least solution."""
    size = np.diag(matrix)
    scale = np.sqrt(np.where(size > _NOTHING * size.max(initial=0), size, np.inf))[:, None]
    inverse = np.linalg.pinv(matrix / (scale * scale.T), rcond=_DEPENDENT, hermitian=True)
    return np.asarray(inverse @ (right / scale) / scale)


def twisted(twist: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion of a twist (w, t): turned by w about the origin, then moved by t."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    motion[:3, 3] = twist[3:]
    return motion


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpressionPart:
    """One region's expression components on its soft mask; teeth that move along with the lower face are not on it."""

    mask: Float[np.ndarray, "P"]
    part: LinearPart  # at rest: zeros

    def errors_mm(
        self, displacements: Float[np.ndarray, "S V 3"], components: Sequence[int]
    ) -> Float[np.ndarray, "S k"]:
        """Mean distance of the region's best from each displacement (m, model frame), for each number of components.

        The region models the displacement times its mask, so the mean divides by the mask's sum: where a vertex is
        shared among regions, each is asked for its share only.
        """
        wanted = (displacements[:, self.part.rows] * self.mask[:, None]).reshape(len(displacements), 3 * len(self.mask))
        flat = self.part.basis.reshape(len(self.part.basis), -1)
        right = flat @ wanted.T
        found = np.empty((len(displacements), len(components)))
        for column, count in enumerate(components):
            left = wanted - solve(self.part.gram[:count, :count], right[:count]).T @ flat[:count]
            distance = np.linalg.norm(left.reshape(len(left), len(self.mask), 3), axis=2)
            found[:, column] = distance.sum(1) / self.mask.sum() * MM_PER_M
        return found


def expression_parts(data: GNMData) -> dict[str, ExpressionPart]:
    """By region of the skin."""
    found = {}
    for region, (members, mask) in regions.expression_regions(data).items():
        rows = np.flatnonzero(mask > 0)
        basis = data.expression_basis[members][:, rows].astype(np.float64)
        part = LinearPart(rows=rows, rest=np.zeros((len(rows), 3)), basis=basis, triangles=_between(data, rows))
        found[region] = ExpressionPart(mask=mask[rows].astype(np.float64), part=part)
    return found


def variance_mm2(part: LinearPart) -> Float[np.ndarray, "K"]:
    """Compactness: the mean squared distance (mm^2) from rest that each component adds on the part, coefficients of
    unit variance. Components being independent, these add up whether or not they are orthogonal."""
    return np.diag(part.gram) / len(part.rows) * MM_PER_M**2
