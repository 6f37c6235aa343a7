"""Scans that were moved by centimetres, which shows against landmarks, or else against the outlines of the masks."""

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from registration.capture import pixels
from registration.capture.scan import Scan
from registration.doctor.findings import Finding
from registration.doctor.scan_frame import FEW_SAMPLES, MAX_DISTANCE_M, evenly_spaced
from registration.frames import MM_PER_M
from registration.types import Camera, Capture

_MIN_MOVE_M = 5e-3  # of a scan that is said to have moved
_CLEARLY = 0.4  # of the distance as it is: what is left when the scan is moved back
_LEFT_M = 5e-3  # most that may be left
_STEPS = 40
_VIEWS = 6
_SIDE = 240  # cells of the longer side of a coarse mask
_OUTSIDE_M = 1.5e-3  # root of the mean square distance of a scan from the masks' inside, as noise


def moved_from_landmarks(
    scan: Scan, tree: cKDTree, points: Float[np.ndarray, "P 3"], distance_m: float
) -> list[Finding]:
    """A warning if landmarks lie on the scan once it is moved, or if they are far from it anyway.

    Args:
        scan: of the capture.
        tree: of its vertices.
        points: landmarks, m, world.
        distance_m: their median distance from the scan.
    """
    before = float(np.median(tree.query(points)[0]))
    move, after = _fitted_move(tree, scan.vertices, points)
    length = float(np.linalg.norm(move))
    if length > _MIN_MOVE_M and after < min(_CLEARLY * before, _LEFT_M):
        return [
            _moved(move, f"its landmarks are then {MM_PER_M * after:.1f} mm from it, {MM_PER_M * before:.1f} mm now")
        ]
    if distance_m > MAX_DISTANCE_M:
        line = f"the scan is {MM_PER_M * distance_m:.0f} mm from the landmarks; check its frame and unit"
        return [Finding.warning("scan-elsewhere", line)]
    return []


def _moved(move: Float[np.ndarray, "3"], evidence: str) -> Finding:
    x, y, z = MM_PER_M * move
    line = (
        f"the scan fits if it is moved by ({x:.0f}, {y:.0f}, {z:.0f}) mm: {evidence}; export it in the world of the "
        "cameras: check its frame and unit"
    )
    return Finding.warning("scan-moved", line)


def _fitted_move(
    tree: cKDTree, vertices: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The translation of the scan (m) that brings it to landmarks, from several starts, and their median distance."""
    best, move = np.inf, np.zeros(3)
    centre = np.median(points, axis=0) - np.median(vertices, axis=0)
    starts = [np.zeros(3), *(sign * 0.03 * axis for axis in np.eye(3) for sign in (1, -1)), centre]
    for start in starts:
        shift = start
        for _ in range(_STEPS):
            distance, nearest = tree.query(points - shift)
            away = points - shift - vertices[nearest]
            kept = distance <= np.quantile(distance, 0.8)
            step = away[kept].mean(0)
            shift = shift + step
            if np.linalg.norm(step) < 1e-5:
                break
        after = float(np.median(tree.query(points - shift)[0]))
        if after < 0.98 * best:
            best, move = after, shift
    return move, best


def moved_from_masks(capture: Capture, scan: Scan) -> list[Finding]:
    """A warning if the scan lies partly outside the masks, and inside them once it is moved."""
    views = evenly_spaced([view for view in capture.views if view.mask is not None], _VIEWS)
    if len(views) < 2:
        return []
    fields = [_outside_px(pixels.read_mask(view.mask, view.camera)) for view in views if view.mask is not None]
    sample = scan.vertices[:: -(-len(scan.vertices) // FEW_SAMPLES)]
    cameras = [view.camera for view in views]

    def outside_m(move: Float[np.ndarray, "3"]) -> Float[np.ndarray, "D"]:
        return np.concatenate([_outside_m(c, f, sample + move) for c, f in zip(cameras, fields, strict=True)])

    before = _rms(outside_m(np.zeros(3)))
    if before < 2 * _OUTSIDE_M:
        return []
    fitted = least_squares(outside_m, np.zeros(3), diff_step=1e-3, x_scale=0.01, loss="soft_l1", f_scale=5e-3)
    after = _rms(outside_m(fitted.x))
    if np.linalg.norm(fitted.x) > _MIN_MOVE_M and after < _CLEARLY * before:
        return [
            _moved(fitted.x, f"it is then {MM_PER_M * after:.1f} mm outside the masks, {MM_PER_M * before:.1f} mm now")
        ]
    return []


def _rms(values: Float[np.ndarray, "D"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _outside_px(mask: np.ndarray) -> tuple[Float[np.ndarray, "h w"], float]:
    """The distance of every coarse pixel from the mask, and the size of a coarse pixel, px."""
    step = max(mask.shape) / _SIDE
    size = (max(1, round(mask.shape[1] / step)), max(1, round(mask.shape[0] / step)))
    coarse = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127
    return cv2.distanceTransform((~coarse).astype(np.uint8), cv2.DIST_L2, 3).astype(np.float64), step


def _outside_m(
    camera: Camera, field: tuple[Float[np.ndarray, "h w"], float], points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P"]:
    """How far points lie outside a view's mask, m at their depth; 0 outside the image."""
    distance, step = field
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, depth = camera.project(points)
    inside = (depth > 0) & (xy >= 0).all(1) & (xy < [camera.width_px, camera.height_px]).all(1)
    cell = np.where(inside[:, None], xy / step - 0.5, 0).astype(np.float32)
    values = cv2.remap(
        distance.astype(np.float32), cell[:, :1], cell[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.where(inside, values[:, 0] * step * depth / camera.intrinsics[0, 0], 0.0)
