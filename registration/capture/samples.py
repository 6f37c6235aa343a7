"""Every view decoded once for the checks and reduced to some thousand pixels of each channel."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from registration.capture import pixels
from registration.capture.class_names import BACKGROUND, NECK
from registration.errors import InputError
from registration.frames import opencv_intrinsics
from registration.types import Camera, Capture, View

MAX_DECODED_PIXELS = 2**22  # images of more are not decoded; normal maps of more in some views only
LARGE_NORMAL_MAPS = 4  # of more pixels than that, this many are decoded
_SAMPLES = 2**15  # pixels that are kept of a view


@dataclass(frozen=True, kw_only=True)
class ViewSample:
    """Every `step`-th pixel of a view in both directions; None where it has no such file, or one that is too large."""

    name: str
    step: int
    rays: Float[np.ndarray, "h w 3"]  # unit, camera frame, through the pixels
    grey: Float[np.ndarray, "h w"] | None  # of the image, 0 to 1, mean over the pixels around
    mask: UInt8[np.ndarray, "h w"] | None  # 255: subject
    labels: UInt8[np.ndarray, "h w"] | None
    normals: Float[np.ndarray, "h w 3"] | None  # as encoded, camera frame, not of unit length; 0: none
    depth: Float[np.ndarray, "h w"] | None  # metres; 0: none
    subject: Bool[np.ndarray, "h w"]  # by the mask, else by the labels, else everything
    coverage: float | None  # fraction of the stored image that the mask covers
    head_rows: int  # height of what shows the head, px of the stored image

    def at(self, xy_px: Float[np.ndarray, "P 2"]) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
        """Rows and columns of the samples nearest to some pixels, clipped to the image."""
        height, width = self.subject.shape
        column, row = np.nan_to_num(np.asarray(xy_px, np.float64) / self.step - 0.5, nan=0.0).clip(-1e6, 1e6).T
        return (
            np.round(row).astype(int).clip(0, height - 1),
            np.round(column).astype(int).clip(0, width - 1),
        )


def sample_views(capture: Capture) -> list[ViewSample]:
    """Decode all views. Raises InputError for a file that cannot be used, or an empty mask."""
    large = [view.name for view in capture.views if view.has_normals and not _small(view.camera)]
    chosen = {large[int(i)] for i in np.linspace(0, len(large) - 1, LARGE_NORMAL_MAPS) if large}
    return [_sample(view, capture, decode_normals=view.name in chosen) for view in capture.views]


def _small(camera: Camera) -> bool:
    return camera.width_px * camera.height_px <= MAX_DECODED_PIXELS


def _sample(view: View, capture: Capture, decode_normals: bool) -> ViewSample:
    camera, classes = view.camera, capture.classes
    step = max(1, math.ceil(math.sqrt(camera.width_px * camera.height_px / _SAMPLES)))
    some = slice(step // 2, None, step)
    width, height = len(range(camera.width_px)[some]), len(range(camera.height_px)[some])
    grey = mask = labels = normals = depth = head = coverage = None
    rays = _rays(camera, some)
    if view.mask is not None:
        full = pixels.read_mask(view.mask, camera)
        if not full.any():
            raise InputError(
                "The mask is empty",
                where=view.mask,
                expected="255 where the subject is",
                got="no pixel above 0",
                fix="draw the mask, or remove this view or its mask",
            )
        head, mask, coverage = (full > 127).any(1), full[some, some].copy(), float(full.mean() / 255)
    if view.segmentation is not None:
        full = pixels.read_labels(view.segmentation, camera, classes, capture.labels)
        # The head alone: with shoulders the heads of close-ups and of busts would have different resolutions.
        other = np.array([name in (BACKGROUND, NECK) for name in classes] + [True] * (256 - len(classes)))
        head, labels = (~cv2.LUT(full, other.astype(np.uint8)).astype(bool)).any(1), full[some, some].copy()
    if _small(camera):
        grey = _reduced_grey(pixels.read_image(view.image, camera, view.colour), width, height)
    if view.normals is not None and (_small(camera) or decode_normals):
        normals = pixels.in_camera(pixels.decode_normals(pixels.read_normals(view.normals, camera)[some, some]), view)
    if view.depth is not None and (_small(camera) or decode_normals):
        depth = pixels.read_depth(view)[some, some]
        if view.normals is None:
            normals = pixels.depth_normals(depth, rays / rays[..., 2:])
    if mask is not None:
        subject = mask > 127
    elif labels is not None and BACKGROUND in classes:
        subject = labels != classes.index(BACKGROUND)
    else:
        subject = np.ones((height, width), bool)
    rows = np.flatnonzero(head) if head is not None else np.zeros(0)
    return ViewSample(
        name=view.name,
        step=step,
        rays=rays,
        grey=grey,
        mask=mask,
        labels=labels,
        normals=normals,
        depth=depth,
        subject=subject,
        coverage=coverage,
        head_rows=int(np.ptp(rows)) + 1 if len(rows) else camera.height_px,
    )


def with_grey(sample: ViewSample, view: View) -> ViewSample:
    """The sample with the image's grey values, also of an image that `sample_views` does not decode."""
    if sample.grey is not None:
        return sample
    height, width = sample.subject.shape
    return replace(sample, grey=_reduced_grey(pixels.read_image(view.image, view.camera, view.colour), width, height))


def _reduced_grey(image: np.ndarray, width: int, height: int) -> Float[np.ndarray, "h w"]:
    reduced = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return reduced.mean(-1, dtype=np.float32) / np.float32(255 if image.dtype == np.uint8 else 65535)


def _rays(camera: Camera, some: slice) -> Float[np.ndarray, "h w 3"]:
    y, x = np.meshgrid(range(camera.height_px)[some], range(camera.width_px)[some], indexing="ij")
    grid = np.stack([x, y], -1).reshape(-1, 1, 2).astype(np.float64)
    coefficients = np.array(camera.distortion) if camera.distortion else None
    plane = cv2.undistortPoints(grid, opencv_intrinsics(camera.intrinsics), coefficients).reshape(*x.shape, 2)
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
