"""From the minimum of the energy to the model's parameters, cameras and standard deviations."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.landmark_fit.energy import Problem
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.reduction import Reduction
from registration.landmark_fit.result import LandmarkFit
from registration.landmark_fit.solver import Minimum
from registration.landmark_fit.state import Free, State
from registration.types import Camera, Status

_MAX_SIGMAS = 4.0  # median distance of the landmarks, in standard deviations
_MAX_RELATIVE = 0.02  # and of the face's size in the image: then the model is not where the landmarks are


def finished(
    minimum: Minimum,
    problem: Problem,
    free: Free,
    observations: Observations,
    reduction: Reduction,
    seconds: float,
) -> LandmarkFit:
    """Return the result of a fit.

    Args:
        minimum: of the energy.
        problem: the energy of the last stage.
        free: columns of the last stage.
        observations: that were fitted.
        reduction: of the expression coefficients.
        seconds: since the fit began.
    """
    state = minimum.state
    residual, weights, sigmas = _residuals(problem, state, observations)
    status, reason = _judged(minimum, residual, sigmas, observations)
    expression = reduction.mean + state.expression @ reduction.basis.T
    size = float(np.exp(state.log_size))
    rotations, translation = _model_poses(problem, state, size)
    covariances = _covariances(problem, state, free, reduction)
    return LandmarkFit(
        status=status,
        reason=reason,
        identity=state.identity,
        expression=expression,
        rotations=rotations,
        translation=translation,
        scale=size,
        cameras=_cameras(problem, state, observations),
        residual_px=residual,
        weights=weights,
        identity_covariance=covariances[0],
        expression_sigma=covariances[1],
        focal_sigma_px=covariances[2],
        shape_covariance=covariances[3],
        seconds=seconds,
        iterations=minimum.iterations,
        energy=minimum.energy,
        options=problem.options,
    )


def _model_poses(problem: Problem, state: State, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (axis-angle) and translations as the GNM function has them."""
    first = problem.model.joint_positions(state.identity)[0]
    joints, translation = state.joints.copy(), np.empty_like(state.position)
    for f, anchor in enumerate(state.joints[:, 0]):
        turn, shift = problem.model.root(state.identity, state.joints[f])
        joints[f, 0] = R = anchor @ turn.T
        # size * (anchor @ (turn.T @ (y - shift) - pivot)) + position = size * (R @ (y - first) + first) + translation
        moved = R @ (first - shift) - anchor @ problem.pivot - first
        translation[f] = size * moved + state.position[f]
    rotations = Rotation.from_matrix(joints.reshape(-1, 3, 3)).as_rotvec().reshape(len(joints), -1, 3)
    return rotations, translation


def _residuals(
    problem: Problem, state: State, observations: Observations
) -> tuple[Float[np.ndarray, "F N L 2"], Float[np.ndarray, "F N L"], Float[np.ndarray, "F N L"]]:
    """Residuals, weights, and distances in standard deviations."""
    residual: np.ndarray = np.full(observations.points_px.shape, np.nan)
    weights, sigmas = np.zeros(residual.shape[:-1]), np.full(residual.shape[:-1], np.nan)
    frames, views = residual.shape[:2]
    for f in range(frames):
        world = problem.world(state, f)
        for v in range(views):
            pixels, _ = problem.project(state, v, world)
            residual[f, v] = pixels - observations.points_px[f, v]
            rows = np.flatnonzero(np.isfinite(residual[f, v, :, 0]))
            squared = problem.squared(state, f, v, world, rows)
            weights[f, v, rows] = problem.weights(squared)
            sigmas[f, v, rows] = np.sqrt(squared)
    return residual, weights, sigmas


def _judged(
    minimum: Minimum, residual: np.ndarray, sigmas: np.ndarray, observations: Observations
) -> tuple[Status, str]:
    median = float(np.nanmedian(sigmas))
    px = float(np.nanmedian(np.linalg.norm(residual, axis=-1)))
    corners = observations.points_px
    extent = np.nanmax(corners, axis=-2) - np.nanmin(corners, axis=-2)
    size = float(np.nanmedian(np.linalg.norm(extent, axis=-1)))
    text = f"landmarks are {px:.2f} px off in the median, {median:.1f} standard deviations"
    if median > _MAX_SIGMAS and px > _MAX_RELATIVE * size:
        limit = f"limit {_MAX_SIGMAS:g} standard deviations or {_MAX_RELATIVE:.0%} of the face"
        return "failed", f"{text} ({limit}): they are not the model's, or wrong"
    if not minimum.converged:
        return "stopped", f"the energy still decreased after {minimum.iterations} iterations; {text}"
    return "converged", text


def _cameras(problem: Problem, state: State, observations: Observations) -> tuple[Camera, ...]:
    cameras = []
    for v, view in enumerate(observations.views):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = state.view_rotations[v], state.view_translations[v]
        focal, k1 = float(np.exp(state.log_focal[problem.group[v]])), float(state.k1[problem.group[v]])
        x, y = state.principal_px[v]
        K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1.0]])
        cameras.append(
            Camera(
                width_px=view.width_px,
                height_px=view.height_px,
                intrinsics=K,
                T_cam_world=T,
                distortion=() if k1 == 0 else (k1, 0.0, 0.0, 0.0),
            )
        )
    return tuple(cameras)


def _covariances(
    problem: Problem, state: State, free: Free, reduction: Reduction
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Of the identity; standard deviations of raw expression coefficients and focal lengths; of the first shape."""
    layout, options = problem.layout, problem.options
    frames, raw = len(state.expression), reduction.root.shape[0]
    identity = np.zeros((layout.identity, layout.identity))
    expression_sigma = np.full((frames, raw), np.nan)
    focal_sigma = np.zeros(len(problem.group))
    if not options.covariance:
        return np.full_like(identity, np.nan), expression_sigma, np.full_like(focal_sigma, np.nan), None
    shared, blocks = problem.system(state, free).covariances()
    position = {int(column): k for k, column in enumerate(free.shared)}
    of_identity = [position[c] for c in range(layout.identity) if c in position]
    if of_identity:
        identity = shared[np.ix_(of_identity, of_identity)]
    for v, group in enumerate(problem.group):
        k = position.get(layout.shared("focal").start + int(group))
        if k is not None:
            focal_sigma[v] = np.exp(state.log_focal[group]) * np.sqrt(max(shared[k, k], 0))
    own = [k for k, column in enumerate(free.local) if column < layout.expression]
    basis = reduction.basis
    # Directions that no landmark moves keep the prior's variance.
    unseen = reduction.root @ reduction.root.T - basis @ basis.T
    shape = None
    for f, (local, mixed) in zip(reversed(range(frames)), blocks, strict=True):
        of_expression = local[np.ix_(own, own)]
        expression_sigma[f] = np.sqrt(np.maximum(np.diag(unseen) + ((basis @ of_expression) * basis).sum(1), 0))
        if f == 0:
            both = basis @ mixed[np.ix_(own, of_identity)] if of_identity else np.zeros((raw, layout.identity))
            shape = np.block([[identity, both.T], [both, unseen + basis @ of_expression @ basis.T]])
    return identity, expression_sigma, focal_sigma, shape
