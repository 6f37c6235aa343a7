"""Checks of the solver on in-model heads: exactness, calibrated uncertainty, linear algebra, more frames."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bench.landmark_fits.heads import Head, HeadModel
from bench.landmark_fits.pictures import cameras_around, observe
from bench.landmark_fits.rows import Row, at_most, between
from registration.landmark_fit import linear_system
from registration.landmark_fit.fit import fit_landmarks, fit_many
from registration.landmark_fit.linear_system import ArrowSystem
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions, TemporalPrior
from registration.landmark_fit.result import LandmarkFit

_TWO_SIDED_90 = 1.6449  # standard deviations
_EXACT_PX = 1e-5
_EXACT_POINTS = 3000


def centre(model: HeadModel) -> Float[np.ndarray, "3"]:
    """The middle of the template's face."""
    return model.template[model.face].mean(0)


def exact(model: HeadModel, count: int) -> list[Row]:
    """Noiseless landmarks in three views of known cameras: what the model itself made comes back."""
    rng = np.random.default_rng(1)
    scheme = model.vertex_scheme(rng.choice(len(model.template), _EXACT_POINTS, replace=False), "exact")
    cameras = cameras_around(centre(model), 3)
    options = FitOptions(
        expression_sigma=model.expression_sigma,
        robust=False,
        covariance=False,
        anatomy=0,
        tolerance=1e-12,
        max_iterations=60,
    )
    largest, seconds, iterations = [], [], []
    for _ in range(count):
        truth = model.vertices(model.sample(rng))
        fit = fit_landmarks(observe(scheme, [truth], cameras, sigma_px=_EXACT_PX, known=True), model.data, options)
        error = np.linalg.norm(model.posed(fit.parameters(0)) - truth, axis=1)
        largest.append(1e3 * error.max())
        seconds.append(fit.seconds)
        iterations.append(fit.iterations)
    rows = [at_most(f"{model.name}: largest vertex error, {count} heads, 3 views", max(largest), 1e-3, "mm")]
    rows.append(Row(what="iterations, seconds", measured=f"{np.mean(iterations):.0f}, {np.mean(seconds):.1f}"))
    return rows


def coverage(model: HeadModel, count: int, points: int = 600) -> list[Row]:
    """One pixel of noise: how often 90 % intervals contain the truth."""
    rng = np.random.default_rng(2)
    scheme = model.face_scheme(points)
    cameras = cameras_around(centre(model), 3)
    options = FitOptions(expression_sigma=model.expression_sigma, robust=False, anatomy=0)
    inside: dict[str, list[float]] = {"identity coefficients": [], "expression coefficients": [], "vertices": []}
    spread: list[float] = []
    heads = [model.sample(rng) for _ in range(count)]
    batch = (observe(scheme, [model.vertices(head)], cameras, sigma_px=1.0, known=True, noise=rng) for head in heads)
    for head, fit in zip(heads, fit_many(batch, model.data, options), strict=True):
        sigma = np.sqrt(np.diag(fit.identity_covariance))
        inside["identity coefficients"].append(_within(fit.identity - head.identity, sigma))
        inside["expression coefficients"].append(_within(fit.expression[0] - head.expression, fit.expression_sigma[0]))
        error, sigma = _shape_error(model, fit, head)
        inside["vertices"].append(_within(error[model.face], sigma[model.face]))
        spread.append(1e3 * float(np.linalg.norm(sigma[model.face], axis=1).mean()))
    rows = [
        between(f"{model.name}: 90 % intervals contain the truth, {name}", 100 * float(np.mean(share)), 85, 95, "%")
        for name, share in inside.items()
    ]
    return [*rows, Row(what="posterior standard deviation of the face", measured=f"{np.mean(spread):.2f} mm")]


def _within(error: np.ndarray, sigma: np.ndarray) -> float:
    return float((np.abs(error) <= _TWO_SIDED_90 * sigma).mean())


def _shape_error(model: HeadModel, fit: LandmarkFit, head: Head) -> tuple[np.ndarray, np.ndarray]:
    """Error of the shape in the head's frame, and its standard deviation, along the first camera's axes, metres."""
    axes = fit.cameras[0].T_cam_world[:3, :3] @ Rotation.from_rotvec(fit.rotations[0, 0]).as_matrix()
    error = model.shape(fit.identity - head.identity, fit.expression[0] - head.expression) @ axes.T
    return error, fit.vertex_sigma_m(model.data)


def schur(model: HeadModel, frames: int) -> list[Row]:
    """Every step of a fit by the eliminated system, against the dense one; with a temporal prior and without."""
    rng = np.random.default_rng(3)
    scheme = model.face_scheme(300)
    observations = _sequence(model, scheme, frames, 2, rng)
    rows = []
    for name, temporal in (("independent frames", None), ("temporal prior", TemporalPrior())):
        options = FitOptions(expression_sigma=model.expression_sigma, temporal=temporal, covariance=False, anatomy=0)
        differences: list[float] = []

        def compared(
            system: ArrowSystem, damping: float, step=ArrowSystem.step, differences: list[float] = differences
        ) -> tuple[np.ndarray, np.ndarray]:
            local, shared = step(system, damping)
            differences.append(_disagreement(system, damping, np.concatenate([local.ravel(), shared])))
            return local, shared

        with patch.object(ArrowSystem, "step", compared):
            fit_landmarks(observations, model.data, options)
        label = f"{model.name}: Schur against dense, {len(differences)} steps, {name}"
        rows.append(at_most(label, max(differences), 1e-8, "relative"))
    return rows


def _sequence(model: HeadModel, scheme, frames: int, views: int, rng: np.random.Generator) -> Observations:  # type: ignore[no-untyped-def]
    identity = model.sample(rng).identity
    heads = [model.sample(rng) for _ in range(frames)]
    meshes = [
        model.vertices(
            Head(identity=identity, expression=h.expression, rotations=h.rotations, translation=h.translation)
        )
        for h in heads
    ]
    return observe(scheme, meshes, cameras_around(centre(model), views), sigma_px=1.0, known=False, noise=rng)


def _disagreement(system: ArrowSystem, damping: float, step: Float[np.ndarray, "K"]) -> float:
    """Relative difference from the dense step, in units in which the matrix has a unit diagonal."""
    # The floor of the diagonal is part of the matrix that is solved.
    damped = replace(
        system,
        local=np.stack([linear_system._damped(block, damping * system.local_scale) for block in system.local]),
        shared=linear_system._damped(system.shared, damping * system.shared_scale),
    )
    matrix, gradient = damped.dense()
    scale = 1 / np.sqrt(np.diag(matrix))
    dense = -np.linalg.solve(matrix * scale[:, None] * scale, scale * gradient)
    return float(np.linalg.norm(step / scale - dense) / np.linalg.norm(dense))


def frames(model: HeadModel, count: int, more: int = 10) -> list[Row]:
    """The identity of one frame against that of several: the change in standard deviations of the former."""
    rng = np.random.default_rng(4)
    scheme = model.face_scheme(600)
    options = FitOptions(expression_sigma=model.expression_sigma, anatomy=0)
    moved, one_error, more_error = [], [], []
    for seed in range(count):
        rng = np.random.default_rng([4, seed])
        observations = _sequence(model, scheme, more, 1, rng)
        identity = model.sample(np.random.default_rng([4, seed])).identity
        one = fit_landmarks(observations.frames([0]), model.data, options)
        several = fit_landmarks(observations, model.data, options)
        change = several.identity - one.identity
        moved.append(change @ np.linalg.solve(one.identity_covariance, change) / len(change))
        one_error.append(one.identity - identity)
        more_error.append(several.identity - identity)
    label = f"{model.name}: change of the identity from 1 to {more} frames, rms of its standard deviations"
    return [
        at_most(label, float(np.sqrt(np.mean(moved))), 1.0, ""),
        Row(
            what=f"rms error of identity coefficients, 1 and {more} frames",
            measured=f"{np.std(one_error):.2f}, {np.std(more_error):.2f}",
        ),
    ]
