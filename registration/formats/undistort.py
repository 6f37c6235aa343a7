"""Views that a native capture cannot hold as they are: turned images, skew, and lenses that OpenCV's model is not.

A native camera is a pinhole with OpenCV's coefficients. Other lenses are undistorted when they are imported: each pixel
of the new image is projected through the lens, which needs no inverse, and takes its value from there. The new camera
keeps the focal lengths; its image is the largest rectangle around the principal point's column and row that the lens
has seen everywhere, at most twice the old size, so that no pixel is made up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.formats import distortions
from registration.formats.distortions import MODELS
from registration.formats.source import Distortion, SourceView
from registration.types import Camera

_MAX_GROWTH = 0.5  # of an image at each side, as a fraction of its size
_BORDER_POINTS = 64  # along each side
_STRIP_PIXELS = 2**21  # mapped at a time
_NEVER = -1e6  # px, of what has no source


@dataclass(frozen=True, kw_only=True)
class Undistortion:
    """From a source image to a pinhole's.

    Attributes:
        intrinsics: K of the source (px), with skew.
        distortion: of the source.
        camera: the pinhole, world units of the source.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    distortion: Distortion
    camera: Camera

    def image(self, pixels: np.ndarray) -> np.ndarray:
        """Return an image, mask or map of numbers (H, W) or (H, W, C) through the lens; 0 without a source."""
        return self._remap(pixels, cv2.INTER_LINEAR)

    def labels(self, pixels: np.ndarray) -> np.ndarray:
        """Return a map of indices through the lens, each the nearest pixel's."""
        return self._remap(pixels, cv2.INTER_NEAREST)

    def landmarks(self, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
        """Return landmarks (x_px y_px confidence) in the new image; confidence 0 where the lens has no inverse."""
        plane = undistorted(self.distortion, on_plane(self.intrinsics, points[:, :2]))
        K = self.camera.intrinsics
        moved = plane * [K[0, 0], K[1, 1]] + K[:2, 2]
        usable = np.isfinite(moved).all(-1)
        return np.where(usable[:, None], np.column_stack([moved, points[:, 2]]), 0.0)

    def _remap(self, pixels: np.ndarray, interpolation: int) -> np.ndarray:
        width_px, height_px = self.camera.width_px, self.camera.height_px
        result = np.empty((height_px, width_px, *pixels.shape[2:]), pixels.dtype)
        step = max(1, _STRIP_PIXELS // width_px)
        for first in range(0, height_px, step):
            rows = slice(first, min(first + step, height_px))
            x, y = self._sources(rows)
            result[rows] = cv2.remap(pixels, x, y, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,) * 4)
        return result

    def _sources(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the source (OpenCV's pixels, whose first centre is at 0) of each pixel of some rows."""
        y, x = np.mgrid[rows, : self.camera.width_px] + 0.5
        source = self.sources(np.stack([x.ravel(), y.ravel()], -1)) - 0.5
        source = np.where(np.isfinite(source), source, _NEVER).astype(np.float32)
        return source[:, 0].reshape(x.shape), source[:, 1].reshape(x.shape)

    def sources(self, pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Return where pixels of the new image (px) lie in the source image (px); NaN where the lens ends."""
        with np.errstate(all="ignore"):
            distorted = distortions.distort(self.distortion, on_plane(self.camera.intrinsics, pixels))
        return distorted @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2]


def is_native(view: SourceView) -> bool:
    """Whether a native camera holds the view's lens and skew as they are."""
    model = MODELS[view.distortion.model]
    return model.opencv is not None and not view.intrinsics[0, 1]


def native_camera(view: SourceView) -> Camera:
    """Return the camera of a view of which `is_native` holds, in the source's world unit."""
    opencv = MODELS[view.distortion.model].opencv
    assert opencv is not None
    coefficients = opencv(view.distortion.coefficients)
    padded = (*coefficients, *[0.0] * (4 - len(coefficients))) if 0 < len(coefficients) < 4 else coefficients
    if 5 < len(padded) < 8:
        padded = (*padded, *[0.0] * (8 - len(padded)))
    return Camera(
        width_px=view.width_px,
        height_px=view.height_px,
        intrinsics=np.array(view.intrinsics, np.float64),
        T_cam_world=np.array(view.T_cam_world, np.float64),
        distortion=padded if any(padded) else (),
    )


def undistortion(view: SourceView) -> Undistortion:
    """Return the pinhole that sees what a view's lens sees, and the way to its pixels.

    Raises:
        InputError: the lens folds the image over itself, or sees nothing around the principal point.
    """
    K = np.array(view.intrinsics, np.float64)
    pinhole = K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    low, high = _seen_rectangle(view, pinhole)
    width_px, height_px = (high - low).tolist()
    pinhole[:2, 2] -= low
    camera = Camera(
        width_px=width_px,
        height_px=height_px,
        intrinsics=pinhole,
        T_cam_world=np.array(view.T_cam_world, np.float64),
    )
    lens = Undistortion(intrinsics=K, distortion=view.distortion, camera=camera)
    _require_one_to_one(lens, view)
    return lens


def undistorted(distortion: Distortion, points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """Return the undistorted points (plane z = 1) of distorted ones, by Newton's method; NaN where it fails.

    The way starts at the centre and follows the point outwards in steps, so that it stays on the lens's first branch.
    """
    current = np.zeros_like(points)
    with np.errstate(all="ignore"):
        for share in (0.25, 0.5, 0.75, 1.0):
            goal = share * points
            for _ in range(30):
                error = distortions.distort(distortion, current) - goal
                step = np.linalg.solve(_jacobians(distortion, current), error[..., None])[..., 0]
                step = np.where(np.isfinite(step), step, np.nan)
                length = np.linalg.norm(step, axis=-1, keepdims=True)
                limit = 0.5 + 0.5 * np.linalg.norm(current, axis=-1, keepdims=True)
                current = current - step * np.minimum(1, limit / np.maximum(length, 1e-300))
        wrong = np.linalg.norm(distortions.distort(distortion, current) - points, axis=-1)
    scale = 1e-10 * (1 + np.linalg.norm(points, axis=-1))
    return np.where((wrong < scale)[:, None], current, np.nan)


def _jacobians(distortion: Distortion, points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2 2"]:
    """Derivatives by central differences; the identity where they are singular or not finite."""
    h = 1e-6 * (1 + np.abs(points).max(-1, keepdims=True))
    columns = []
    for axis in np.eye(2):
        forward = distortions.distort(distortion, points + h * axis)
        columns.append((forward - distortions.distort(distortion, points - h * axis)) / (2 * h))
    jacobians = np.stack(columns, -1)
    usable = np.isfinite(jacobians).all((-1, -2))
    usable &= np.abs(np.linalg.det(np.where(usable[:, None, None], jacobians, np.eye(2)))) > 1e-9
    return np.where(usable[:, None, None], jacobians, np.eye(2))


def on_plane(intrinsics: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """Return pixels on the plane z = 1 of a camera with this K, which may have skew; distorted as they were."""
    shifted = pixels - intrinsics[:2, 2]
    y = shifted[:, 1] / intrinsics[1, 1]
    x = (shifted[:, 0] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return np.stack([x, y], -1)


def _seen_rectangle(view: SourceView, pinhole: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """The whole pixels (first, end) of the undistorted image that the source image covers everywhere."""
    size = np.array([view.width_px, view.height_px])
    low, high = -_MAX_GROWTH * size, (1 + _MAX_GROWTH) * size
    t = np.linspace(0, 1, _BORDER_POINTS)
    sides: Sequence[tuple[int, bool, np.ndarray]] = (
        (0, False, np.stack([0 * t, t * size[1]], -1)),
        (0, True, np.stack([0 * t + size[0], t * size[1]], -1)),
        (1, False, np.stack([t * size[0], 0 * t], -1)),
        (1, True, np.stack([t * size[0], 0 * t + size[1]], -1)),
    )
    for axis, end, border in sides:
        points = undistorted(view.distortion, on_plane(view.intrinsics, border))[:, axis]
        reached = points[np.isfinite(points)] * pinhole[axis, axis] + pinhole[axis, 2]
        if len(reached) and end:
            high[axis] = min(high[axis], reached.min())
        elif len(reached):
            low[axis] = max(low[axis], reached.max())
    low, high = np.ceil(low - 1e-6).astype(int), np.floor(high + 1e-6).astype(int)
    if (high - low < 8).any():
        raise _unusable(view, f"an image of {high[0] - low[0]} x {high[1] - low[1]} px")
    return low, high


def _require_one_to_one(lens: Undistortion, view: SourceView) -> None:
    """Refuse a lens that shows a part of the image twice or mirrored."""
    camera = lens.camera
    x, y = np.meshgrid(np.linspace(0, camera.width_px, 64), np.linspace(0, camera.height_px, 64))
    source = lens.sources(np.stack([x.ravel(), y.ravel()], -1)).reshape(64, 64, 2)
    (x_down, x_right), (y_down, y_right) = np.gradient(source[..., 0]), np.gradient(source[..., 1])
    inside = ((source >= 0) & (source <= [view.width_px, view.height_px])).all(-1)
    if not inside.any() or (x_right * y_down - x_down * y_right)[inside].min() <= 0:
        raise _unusable(view, "one that folds the image over itself")


def _unusable(view: SourceView, got: str) -> InputError:
    coefficients = ", ".join(f"{value:.6g}" for value in view.distortion.coefficients)
    return InputError(
        "The lens of a view cannot be undistorted",
        where=view.name,
        expected="coefficients with which each pixel lies in one place of the image",
        got=f"{got}, from {view.distortion.model} ({coefficients})",
        fix="check the coefficients, their order and the focal length; or undistort the images with the other program",
    )


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return stored pixels (H, W, ...) turned as an EXIF orientation from 1 to 8 says."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def scaled_world(camera: Camera, factor: float) -> Camera:
    """Return the camera in a world whose lengths are multiplied by a factor."""
    T = camera.T_cam_world.copy()
    T[:3, 3] *= factor
    return replace(camera, T_cam_world=T)
