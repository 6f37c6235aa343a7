"""Best fit of a linear model to a mesh in correspondence (docs/algorithms.md, "Generalization").

Coefficients and rigid motion together are a small least-squares problem, solved by Gauss-Newton steps to convergence,
without regularization. Bases are not orthogonal, neither across regions nor on a part of the mesh, so that every
projection solves normal equations. [GNM, Generalization to Novel Shapes] runs Adam for 5,000 steps to the same minimum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import align, motion_fields
from registration.model import regions
from registration.model.gnm_npz import GNMData

_TOLERANCE_M = 1e-9  # maximum motion of a vertex in the last step
_MAX_STEPS = 60
_EPSILON = 1e-24  # of the largest: square sums of columns below it are rounding, which scaling would amplify
_MIN_EIGENVALUE = 1e-10  # of the largest, columns scaled to one: directions below it are undetermined


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearPart:
    """A linear model on some of its vertices: rest + coefficients @ basis. Metres, model frame, float64."""

    rows: Int[np.ndarray, "P"]  # of the model's vertices
    rest: Float[np.ndarray, "P 3"]
    basis: Float[np.ndarray, "K P 3"]
    triangles: Int[np.ndarray, "F 3"]  # between the part's own vertices
    weights: Float[np.ndarray, "P"] | None = None  # of squared distances in a fit, mean 1; None: all equal

    @cached_property
    def scale(self) -> Float[np.ndarray, "P 1"]:
        """Square roots of the weights."""
        return np.ones((len(self.rows), 1)) if self.weights is None else np.sqrt(self.weights)[:, None]

    @cached_property
    def gram(self) -> Float[np.ndarray, "K K"]:
        """Weighted products of the components."""
        flat = (self.basis * self.scale).reshape(len(self.basis), -1)
        return flat @ flat.T

    def mean(self, values: Float[np.ndarray, "P"]) -> float:
        """Return the weighted mean over the vertices."""
        return float(np.average(values, weights=self.weights))

    def shape(self, coefficients: Float[np.ndarray, "k"]) -> Float[np.ndarray, "P 3"]:
        """Return the vertices for coefficients of the first k components, metres."""
        return self.rest + np.tensordot(coefficients, self.basis[: len(coefficients)], 1)


@dataclass(frozen=True, kw_only=True)
class LinearFit:
    """A model's best fit to a target, with the first `len(coefficients)` components."""

    coefficients: Float[np.ndarray, "k"]
    T_model_world: Float[np.ndarray, "4 4"]  # aligns the target with the model
    distance_mm: Float[np.ndarray, "P"]  # of each vertex, or each point of a scan
    converged: bool


def identity_part(data: GNMData, rows: Bool[np.ndarray, "V"] | None = None) -> LinearPart:
    """Return the identity components that move the skin; not those of eyeballs or teeth alone.

    Args:
        data: the model.
        rows: vertices of the part; None: the head's skin.
    """
    return _part(data, regions.head_skin(data) if rows is None else rows, data.vertex_identity_basis)


def whole_part(data: GNMData) -> LinearPart:
    """Return identity and expression together on the head's skin, as in [GNM, Generalization to Novel Shapes]."""
    return _part(data, regions.head_skin(data), data.vertex_identity_basis, data.expression_basis)


def _part(data: GNMData, members: Bool[np.ndarray, "V"], *bases: Float[np.ndarray, "_ V 3"]) -> LinearPart:
    rows, skin = np.flatnonzero(members), regions.exterior(data)
    moving = [basis[np.abs(basis[:, skin]).max((1, 2), initial=0) > 0][:, rows] for basis in bases]
    return LinearPart(
        rows=rows,
        rest=data.template_vertex_positions[rows].astype(np.float64),
        basis=np.concatenate(moving).astype(np.float64),
        triangles=_part_triangles(data, rows),
    )


def _part_triangles(data: GNMData, rows: Int[np.ndarray, "P"]) -> Int[np.ndarray, "F 3"]:
    """The triangles whose corners are all among these vertices, as indices into them."""
    index = np.full(len(data.template_vertex_positions), -1)
    index[rows] = np.arange(len(rows))
    triangles = index[data.triangles]
    return triangles[(triangles >= 0).all(1)]


def fit_correspondence(
    part: LinearPart, target: Float[np.ndarray, "P 3"], components: Sequence[int]
) -> list[LinearFit]:
    """Return the best fits to a mesh in correspondence, one for each number of components.

    Each fit starts from the one before. Of undetermined coefficients the solution with the least norm is taken.

    Args:
        part: the model.
        target: the part's vertices, metres, any frame; not scaled.
        components: numbers of components, increasing.
    """
    target = np.asarray(target, np.float64)
    pose = align(target[None], part.rest, part.scale.T**2)[0]
    coefficients = np.zeros(0)
    fits: list[LinearFit] = []
    for count in components:
        coefficients = np.concatenate([coefficients, np.zeros(count - len(coefficients))])
        fits.append(_gauss_newton(part, target, coefficients, pose))
        coefficients, pose = fits[-1].coefficients, fits[-1].T_model_world
    return fits


def _gauss_newton(
    part: LinearPart,
    target: Float[np.ndarray, "P 3"],
    coefficients: Float[np.ndarray, "k"],
    pose: Float[np.ndarray, "4 4"],
) -> LinearFit:
    count, converged = len(coefficients), False
    flat = (part.basis[:count] * part.scale).reshape(count, -1)
    shape, aligned = part.shape(coefficients), transform_points(pose, target)
    for _ in range(_MAX_STEPS):
        residual = ((aligned - shape) * part.scale).ravel()
        fields = (motion_fields(aligned) * part.scale).reshape(6, -1)
        cross = -flat @ fields.T
        matrix = np.block([[part.gram[:count, :count], cross], [cross.T, fields @ fields.T]])
        step = solve_normal_equations(matrix, np.concatenate([flat @ residual, -fields @ residual])[:, None])[:, 0]
        coefficients = coefficients + step[:count]
        pose = twist_to_matrix(step[count:]) @ pose
        new_shape, new_aligned = part.shape(coefficients), transform_points(pose, target)
        change = max(np.abs(new_shape - shape).max(initial=0), np.abs(new_aligned - aligned).max())
        shape, aligned = new_shape, new_aligned
        if change < _TOLERANCE_M:
            converged = True
            break
    distance = np.linalg.norm(aligned - shape, axis=1) * MM_PER_M
    return LinearFit(coefficients=coefficients, T_model_world=pose, distance_mm=distance, converged=converged)


def solve_normal_equations(
    matrix: Float[np.ndarray, "N N"], right: Float[np.ndarray, "N S"]
) -> Float[np.ndarray, "N S"]:
    """Return the solution with the least norm, columns scaled to one.

    Args:
        matrix: J'J, possibly singular.
        right: S right-hand sides J'r.
    """
    return np.asarray(pseudo_inverse(matrix) @ right)


def pseudo_inverse(matrix: Float[np.ndarray, "N N"]) -> Float[np.ndarray, "N N"]:
    """Return the inverse of J'J that gives the solution with the least norm, columns scaled to one."""
    squares = np.diag(matrix)
    scale = np.sqrt(np.where(squares > _EPSILON * squares.max(initial=0), squares, np.inf))[:, None]
    inverse = np.linalg.pinv(matrix / (scale * scale.T), rcond=_MIN_EIGENVALUE, hermitian=True)
    return np.asarray(inverse / (scale * scale.T))


def twist_to_matrix(twist: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Return the rigid motion (w, t): a rotation by w, radians, about the origin, then a translation by t, metres."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    motion[:3, 3] = twist[3:]
    return motion


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpressionPart:
    """One region's expression components on its soft mask; without the teeth that move with the lower face."""

    mask: Float[np.ndarray, "P"]
    part: LinearPart  # rest: zeros

    def errors_mm(
        self, displacements: Float[np.ndarray, "S V 3"], components: Sequence[int]
    ) -> Float[np.ndarray, "S k"]:
        """Return the mean distance of the region's best fit from each displacement, for each number of components.

        The region models the displacement times its mask. The mean therefore divides by the sum of the mask: a vertex
        that belongs to several regions counts in each by its fraction.

        Args:
            displacements: expressions minus neutrals, metres, model frame.
            components: numbers of components.
        """
        target = (displacements[:, self.part.rows] * self.mask[:, None]).reshape(len(displacements), 3 * len(self.mask))
        flat = self.part.basis.reshape(len(self.part.basis), -1)
        right = flat @ target.T
        errors = np.empty((len(displacements), len(components)))
        for column, count in enumerate(components):
            coefficients = solve_normal_equations(self.part.gram[:count, :count], right[:count]).T
            residual = target - coefficients @ flat[:count]
            distance = np.linalg.norm(residual.reshape(len(residual), len(self.mask), 3), axis=2)
            errors[:, column] = distance.sum(1) / self.mask.sum() * MM_PER_M
        return errors


def expression_parts(data: GNMData) -> dict[str, ExpressionPart]:
    """Return the model's expression components by region, on the outer skin of the face.

    Masks of files also cover neck, chest, scalp and the inside of eye sockets and mouth, where hardly anything moves or
    nothing is seen: they would dilute a mean.
    """
    parts, face = {}, regions.face(data)
    for region, (members, mask) in regions.expression_regions(data).items():
        rows = np.flatnonzero((mask > 0) & face)
        basis = data.expression_basis[members][:, rows].astype(np.float64)
        rest = np.zeros((len(rows), 3))
        part = LinearPart(rows=rows, rest=rest, basis=basis, triangles=_part_triangles(data, rows))
        parts[region] = ExpressionPart(mask=mask[rows].astype(np.float64), part=part)
    return parts


def variance_mm2(part: LinearPart) -> Float[np.ndarray, "K"]:
    """Return the mean squared distance from rest that each component adds on the part, mm^2: compactness.

    For independent coefficients of unit variance, whose contributions add up even if components are not orthogonal.
    """
    return np.diag(part.gram) / len(part.rows) * MM_PER_M**2
