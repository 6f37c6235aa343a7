"""Points that masks show to be no part of the subject: a point of the subject lies inside every view's mask."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.pixels import read_mask
from registration.types import Camera, Capture, View

_MARGIN_M = 3e-3  # around masks: errors of masks and calibrations, and a surface that is a little too large
_VIEWS = 2  # whose masks must leave a point out: one may be wrong
_INSIDE = 128
_WIDE = 0.75  # of the image's size, from its centre, to where undistorted points are looked for


def outside_masks(capture: Capture, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    """Test which points lie clearly outside the masks of two views or more.

    Args:
        capture: its masks are decoded, one at a time. Where a point lies outside an image, that view says nothing.
        points: metres, world.

    Raises:
        InputError: a mask cannot be decoded.
    """
    votes = np.zeros(len(points), np.int32)
    for view in capture.views:
        if view.mask is not None:
            votes += _outside(view, points)
    return votes >= _VIEWS


def _outside(view: View, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    assert view.mask is not None
    camera = view.camera
    depth = points @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(divide="ignore", invalid="ignore"):
        straight = camera.project(points)[0]
        # Far beside the image the polynomial of a lens may lead back into it.
        rows = np.flatnonzero((depth > 0) & (np.abs(straight / size - 0.5) < _WIDE).all(1))
    outside = np.zeros(len(points), bool)
    if not len(rows):
        return outside
    column, row = np.floor(_distorted(camera, points[rows])).clip(-1, 2**20).astype(np.int64).T
    shown = (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    rows, column, row = rows[shown], column[shown], row[shown]
    away = cv2.distanceTransform((read_mask(view.mask, camera) < _INSIDE).astype(np.uint8), cv2.DIST_L2, 5)
    outside[rows] = away[row, column] * depth[rows] / camera.intrinsics[0, 0] > _MARGIN_M
    return outside


def _distorted(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """Pixels of points before the camera in the image as stored; NaN becomes a place outside it."""
    rotation, shift = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0], camera.T_cam_world[:3, 3]
    coefficients = np.array(camera.distortion) if camera.distortion else None
    pixels = cv2.projectPoints(points, rotation, shift, camera.intrinsics, coefficients)[0][:, 0]
    return np.nan_to_num(pixels, nan=-1.0)
