"""The made channels as files of a native capture folder, and the capture that uses them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.capture.landmark_files import read_landmarks
from registration.capture.native_writer import ViewArrays, write_channels
from registration.frames import opencv_intrinsics
from registration.segment.masks import UNCERTAIN
from registration.stereo.depth_map import DepthMap
from registration.stereo.stored import stored_maps
from registration.types import Camera, Capture, LabelCode, View

_MOST_UNKNOWN = 0.25  # pixels of unknown coverage, relative to those of the subject, in a mask of use
_UNKNOWN = 0.49  # coverage that stands for it in files
_TOLERANCE = 0.02  # of coverages
_LEAST_CONFIDENCE = 0.02  # of a depth that is written


def write_landmarks(root: Path, detected: Capture, scheme: str) -> None:
    """Write the landmarks of one scheme of all views that have it.

    Args:
        root: folder of the written channels.
        detected: the capture with these landmarks.
        scheme: name of the scheme.
    """
    for view in detected.views:
        if scheme in view.landmarks:
            points, spread = {scheme: view.landmarks[scheme]}, {scheme: view.landmark_spread_px[scheme]}
            write_channels(root, _arrays(view, landmarks=points, landmark_spread_px=spread))


def write_masks(root: Path, capture: Capture, masks: Sequence[Float[np.ndarray, "h w"]]) -> None:
    """Write the subject's coverage in the views without a mask; not where most of the subject's border is unknown.

    Args:
        root: folder of the written channels.
        capture: whose views may lack masks.
        masks: of all views, on the pixels of their undistorted images, perhaps reduced.
    """
    for view, mask in zip(capture.views, masks, strict=True):
        unknown = uncertain(mask)
        if view.mask is None and unknown.sum() <= _MOST_UNKNOWN * (mask > 0.5).sum():
            # Below a half: a reader takes the darkest of many bright values for the subject.
            shown = np.where(unknown, np.float32(_UNKNOWN), mask)
            stored = _stored(shown, _undistorted(view.camera, mask.shape), view.camera, cv2.INTER_LINEAR)
            write_channels(root, _arrays(view, mask=stored))


def uncertain(mask: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a made mask where nothing tells subject from background."""
    return np.abs(mask - UNCERTAIN) < _TOLERANCE


def write_labels(root: Path, capture: Capture, labels: Sequence[UInt8[np.ndarray, "h w"]]) -> None:
    """Write label maps of all views; arguments as `write_masks`."""
    for view, values in zip(capture.views, labels, strict=True):
        stored = _stored(values, _undistorted(view.camera, values.shape), view.camera, cv2.INTER_NEAREST)
        write_channels(root, _arrays(view, labels=stored))


def write_depths(root: Path, capture: Capture, depths: Sequence[DepthMap | None]) -> None:
    """Write depths, normals and confidences of the views without normals; arguments as `write_masks`."""
    for view, made in zip(capture.views, depths, strict=True):
        if made is not None and not view.has_normals:
            trusted = made.confidence > _LEAST_CONFIDENCE
            kept = replace(
                made,
                depth=np.where(trusted, made.depth, 0),
                normals=np.where(trusted[..., None], made.normals, 0),
                confidence=np.where(trusted, made.confidence, 0),
            )
            write_channels(root, stored_maps(view.name, view.camera, kept))


def attach(capture: Capture, root: Path, classes: Sequence[str]) -> Capture:
    """Return the capture with the channels in a folder, where it has none of its own.

    Args:
        capture: as it was given.
        root: folder of the written channels.
        classes: names of the label maps' indices.

    Raises:
        InputError: a landmark file is damaged.
    """
    views = tuple(_attached(view, root) for view in capture.views)
    if any(view.segmentation is not None and view.segmentation.is_relative_to(root) for view in views):
        return replace(capture, views=views, classes=tuple(classes), labels=LabelCode())
    return replace(capture, views=views)


def _attached(view: View, root: Path) -> View:
    def made(folder: str, suffix: str) -> Path | None:
        path = root / folder / f"{view.name}{suffix}"
        return path if path.is_file() else None

    landmarks, depth = made("landmarks", ".json"), made("depth", ".exr")
    if landmarks is not None:
        read = read_landmarks(landmarks)
        points, spread = {**read.points, **view.landmarks}, {**read.spread_px, **view.landmark_spread_px}
        view = replace(view, landmarks=points, landmark_spread_px=spread)
    if depth is not None and not view.has_normals:
        view = replace(
            view,
            depth=depth,
            depth_unit_m=None,
            normals=made("normals", ".png"),
            normals_frame="camera_opencv",
            confidence=made("confidence", ".png"),
        )
    return replace(
        view,
        mask=view.mask or made("masks", ".png"),
        segmentation=view.segmentation or made("segmentation", ".png"),
    )


def _arrays(view: View, **channels: Any) -> ViewArrays:
    return ViewArrays(name=view.name, camera=view.camera, rgb=None, **channels)


def _undistorted(camera: Camera, shape: tuple[int, ...]) -> Camera:
    """The pinhole camera of the undistorted image, reduced to a shape."""
    return replace(camera.scaled(shape[1], shape[0]), distortion=())


def _stored(values: np.ndarray, camera: Camera, stored: Camera, interpolation: int) -> np.ndarray:
    """Resample an image of a pinhole camera to the pixels of the stored image of the same view."""
    x, y = np.meshgrid(np.arange(stored.width_px, dtype=np.float64), np.arange(stored.height_px, dtype=np.float64))
    grid = np.stack([x, y], -1).reshape(-1, 1, 2)
    coefficients = np.array(stored.distortion) if stored.distortion else None
    plane = cv2.undistortPoints(grid, opencv_intrinsics(stored.intrinsics), coefficients).reshape(*x.shape, 2)
    target = opencv_intrinsics(camera.intrinsics)
    map_x = (plane[..., 0] * target[0, 0] + plane[..., 1] * target[0, 1] + target[0, 2]).astype(np.float32)
    map_y = (plane[..., 1] * target[1, 1] + target[1, 2]).astype(np.float32)
    border = cv2.BORDER_CONSTANT
    return cv2.remap(np.ascontiguousarray(values), map_x, map_y, interpolation, borderMode=border, borderValue=(0,) * 4)
