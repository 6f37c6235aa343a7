"""Poses of the mean head from landmarks: scaled orthographic projection, linear."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_ROUNDS = 5  # of reweighting
MIN_VIEW_POINTS = 6  # landmarks of one view, for a pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Orthographic:
    """A head under scaled orthographic projection: pixel = scale * (rotation @ (point - centre))[:2] + position."""

    rotation: Float[np.ndarray, "3 3"]  # camera from model
    scale_px: float  # per metre
    position_px: Float[np.ndarray, "2"]  # of the centre
    residual_px: float  # median distance


def orthographic(
    points: Float[np.ndarray, "L 3"], pixels: Float[np.ndarray, "L 2"], centre: Float[np.ndarray, "3"]
) -> Orthographic | None:
    """Fit the pose of fixed points to their pixels; None if fewer than six are seen.

    Args:
        points: of the mean head, metres.
        pixels: NaN where not seen.
        centre: of the head, the point that the position is of.
    """
    seen = np.isfinite(pixels).all(1)
    if seen.sum() < MIN_VIEW_POINTS:
        return None
    X, u = points[seen] - centre, pixels[seen]
    rows = np.concatenate([X, np.ones((len(X), 1))], 1)
    weight = np.ones(len(X))
    ridge = np.diag([1e-6, 1e-6, 1e-6, 0]) * len(X) * (X**2).mean()
    for _ in range(_ROUNDS):
        affine = np.linalg.solve((rows * weight[:, None]).T @ rows + ridge, (rows * weight[:, None]).T @ u)
        distance = np.linalg.norm(rows @ affine - u, axis=1)
        weight = 1 / (1 + (distance / max(2 * np.median(distance), 1e-9)) ** 2)
    left, sizes, right = np.linalg.svd(affine[:3].T, full_matrices=False)
    plane = left @ right
    rotation = np.stack([plane[0], plane[1], np.cross(plane[0], plane[1])])
    scale = float(sizes.mean())
    fitted = scale * X @ rotation[:2].T
    position = np.median(u - fitted, axis=0)
    residual = float(np.median(np.linalg.norm(fitted + position - u, axis=1)))
    return Orthographic(rotation=rotation, scale_px=max(scale, 1e-9), position_px=position, residual_px=residual)


def placed(pose: Orthographic, focal_px: float, principal_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of the head and position of its centre in the camera's frame, metres."""
    depth = focal_px / pose.scale_px
    ray = np.append((pose.position_px - principal_px) / focal_px, 1.0)
    # The head looks turned by the direction in which it is seen.
    axis = np.cross([0, 0, 1.0], ray)
    angle = float(np.arctan2(np.linalg.norm(axis), ray[2]))
    turn = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle).as_matrix()
    return turn @ pose.rotation, depth * ray


def combined(
    rotations: Sequence[np.ndarray], rays: Sequence[tuple[np.ndarray, np.ndarray]], weights: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean rotation, and the point nearest to rays (origin, direction) of several views, world."""
    rotation = Rotation.from_matrix(np.stack(rotations)).mean(np.asarray(weights)).as_matrix()
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for (origin, direction), weight in zip(rays, weights, strict=True):
        unit = direction / np.linalg.norm(direction)
        across = weight * (np.eye(3) - np.outer(unit, unit))
        matrix += across
        right += across @ origin
    return rotation, np.linalg.solve(matrix, right)
