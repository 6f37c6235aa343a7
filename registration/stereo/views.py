"""Photographs as stereo takes them, and their windows around the head."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num

from registration.types import Camera

MOST_PX = 700  # across the head's sphere: larger images are reduced
_MARGIN = 1.05  # of the window around the sphere's outline


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoView:
    """One photograph without distortion."""

    image: Num[np.ndarray, "H W"] | Num[np.ndarray, "H W 3"]  # as displayed (sRGB): uint8, uint16, or float in [0, 1]
    camera: Camera  # a pinhole of the image's size
    mask: Num[np.ndarray, "H W"] | Bool[np.ndarray, "H W"] | None = None  # of the subject: above a half, or true


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadImage:
    """The window of a photograph around the head, grey."""

    grey: Float[np.ndarray, "h w"]  # float32, 0 to 255
    camera: Camera  # of the window
    mask: Bool[np.ndarray, "h w"]  # inside the image and, where there are masks, on the subject


def head_image(
    view: StereoView, centre: Float[np.ndarray, "3"], radius_m: float, most_px: int = MOST_PX
) -> HeadImage | None:
    """Cut the window around a sphere out of a photograph, reduced if it is large.

    Args:
        view: the photograph.
        centre: of the head, world, metres.
        radius_m: of a sphere around the head.
        most_px: largest width of the sphere's window.

    Returns:
        The window; None where the sphere is behind the camera or outside the image.

    Raises:
        ValueError: the camera has distortion, or another size than the image.
    """
    camera = view.camera
    if camera.distortion or view.image.shape[:2] != (camera.height_px, camera.width_px):
        raise ValueError("stereo needs an image without distortion, of its camera's size")
    (xy,), (depth,) = camera.project(np.asarray(centre, np.float64)[None])
    if depth <= 1.2 * radius_m:
        return None
    reach = _MARGIN * radius_m * np.array([camera.intrinsics[0, 0], camera.intrinsics[1, 1]]) / (depth - radius_m / 2)
    size = np.array([camera.width_px, camera.height_px])
    first = np.clip(np.floor(xy - reach), 0, size).astype(int)
    last = np.clip(np.ceil(xy + reach), 0, size).astype(int)
    if (last - first < 8).any():
        return None
    (x, y), (width, height) = first.tolist(), (last - first).tolist()
    window = np.s_[y : y + height, x : x + width]
    grey = _grey(view.image[window])
    mask: np.ndarray = np.ones(grey.shape, np.float32) if view.mask is None else view.mask[window].astype(np.float32)
    cropped = camera.cropped(x, y, width, height)
    factor = min(1.0, most_px / (2 * float(reach.max())))
    if factor < 1:
        small = (max(8, round(width * factor)), max(8, round(height * factor)))
        grey, mask = (cv2.resize(values, small, interpolation=cv2.INTER_AREA) for values in (grey, mask))
        cropped = cropped.scaled(*small)
    return HeadImage(grey=grey, camera=cropped, mask=mask > 0.5)


def rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Return the directions through a pinhole's pixel centres in its own frame, with z = 1, float32."""
    inverse = np.linalg.inv(camera.intrinsics)
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    return (x[..., None] * inverse[:, 0] + y[..., None] * inverse[:, 1] + inverse[:, 2]).astype(np.float32)


def relative_pose(source: Camera, target: Camera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return rotation and translation (m) from one camera's frame into another's."""
    rotation = target.T_cam_world[:3, :3] @ source.T_cam_world[:3, :3].T
    return rotation, target.T_cam_world[:3, 3] - rotation @ source.T_cam_world[:3, 3]


def head_images(
    views: Sequence[StereoView], centre: Float[np.ndarray, "3"], radius_m: float, most_px: int = MOST_PX
) -> tuple[HeadImage | None, ...]:
    """Cut the windows of several photographs, as `head_image`."""
    return tuple(head_image(view, centre, radius_m, most_px) for view in views)


def _grey(image: Num[np.ndarray, "h w"] | Num[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    scale = {np.dtype(np.uint8): 1.0, np.dtype(np.uint16): 1 / 257}.get(image.dtype, 255.0)
    values: np.ndarray = image.astype(np.float32) * np.float32(scale)
    if values.ndim == 3:
        values = cv2.cvtColor(np.ascontiguousarray(values), cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(values)
