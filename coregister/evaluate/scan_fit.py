"""Best fit of a linear model to a scan, without correspondence (docs/algorithms.md, "Generalization").

Squared distances of the scan's points from the model's surface are minimized over coefficients and rigid motion
together, without scale and without regularization ([GNM, Generalization to Novel Shapes], stage 2). To first order a
distance changes only along its own direction, so that a Levenberg-Marquardt step [Marquardt 1963] needs one row per
point. [GNM] runs 5,000 steps of Adam; here iterations end when no step reduces the distances, and the result reports
whether they did.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.linear_fit import LinearFit, LinearPart, solve_normal_equations, twist_to_matrix
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import motion_fields
from registration.model import regions
from registration.model.gnm_npz import GNMData

_MAX_POINTS = 4000  # of the scan in the fit; distances are reported for all
_MAX_STEPS = 60
_MIN_GAIN = 1e-4  # of the mean squared distance: a step that gains less is the last
_EPSILON_M2 = 1e-16  # mean squared distance below which the scan lies on the surface
_TOUCHING_M = 1e-7  # nearer points have no direction; the face's normal replaces it
_INITIAL_DAMPING, _MAX_DAMPING = 1e-4, 1e6  # of the scaled normal equations, whose diagonal is one
_BATCH = 1000  # points whose rows of the Jacobian are held together


@dataclass(frozen=True, kw_only=True)
class _ScanFitState:
    """A shape, the aligned points, and their closest points on its surface."""

    coefficients: Float[np.ndarray, "k"]
    pose: Float[np.ndarray, "4 4"]  # T_model_world
    points: Float[np.ndarray, "P 3"]  # model frame
    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]
    residual: Float[np.ndarray, "P 3"]  # from the surface to the point
    direction: Float[np.ndarray, "P 3"]  # of the residual, unit

    @property
    def cost(self) -> float:
        return float((self.residual**2).sum(1).mean())


def fit_scan(
    part: LinearPart,
    points: Float[np.ndarray, "N 3"],
    initial: Sequence[LinearFit],
    *,
    seed: int = 0,
) -> list[LinearFit]:
    """Return the best fits to a scan's points, one from each initial guess.

    Args:
        part: the model.
        points: of the surface that the model should explain, such as the face; metres, any frame.
        initial: fits in correspondence, with as many coefficients as the result shall have.
        seed: of the choice of points, if there are more than 4,000.

    Returns:
        Fits whose `distance_mm` are unsigned distances of all points.
    """
    rng = np.random.default_rng(seed)
    subset = points
    if len(points) > _MAX_POINTS:
        subset = points[np.sort(rng.choice(len(points), _MAX_POINTS, replace=False))]
    fits = []
    for guess in initial:
        state, converged = _levenberg_marquardt(part, subset.astype(np.float64), guess)
        shape = part.shape(state.coefficients)
        distance = closest_points(transform_points(state.pose, points.astype(np.float64)), shape, part.triangles)[0]
        fits.append(
            LinearFit(
                coefficients=state.coefficients,
                T_model_world=state.pose,
                distance_mm=distance * MM_PER_M,
                converged=converged,
            )
        )
    return fits


def points_on_skin(
    points: Float[np.ndarray, "N 3"], mesh: Float[np.ndarray, "V 3"], data: GNMData
) -> Float[np.ndarray, "M 3"]:
    """Return a scan's points that are not on an eyeball, which the skin of a model does not explain.

    Decided on the subject's own mesh, so that all models explain the same points.

    Args:
        points: of the scan.
        mesh: the subject's, in the topology of `data`, in the same frame.
        data: a model.
    """
    mesh, points = mesh.astype(np.float64), points.astype(np.float64)
    exterior, balls = regions.exterior(data), np.any(regions.eyeball_shells(data), axis=0)
    distance = [
        closest_points(points, mesh, data.triangles[part[data.triangles].all(1)].astype(np.int64))[0]
        for part in (exterior, balls)
    ]
    return points[distance[0] <= distance[1]]


def _levenberg_marquardt(
    part: LinearPart, points: Float[np.ndarray, "P 3"], initial: LinearFit
) -> tuple[_ScanFitState, bool]:
    state = _evaluate_state(part, points, initial.coefficients, initial.T_model_world)
    count, damping = len(initial.coefficients), _INITIAL_DAMPING
    for _ in range(_MAX_STEPS):
        if state.cost < _EPSILON_M2:
            return state, True
        matrix, right = _normal_equations(part, state)
        while True:
            damped = matrix + damping * np.diag(np.diag(matrix))
            step = solve_normal_equations(damped, right[:, None])[:, 0]
            pose = twist_to_matrix(step[count:]) @ state.pose
            candidate = _evaluate_state(part, points, state.coefficients + step[:count], pose)
            if candidate.cost < state.cost:
                break
            damping *= 10
            if damping > _MAX_DAMPING:  # not even the shortest step downhill reduces the cost: this is the minimum
                return state, True
        gain, state, damping = 1 - candidate.cost / state.cost, candidate, damping / 10
        if gain < _MIN_GAIN:
            return state, True
    return state, False


def _evaluate_state(
    part: LinearPart,
    points: Float[np.ndarray, "P 3"],
    coefficients: Float[np.ndarray, "k"],
    pose: Float[np.ndarray, "4 4"],
) -> _ScanFitState:
    shape, aligned = part.shape(coefficients), transform_points(pose, points)
    distance, face, barycentric = closest_points(aligned, shape, part.triangles)
    residual = aligned - barycentric_points(shape, part.triangles, face, barycentric)
    a, b, c = (shape[part.triangles[face, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    direction = np.where(distance[:, None] > _TOUCHING_M, residual / np.maximum(distance, _TOUCHING_M)[:, None], normal)
    return _ScanFitState(
        coefficients=coefficients,
        pose=pose,
        points=aligned,
        face=face,
        barycentric=barycentric,
        residual=residual,
        direction=direction,
    )


def _normal_equations(
    part: LinearPart, state: _ScanFitState
) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N"]]:
    """J'J and -J'r of the signed distances r along `direction`; N: coefficients, then the twist of the points."""
    count = len(state.coefficients)
    matrix, right = np.zeros((count + 6, count + 6)), np.zeros(count + 6)
    for first in range(0, len(state.points), _BATCH):
        batch = slice(first, first + _BATCH)
        direction = state.direction[batch]
        corners = part.basis[:count, part.triangles[state.face[batch]]]
        shape_rows = np.einsum("kpjc,pj,pc->kp", corners, state.barycentric[batch], direction, optimize=True)
        motion_rows = np.einsum("kpc,pc->kp", motion_fields(state.points[batch]), direction)
        rows = np.concatenate([-shape_rows, motion_rows])
        matrix += rows @ rows.T
        right -= rows @ (state.residual[batch] * direction).sum(1)
    return matrix, right
