"""Points from the rays of posed views, and poses from points."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from registration.calibrate.bundle import Observations, Rig, project
from registration.frames import opencv_intrinsics

MIN_ANGLE = np.radians(2.0)  # between the widest two rays of a point
_ROUNDS = 6  # of reweighting
_PNP_ITERATIONS, _PNP_CONFIDENCE = 2000, 0.999


def triangulate(
    rig: Rig, observations: Observations, count: int, limit_px: float
) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, "P"]]:
    """Return the points nearest to their rays, reweighted against outliers.

    Args:
        rig: posed views.
        observations: of these views.
        count: of points.
        limit_px: reprojection error at which an observation weighs a half.

    Returns:
        The points (metres, world), and which of them are in front of two views at least, within twice the limit, with
        rays at `MIN_ANGLE`.
    """
    rays = _rays(rig, observations)
    centres = rig.positions[observations.view]
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    weight = np.ones(len(observations))
    points, error = np.zeros((count, 3)), np.zeros(len(observations))
    for _ in range(_ROUNDS):
        matrix = np.zeros((count, 3, 3))
        right = np.zeros((count, 3))
        weighted = across * weight[:, None, None]
        np.add.at(matrix, observations.point, weighted)
        np.add.at(right, observations.point, np.einsum("mij,mj->mi", weighted, centres))
        floor = 1e-9 * np.trace(matrix, axis1=1, axis2=2) + 1e-12
        points = np.linalg.solve(matrix + floor[:, None, None] * np.eye(3), right[..., None])[..., 0]
        offset = project(rig, points, observations.view, observations.point) - observations.xy_px
        error = np.where(np.isfinite(offset).all(1), np.linalg.norm(np.nan_to_num(offset), axis=1), np.inf)
        depth = np.linalg.norm(points[observations.point] - centres, axis=1)
        weight = 1 / (1 + np.minimum(error / limit_px, 1e3) ** 2) / np.maximum(depth, 1e-3) ** 2
    agrees = error < 2 * limit_px
    seen = np.bincount(observations.point[agrees], minlength=count)
    kept = observations.where(agrees)
    return points, (seen >= 2) & (_widest_angle(_rays(rig, kept), kept.point, count) > MIN_ANGLE)


def _rays(rig: Rig, observations: Observations) -> Float[np.ndarray, "M 3"]:
    """Unit directions through image positions, world; distortion is undone to first order, which is for a start."""
    view = observations.view
    plane = (observations.xy_px - rig.centres_px[view]) / rig.view_focals_px[view, None]
    plane = plane / (1 + rig.k1[rig.group[view]] * (plane**2).sum(1))[:, None]
    local = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    rays = np.einsum("mji,mj->mi", rig.rotations[view], local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _widest_angle(rays: np.ndarray, point: np.ndarray, count: int) -> Float[np.ndarray, "P"]:
    """About the widest angle of each point's rays: twice the widest angle from their mean, rad."""
    total = np.zeros((count, 3))
    np.add.at(total, point, rays)
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    angle = np.arccos(np.clip((rays * mean[point]).sum(1), -1, 1))
    widest = np.zeros(count)
    np.maximum.at(widest, point, angle)
    return 2 * widest


def pose(
    points: Float[np.ndarray, "M 3"],
    xy_px: Float[np.ndarray, "M 2"],
    intrinsics: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """Return rotation and translation, camera from world, that map points to pixels [Terzakis 2020], refined.

    Every point counts: for landmarks, whose errors are no outliers. None if there is no such pose.
    """
    K = opencv_intrinsics(intrinsics)
    pixels = np.ascontiguousarray(xy_px - 0.5)
    world = np.ascontiguousarray(points, np.float64)
    found, turn, shift = cv2.solvePnP(world, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return None
    turn, shift = cv2.solvePnPRefineLM(world, pixels, K, None, turn, shift)
    rotation, translation = cv2.Rodrigues(turn)[0], shift.ravel()
    depth = points @ rotation[2] + translation[2]
    return (rotation, translation) if (depth > 0).all() else None


def robust_pose(
    points: Float[np.ndarray, "M 3"],
    xy_px: Float[np.ndarray, "M 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    limit_px: float,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], Int[np.ndarray, "I"]] | None:
    """Return the pose that most of the points agree with, and which these are; None if there is none."""
    if len(points) < 6:
        return None
    K = opencv_intrinsics(intrinsics)
    pixels = np.ascontiguousarray(xy_px - 0.5)
    world = np.ascontiguousarray(points, np.float64)
    cv2.setRNGSeed(0)
    found, _, _, inliers = cv2.solvePnPRansac(
        world,
        pixels,
        K,
        None,
        iterationsCount=_PNP_ITERATIONS,
        reprojectionError=limit_px,
        confidence=_PNP_CONFIDENCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < 6:
        return None
    inliers = inliers.ravel().astype(np.int64)
    refined = pose(points[inliers], xy_px[inliers], intrinsics)
    return None if refined is None else (*refined, inliers)
