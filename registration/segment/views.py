"""The pictures that this room works on: undistorted views, and windows around the head at a working resolution."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.stereo.depth_map import DepthMap
from registration.types import Camera

HEAD_PX = 512  # height of the head in a window at most
_SIDES, _ABOVE, _BELOW = 2.2, 1.8, 3.0  # radii of the head's sphere that a window holds around its centre


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentView:
    """One view without distortion, in memory."""

    name: str
    image: UInt8[np.ndarray, "H W 3"]  # red green blue, sRGB
    camera: Camera  # without distortion, of the image's size
    landmarks: Float[np.ndarray, "L 3"] | None = None  # of scheme "face478": x_px y_px confidence


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadSphere:
    """Where the head is: a sphere around skull and face; hair may reach beyond it."""

    centre: Float[np.ndarray, "3"]  # metres, world
    radius_m: float

    def in_view(self, camera: Camera) -> tuple[Float[np.ndarray, "2"], float]:
        """Its centre and radius in a view, px."""
        xy, depth = camera.project(np.asarray(self.centre, np.float64)[None])
        return xy[0], float(camera.intrinsics[0, 0] * self.radius_m / max(depth[0], 1e-6))


@dataclass(frozen=True, kw_only=True)
class Window:
    """A part of an image around the head, reduced so that the head is at most `HEAD_PX` high."""

    left: int  # px of the image, as the next three
    top: int
    width: int
    height: int
    columns: int  # of the window's own pixels
    rows: int

    @classmethod
    def around(cls, camera: Camera, sphere: HeadSphere, head_px: int = HEAD_PX) -> "Window | None":
        """Return the window of a view; None if the head is not in the image."""
        (x, y), radius = sphere.in_view(camera)
        _, depth = camera.project(np.asarray(sphere.centre, np.float64)[None])
        if depth[0] <= 0:
            return None
        left, right = np.clip([x - _SIDES * radius, x + _SIDES * radius], 0, camera.width_px)
        top, bottom = np.clip([y - _ABOVE * radius, y + _BELOW * radius], 0, camera.height_px)
        left, top, right, bottom = int(left), int(top), int(np.ceil(right)), int(np.ceil(bottom))
        width, height = right - left, bottom - top
        if min(width, height) < 16:
            return None
        scale = min(1.0, head_px / (2 * radius))
        columns, rows = max(8, round(width * scale)), max(8, round(height * scale))
        return cls(left=left, top=top, width=width, height=height, columns=columns, rows=rows)

    @property
    def scale(self) -> float:
        """Pixels of the window per pixel of the image."""
        return self.columns / self.width

    def camera(self, camera: Camera) -> Camera:
        """The camera of the window's pixels."""
        return camera.cropped(self.left, self.top, self.width, self.height).scaled(self.columns, self.rows)

    def points(self, xy_px: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Pixels of the image as pixels of the window."""
        return (xy_px - (self.left, self.top)) * (self.columns / self.width, self.rows / self.height)

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The image's window, averaged to the window's pixels."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        if part.shape[:2] == (self.rows, self.columns):
            return part
        return cv2.resize(part, (self.columns, self.rows), interpolation=cv2.INTER_AREA)

    def nearest(self, image: np.ndarray) -> np.ndarray:
        """The image's window without averaging: for depths and labels."""
        part = image[self.top : self.top + self.height, self.left : self.left + self.width]
        return cv2.resize(part, (self.columns, self.rows), interpolation=cv2.INTER_NEAREST)

    def paste(self, values: np.ndarray, shape: tuple[int, int], *, smooth: bool) -> np.ndarray:
        """Return an image of this shape with the window's values; outside of it the nearest ones of its border."""
        kind = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        part = values
        if values.shape[:2] != (self.height, self.width):
            part = cv2.resize(values, (self.width, self.height), interpolation=kind)
        below, right = shape[0] - self.top - self.height, shape[1] - self.left - self.width
        return cv2.copyMakeBorder(part, self.top, below, self.left, right, cv2.BORDER_REPLICATE)


def disc(shape: tuple[int, int], centre: Float[np.ndarray, "2"], radius: float) -> Bool[np.ndarray, "H W"]:
    """Pixels of an image within a radius (px) of a point."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return (x + 0.5 - centre[0]) ** 2 + (y + 0.5 - centre[1]) ** 2 <= radius**2


def ellipse(radius_px: float) -> UInt8[np.ndarray, "K K"]:
    """A round structuring element of a radius, at least one pixel."""
    side = 2 * max(1, round(radius_px)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def depth_in(depth: DepthMap, camera: Camera, confidence: float) -> Float[np.ndarray, "H W"]:
    """Return a depth map in another grid of the same view: the nearest depth (m), 0 where none is trusted.

    Args:
        depth: of a camera at the same place that looks in the same direction.
        camera: of the grid.
        confidence: depths of less are not trusted.
    """
    trusted = np.where(depth.confidence >= confidence, depth.depth, 0).astype(np.float32)
    change = depth.camera.intrinsics @ np.linalg.inv(camera.intrinsics)
    x = (np.arange(camera.width_px) + 0.5) * change[0, 0] + change[0, 2]
    y = (np.arange(camera.height_px) + 0.5) * change[1, 1] + change[1, 2]
    columns, rows = np.meshgrid((x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32))
    return cv2.remap(trusted, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,))


def points_at(depth: Float[np.ndarray, "H W"], camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Return the world points (m) at the pixels' centres and these depths."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T
    local = rays * depth[..., None] - camera.T_cam_world[:3, 3]
    return local @ camera.T_cam_world[:3, :3]
