"""The pixels around the head of one view: decoded, cropped, and reduced to the resolution that a level asks for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.dense_maps import block_depth
from registration.capture.pixels import read_view, undistort_landmarks, undistorted_spread
from registration.geometry.surface_views import SurfaceViews
from registration.targets.classes import BACKGROUND, ClassMap
from registration.types import Camera, Capture, View, ViewPixels

MARGIN = 0.08  # times the head's height: distance around the head of the pixels and silhouettes that are compared
_NECK = 0.3  # times the head's height: part below the head that a crop contains


@dataclass(frozen=True, kw_only=True)
class ViewCrop:
    """The pixels around the head of one view; channels can be averaged over areas."""

    name: str
    camera: Camera
    rgb: Float[np.ndarray, "H W 3"]
    normals: Float[np.ndarray, "H W 3"]  # world frame; 0 where none
    mask: Float[np.ndarray, "H W"]
    classes: Float[np.ndarray, "H W K"]
    neck: Float[np.ndarray, "H W"]  # coverage, as the next
    excluded: Float[np.ndarray, "H W"]
    valid: Float[np.ndarray, "H W"]
    incidence: Float[np.ndarray, "H W"]  # cosine, where it is known without normals; else 1
    confidence: Float[np.ndarray, "H W"] | None  # of normals and depth; None: 1
    depth: Float[np.ndarray, "H W"] | None  # along the optical axis, metres; 0 where none
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]]
    landmark_spread_px: Mapping[str, Float[np.ndarray, "L"]]
    has_mask: bool
    has_classes: bool
    has_colours: bool
    has_normals: bool  # from a file
    has_holes: bool  # in the normals, as stereo leaves them: colours count beside them too
    head_px: float

    def reduced(self, width: int, height: int) -> "ViewCrop":
        """Return the crop at a smaller size: every channel is averaged over the area of each new pixel.

        Pixels of two surfaces, or mostly without a depth, get no depth.
        """
        channels = self._each(lambda value: _area_means(value, width, height))
        if self.depth is not None:
            known, squares = (_area_means(v, width, height) for v in ((self.depth > 0) * np.float32(1), self.depth**2))
            channels["depth"] = block_depth(known, channels["depth"], squares).astype(np.float32)
        across, down = width / self.camera.width_px, height / self.camera.height_px
        spread = np.sqrt(across * down)
        return replace(
            self,
            camera=self.camera.scaled(width, height),
            landmarks={scheme: points * [across, down, 1] for scheme, points in self.landmarks.items()},
            landmark_spread_px={scheme: px * spread for scheme, px in self.landmark_spread_px.items()},
            head_px=self.head_px * down,
            **channels,
        )

    def padded(self, block: int) -> "ViewCrop":
        """Extend the crop at its right and bottom to whole blocks, by pixels that no loss compares."""
        height, width = self.mask.shape
        rows, columns = -height % block, -width % block
        channels = self._each(lambda value: np.pad(value, [(0, rows), (0, columns)] + [(0, 0)] * (value.ndim - 2)))
        return replace(self, camera=self.camera.cropped(0, 0, width + columns, height + rows), **channels)

    def with_surface(self, surface: SurfaceViews) -> "ViewCrop":
        """Return the crop with the normals of a surface; colours count beside it too, where it has holes."""
        view = surface.view(self.camera)
        normals = (view.normals * (view.weight > 0)[..., None]).astype(np.float32)
        towards = -(directions(self.camera) * view.normals).sum(-1)  # below 0 behind a hole
        incidence = np.where(towards > 0, towards, 1).astype(np.float32)
        return replace(self, normals=normals, incidence=incidence)

    def head_and_other(self) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
        """Return the subject's head, and its neck, hair and clothes; pixels in the mask without a label are neither."""
        subject = self.mask > 0.5
        other = subject & (self.neck + self.excluded > 0.5)
        head = subject & ~other
        if self.has_classes:
            head &= self.classes.sum(-1) + self.excluded > 0.5
        return head, other

    def cropped_to_head(self) -> "ViewCrop":
        """Return the window of the head, a margin around it and a part of the neck; all of it without a mask."""
        head, _ = self.head_and_other()
        if not self.has_mask or not head.any():
            return self
        rows, columns = np.flatnonzero(head.any(1)), np.flatnonzero(head.any(0))
        head_px = float(np.ptp(rows) + 1)
        margin = int(np.ceil(MARGIN * head_px)) + 8
        top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
        bottom, right = rows[-1] + 1 + margin, columns[-1] + 1 + margin
        bottom += int(_NECK * head_px)
        # Copies, so that the pixels outside the window are freed.
        channels = self._each(lambda value: value[top:bottom, left:right].copy())
        height, width = channels["mask"].shape
        landmarks = {scheme: points - [left, top, 0] for scheme, points in self.landmarks.items()}
        camera = self.camera.cropped(int(left), int(top), width, height)
        return replace(self, camera=camera, landmarks=landmarks, head_px=head_px, **channels)

    def without_channels(self) -> "ViewCrop":
        """Return what is known of the crop beside its pixels; they are not kept."""
        return replace(self, **self._each(lambda value: np.zeros((0, 0, *value.shape[2:]), np.float32)))

    def _each(self, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
        """Apply a function to every channel."""
        return {name: change(value) for name, value in vars(self).items() if isinstance(value, np.ndarray)}


def read_crop(view: View, capture: Capture, mapping: ClassMap, downsample: int) -> ViewCrop:
    """Decode a view, its pixels averaged in blocks, and cut out the head.

    Args:
        view: of the capture.
        capture: what its labels and colours mean.
        mapping: the classes to compare.
        downsample: width and height of the blocks, px of the stored image.

    Raises:
        InputError: an image cannot be decoded.
    """
    pixels = read_view(view, capture, downsample=downsample)
    shape = pixels.rgb.shape[:2]
    zeros = np.zeros(shape, np.float32)
    classes = np.zeros((*shape, len(mapping.names)), np.float32)
    neck = excluded = zeros
    if pixels.label_coverage is not None:
        classes = pixels.label_coverage @ mapping.from_capture
        neck, excluded = pixels.label_coverage @ mapping.neck, pixels.label_coverage @ mapping.excluded
    mask = _coverage(pixels, capture)
    normals = np.zeros((*shape, 3), np.float32)
    if pixels.normals is not None:
        normals = (pixels.normals @ pixels.camera.T_cam_world[:3, :3]).astype(np.float32)
    landmarks = {}
    for scheme in view.landmarks:
        points = undistort_landmarks(view, scheme).copy()
        points[:, :2] /= downsample
        landmarks[scheme] = points
    spreads = {scheme: undistorted_spread(view, scheme) / downsample for scheme in view.landmark_spread_px}
    full = ViewCrop(
        name=view.name,
        camera=pixels.camera,
        rgb=pixels.rgb.astype(np.float32),
        normals=normals,
        mask=zeros + 1 if mask is None else mask,
        classes=classes,
        neck=neck,
        excluded=excluded,
        valid=pixels.valid,
        incidence=zeros + 1,
        confidence=pixels.confidence,
        depth=pixels.depth,
        landmarks=landmarks,
        landmark_spread_px=spreads,
        has_mask=mask is not None,
        has_classes=pixels.label_coverage is not None,
        has_colours=capture.photographs,
        has_normals=pixels.normals is not None,
        has_holes=pixels.depth is not None or pixels.confidence is not None,
        head_px=float(shape[0]),
    )
    return full.cropped_to_head()


def _coverage(pixels: ViewPixels, capture: Capture) -> Float[np.ndarray, "H W"] | None:
    if pixels.mask is not None:
        return pixels.mask
    if pixels.label_coverage is not None and BACKGROUND in capture.classes:
        return 1 - pixels.label_coverage[..., capture.classes.index(BACKGROUND)]
    return None


def directions(camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Return unit world directions through the centres of a camera's pixels, in float32."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float32) + np.float32(0.5)
    to_world = np.linalg.inv(camera.intrinsics).T @ camera.T_cam_world[:3, :3]
    rays = np.stack([x, y, np.ones_like(x)], -1) @ to_world.astype(np.float32)
    length = np.sqrt(np.einsum("hwc,hwc->hw", rays, rays))
    return np.asarray(rays / length[..., None], np.float32)


def _area_means(image: Float[np.ndarray, "H W *D"], width: int, height: int) -> Float[np.ndarray, "h w *D"]:
    """An image at a smaller size, averaged over the area of each of its pixels."""
    channels = image.reshape(*image.shape[:2], -1).astype(np.float32, copy=False)
    means = np.empty((height, width, channels.shape[2]), np.float32)
    for first in range(0, channels.shape[2], 4):  # as many as OpenCV takes
        four = np.ascontiguousarray(channels[..., first : first + 4])
        resized = cv2.resize(four, (width, height), interpolation=cv2.INTER_AREA)
        means[..., first : first + 4] = resized.reshape(height, width, -1)
    return means.reshape(height, width, *image.shape[2:])
