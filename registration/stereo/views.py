"""Photographs as stereo takes them, and their windows around the head."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num

from registration.types import Camera

MOST_PX = 720  # larger side of the window around the head: larger windows are reduced
_MARGIN = 0.02  # of the size of what the window is around


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
        most_px: largest side of the window.

    Returns:
        The window; None where the sphere is behind the camera or outside the image.

    Raises:
        ValueError: the camera has distortion, or another size than the image.
    """
    camera = view.camera
    local = camera.T_cam_world[:3, :3] @ np.asarray(centre, np.float64) + camera.T_cam_world[:3, 3]
    if local[2] <= 1.2 * radius_m:
        return None
    (xy,), _ = camera.project(np.asarray(centre, np.float64)[None])
    reach = radius_m * np.array([camera.intrinsics[0, 0], camera.intrinsics[1, 1]]) / (local[2] - radius_m / 2)
    return _window(view, xy - reach, xy + reach, most_px)


def surface_image(view: StereoView, points: Float[np.ndarray, "P 3"], most_px: int = MOST_PX) -> HeadImage | None:
    """Cut the window around points, such as a mesh's vertices, out of a photograph; otherwise as `head_image`."""
    camera = view.camera
    depth = points @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    if depth.min() <= 0:
        return None
    pixels, _ = camera.project(points)
    return _window(view, pixels.min(0), pixels.max(0), most_px)


def camera_image(view: StereoView, camera: Camera) -> HeadImage:
    """Cut the window that a map was made on, of this camera, out of its photograph."""
    scale = (
        camera.intrinsics[0, 0] / view.camera.intrinsics[0, 0],
        camera.intrinsics[1, 1] / view.camera.intrinsics[1, 1],
    )
    first = view.camera.intrinsics[:2, 2] - camera.intrinsics[:2, 2] / scale
    x, y = np.round(first).astype(int).tolist()
    width, height = round(camera.width_px / scale[0]), round(camera.height_px / scale[1])
    return _cut(view, (x, y, width, height), (camera.width_px, camera.height_px))


def _window(
    view: StereoView, first: Float[np.ndarray, "2"], last: Float[np.ndarray, "2"], most_px: int
) -> HeadImage | None:
    camera = view.camera
    if camera.distortion or view.image.shape[:2] != (camera.height_px, camera.width_px):
        raise ValueError("stereo needs an image without distortion, of its camera's size")
    size, margin = np.array([camera.width_px, camera.height_px]), _MARGIN * (last - first)
    x, y = np.clip(np.floor(first - margin), 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(last + margin), 0, size).astype(int).tolist()
    width, height = right - x, bottom - y
    if min(width, height) < 8:
        return None
    factor = min(1.0, most_px / max(width, height))
    return _cut(view, (x, y, width, height), (max(8, round(width * factor)), max(8, round(height * factor))))


def _cut(view: StereoView, box: tuple[int, int, int, int], size: tuple[int, int]) -> HeadImage:
    """A part of a photograph (x, y, width, height), reduced to a size (width, height)."""
    x, y, width, height = box
    window = np.s_[y : y + height, x : x + width]
    grey = _grey(view.image[window])
    mask: np.ndarray = np.ones(grey.shape, np.float32) if view.mask is None else view.mask[window].astype(np.float32)
    camera = view.camera.cropped(x, y, width, height)
    if size != (width, height):
        grey, mask = (cv2.resize(values, size, interpolation=cv2.INTER_AREA) for values in (grey, mask))
        camera = camera.scaled(*size)
    return HeadImage(grey=grey, camera=camera, mask=mask > 0.5)


def rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Return the directions through a pinhole's pixel centres in its own frame, with z = 1, float32."""
    inverse = np.linalg.inv(camera.intrinsics)
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    return (x[..., None] * inverse[:, 0] + y[..., None] * inverse[:, 1] + inverse[:, 2]).astype(np.float32)


def relative_pose(source: Camera, target: Camera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return rotation and translation (m) from one camera's frame into another's."""
    rotation = target.T_cam_world[:3, :3] @ source.T_cam_world[:3, :3].T
    return rotation, target.T_cam_world[:3, 3] - rotation @ source.T_cam_world[:3, 3]


def _grey(image: Num[np.ndarray, "h w"] | Num[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    scale = {np.dtype(np.uint8): 1.0, np.dtype(np.uint16): 1 / 257}.get(image.dtype, 255.0)
    values: np.ndarray = image.astype(np.float32) * np.float32(scale)
    if values.ndim == 3:
        values = cv2.cvtColor(np.ascontiguousarray(values), cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(values)
