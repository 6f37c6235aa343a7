"""Size and pose of the head in a world without a unit: the head model fitted to triangulated landmarks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.geometry.rigid import similarity_transform
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme

DEFAULT_SPREAD_M = 3e-3  # of a landmark whose map states none
EXPRESSION_SIGMA = 0.5  # standard deviation of expression coefficients; that of identity coefficients is 1
# Relative standard deviation of people's faces about the size that the fit makes of their shape, measured on twelve
# people of another head model (4.7 %). The coefficients' covariance alone states 1.3 %.
SIZE_SIGMA = 0.045
_ALIKE = 10.0  # neighbouring landmarks err alike: so many count as one
_CAUCHY = 2.0  # standard deviations at which a landmark's weight is halved
_ITERATIONS = 12
_SIMILARITY = 7  # logarithm of the scale, rotation, translation


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFit:
    """A similarity transform of the world to the model's frame, and the model's landmarks there."""

    scale: float  # metres of the model per unit of the world
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    landmarks: Float[np.ndarray, "L 3"]  # of the fitted model, metres, model frame
    distance_m: Float[np.ndarray, "L"]  # of the transformed points from them; NaN where there is no point
    scale_sigma: float  # standard deviation of the scale, relative


def fit_model(
    data: GNMData, scheme: LandmarkScheme, points: Float[np.ndarray, "L 3"], *, fixed_shape: bool = False
) -> ModelFit:
    """Fit scale, pose, identity and expression of the model to points by Gauss-Newton.

    Minimizes the sum of the squared distances over the landmarks' variances, with coefficients distributed as in the
    model's population: what is size and what is shape is decided by what is more likely there.

    Args:
        data: the model.
        scheme: of the model.
        points: triangulated landmarks, in the world's unit; NaN where there is none, eight at least.
        fixed_shape: the mean head only.
    """
    mean = scheme.points(data.template_vertex_positions.astype(np.float64))
    identity = scheme.points(data.vertex_identity_basis.astype(np.float64))
    expression = scheme.points(data.expression_basis.astype(np.float64)) * EXPRESSION_SIGMA
    basis = np.concatenate([identity, expression])[: 0 if fixed_shape else None]
    spread = np.full(len(mean), DEFAULT_SPREAD_M) if scheme.spread_m is None else scheme.spread_m
    used = np.flatnonzero(np.isfinite(points).all(1))
    sigma = spread[used] * np.sqrt(_ALIKE)
    scale, rotation, shift = similarity_transform(points[used], mean[used], free_scale=True)
    coefficients = np.zeros(len(basis))
    covariance = np.eye(_SIMILARITY)
    for _ in range(_ITERATIONS):
        fitted = mean[used] + np.tensordot(coefficients, basis[:, used], 1)
        moved = scale * points[used] @ rotation.T
        residual = moved + shift - fitted
        # Weighted by distances in units of the spread itself: neighbours that err alike make no outliers.
        weight = 1 / (1 + (residual**2).sum(1) / (_CAUCHY * spread[used]) ** 2) / sigma**2
        jacobian = np.zeros((len(used), 3, _SIMILARITY + len(basis)))
        jacobian[:, :, 0] = moved
        jacobian[:, :, 1:4] = -_cross(moved)
        jacobian[:, :, 4:7] = np.eye(3)
        jacobian[:, :, 7:] = -basis[:, used].transpose(1, 2, 0)
        rows = jacobian.reshape(-1, jacobian.shape[2])
        weighted = rows * np.repeat(weight, 3)[:, None]
        normal = weighted.T @ rows
        prior = np.arange(_SIMILARITY, len(normal))
        normal[prior, prior] += 1.0
        right = weighted.T @ residual.ravel()
        right[_SIMILARITY:] += coefficients
        step = -np.linalg.solve(normal, right)
        scale *= float(np.exp(np.clip(step[0], -0.3, 0.3)))
        rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ rotation
        shift = shift + step[4:7]
        coefficients = coefficients + step[7:]
        covariance = np.linalg.inv(normal)
    landmarks = mean + np.tensordot(coefficients, basis, 1)
    distance = np.linalg.norm(scale * points @ rotation.T + shift - landmarks, axis=1)
    return ModelFit(
        scale=scale,
        rotation=rotation,
        shift=shift,
        landmarks=landmarks,
        distance_m=distance,
        scale_sigma=float(np.hypot(np.sqrt(covariance[0, 0]), SIZE_SIGMA)),
    )


def _cross(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3 3"]:
    """The matrices [v]x with [v]x w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
