"""The head of a linear model nearest to a scan: surface to surface, for no vertex corresponds to a scan's point.

Squared distances of the scan's points from the surface are minimised over coefficients and rigid motion together (no
scale, no regulariser; [GNM, Generalization to Novel Shapes], stage 2). To first order a distance changes with the
surface along its own direction only, so a Levenberg-Marquardt step needs that one row per point; a step that does not
bring the points nearer is not taken. [GNM] runs 5,000 steps of Adam; here the end is where no step helps
any more, and is told.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.linear_fit import Fit, LinearPart, solve, twisted
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import motion_fields

_POINTS = 4000  # of the scan that a fit is made with; its figure is of all
_MOST_STEPS = 60
_SETTLED = 1e-4  # of the mean squared distance: a step that gains less is the last
_NOTHING = 1e-16  # m^2, mean squared distance of a scan that lies on the surface
_TOUCHING = 1e-7  # metres: nearer points have no direction, so the face's normal stands in
_DAMPING, _MOST_DAMPING = 1e-4, 1e6  # of the scaled normal equations, whose diagonal is one
_BATCH = 1000  # points whose rows of the Jacobian are held together


@dataclass(frozen=True, kw_only=True)
class _State:
    """A shape in its place, and where the points meet it."""

    coefficients: Float[np.ndarray, "k"]
    pose: Float[np.ndarray, "4 4"]  # T_model_world
    points: Float[np.ndarray, "P 3"]  # placed in the model's frame
    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]
    away: Float[np.ndarray, "P 3"]  # from the surface to the point
    direction: Float[np.ndarray, "P 3"]  # of `away`, unit

    @property
    def cost(self) -> float:
        return float((self.away**2).sum(1).mean())


def fit_scan(
    part: LinearPart,
    points: Float[np.ndarray, "N 3"],
    starts: Sequence[Fit],
    *,
    seed: int = 0,
) -> list[Fit]:
    """The nearest heads to a scan's points (m, any frame), from each start: what a fit in correspondence found.

    Only points that the model should explain are given: the face, say. A fit's `distance_mm` is of every point,
    unsigned, nothing dropped.
    """
    rng = np.random.default_rng(seed)
    chosen = points if len(points) <= _POINTS else points[np.sort(rng.choice(len(points), _POINTS, replace=False))]
    found = []
    for start in starts:
        state, converged = _nearest(part, chosen.astype(np.float64), start)
        shape = part.shape(state.coefficients)
        distance = closest_points(transform_points(state.pose, points.astype(np.float64)), shape, part.triangles)[0]
        found.append(
            Fit(
                coefficients=state.coefficients,
                T_model_world=state.pose,
                distance_mm=distance * MM_PER_M,
                converged=converged,
            )
        )
    return found


def _nearest(part: LinearPart, points: Float[np.ndarray, "P 3"], start: Fit) -> tuple[_State, bool]:
    state = _meet(part, points, start.coefficients, start.T_model_world)
    count, damping = len(start.coefficients), _DAMPING
    for _ in range(_MOST_STEPS):
        if state.cost < _NOTHING:
            return state, True
        matrix, right = _normal_equations(part, state)
        while True:
            damped = matrix + damping * np.diag(np.diag(matrix))
            step = solve(damped, right[:, None])[:, 0]
            pose = twisted(step[count:]) @ state.pose
            tried = _meet(part, points, state.coefficients + step[:count], pose)
            if tried.cost < state.cost:
                break
            damping *= 10
            if damping > _MOST_DAMPING:  # not even the shortest step downhill helps: this is the minimum
                return state, True
        gained, state, damping = 1 - tried.cost / state.cost, tried, damping / 10
        if gained < _SETTLED:
            return state, True
    return state, False


def _meet(
    part: LinearPart,
    points: Float[np.ndarray, "P 3"],
    coefficients: Float[np.ndarray, "k"],
    pose: Float[np.ndarray, "4 4"],
) -> _State:
    shape, placed = part.shape(coefficients), transform_points(pose, points)
    distance, face, barycentric = closest_points(placed, shape, part.triangles)
    away = placed - barycentric_points(shape, part.triangles, face, barycentric)
    a, b, c = (shape[part.triangles[face, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    direction = np.where(distance[:, None] > _TOUCHING, away / np.maximum(distance, _TOUCHING)[:, None], normal)
    return _State(
        coefficients=coefficients,
        pose=pose,
        points=placed,
        face=face,
        barycentric=barycentric,
        away=away,
        direction=direction,
    )


def _normal_equations(part: LinearPart, state: _State) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N"]]:
    """J'J and -J'r of the signed distances r along `direction`; N: coefficients, then the twist of the points."""
    count = len(state.coefficients)
    matrix, right = np.zeros((count + 6, count + 6)), np.zeros(count + 6)
    for first in range(0, len(state.points), _BATCH):
        part_of = slice(first, first + _BATCH)
        direction = state.direction[part_of]
        corners = part.basis[:count, part.triangles[state.face[part_of]]]
        moves = np.einsum("kpjc,pj,pc->kp", corners, state.barycentric[part_of], direction, optimize=True)
        turns = np.einsum("kpc,pc->kp", motion_fields(state.points[part_of]), direction)
        rows = np.concatenate([-moves, turns])
        matrix += rows @ rows.T
        right -= rows @ (state.away[part_of] * direction).sum(1)
    return matrix, right
