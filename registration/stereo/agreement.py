"""Depths of several views compared and joined: what one view found is moved to the mean of what all found there."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.stereo.local_planes import fit_planes
from registration.stereo.views import rays, relative_pose
from registration.types import Camera

_SAME_SIGMAS, _SAME_M = 3.0, 3e-4  # depths that differ by less, in standard deviations and beside them, agree
_OTHER_M = 4e-3  # depths that differ by more are of another surface: one hides the other
_NORMAL_PX = 2.0  # of the window in which the planes of the comparison are fitted
_LEAST_COSINE = 0.2  # of incidence in the other view


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What one view found alone."""

    camera: Camera
    depth: Float[np.ndarray, "h w"]  # metres; 0 where there is none
    sigma: Float[np.ndarray, "h w"]  # standard deviation of the depths, metres


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """What one view has when others have had their say."""

    depth: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]  # of the mean; differences between the views count
    agreeing: Float[np.ndarray, "h w"]  # number of other views whose depths agree
    compared: Float[np.ndarray, "h w"]  # number of other views that have a depth of the same surface there


def join(view: int, near: Sequence[int], measured: Sequence[Measured]) -> Joined:
    """Average a view's depths with those of others, weighted by their variances.

    Args:
        view: index of the view.
        near: indices of the other views.
        measured: of all views.
    """
    own = measured[view]
    ray = rays(own.camera)
    _, normals = fit_planes(own.depth, (own.depth > 0).astype(np.float32), ray, _NORMAL_PX)
    known = (own.depth > 0) & normals.any(-1)
    rows = np.nonzero(known)
    depth, along, normal = own.depth[rows], ray[rows], normals[rows]
    points = along * depth[:, None]
    slope = (normal * along).sum(-1)
    variance = np.maximum(own.sigma[rows], 1e-6) ** 2
    total, moved, squares = 1 / variance, np.zeros_like(depth), np.zeros_like(depth)
    agreeing, compared = np.zeros_like(depth), np.zeros_like(depth)
    for other in near:
        target, sigma, usable = _surface_in(points, normal, own.camera, measured[other])
        # Along the own ray to the plane through the other's point.
        offset = np.where(usable, (normal * (target - points)).sum(-1) / np.minimum(slope, -0.05), 0)
        usable &= np.abs(offset) < _OTHER_M
        same = usable & (np.abs(offset) < _SAME_M + _SAME_SIGMAS * np.sqrt(variance + sigma**2))
        weight = np.where(same, 1 / np.maximum(sigma, 1e-6) ** 2, 0)
        total += weight
        moved += weight * offset
        squares += weight * offset**2
        agreeing += same
        compared += usable
    mean = moved / total
    spread = np.maximum(squares / total - mean**2, 0)
    # Views share photographs: their errors are not independent, and averaging helps less than their number says.
    joined_sigma = np.sqrt(1 / total + spread / (1 + agreeing))

    def image(values: np.ndarray) -> np.ndarray:
        result = np.zeros(own.depth.shape, np.float32)
        result[rows] = values
        return result

    return Joined(
        depth=image(depth + mean), sigma=image(joined_sigma), agreeing=image(agreeing), compared=image(compared)
    )


def _surface_in(
    points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], camera: Camera, other: Measured
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P"], Bool[np.ndarray, "P"]]:
    """The points that another view has where points project, in the first frame; their deviations; which there are."""
    rotation, shift = (values.astype(np.float32) for values in relative_pose(camera, other.camera))
    local = points @ rotation.T + shift
    z = np.maximum(local[:, 2], 1e-6)
    intrinsics = other.camera.intrinsics.astype(np.float32)
    pixels = local @ intrinsics.T / z[:, None] - np.float32(0.5)
    x, y = pixels[None, :, 0], pixels[None, :, 1]
    known = (other.depth > 0).astype(np.float32)
    share, value, sigma = (
        _at(values, x, y) for values in (known, other.depth, np.where(known > 0, other.sigma, 0).astype(np.float32))
    )
    facing = -(normals @ rotation.T * local).sum(-1) > _LEAST_COSINE * np.linalg.norm(local, axis=-1)
    usable = (share > 0.99) & (local[:, 2] > 0) & facing
    found = local * (value / z)[:, None]
    return (found - shift) @ rotation, np.where(usable, sigma, 1), usable


def _at(values: Float[np.ndarray, "h w"], x: Float[np.ndarray, "1 P"], y: Float[np.ndarray, "1 P"]) -> np.ndarray:
    """Bilinear values at pixels; OpenCV's images have at most 32767 columns, so that long lists are folded."""
    count = x.shape[1]
    width = 4096
    padded = max(1, -(-count // width)) * width
    across, down = (np.pad(axis[0], (0, padded - count)).reshape(-1, width).astype(np.float32) for axis in (x, y))
    return cv2.remap(values, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT).ravel()[:count]
