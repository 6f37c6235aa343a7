"""Rigs with known errors, and how far two rigs differ but for what no image shows."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.colmap import read_points, write_model
from registration.types import Camera, Capture


def write_capture_with_cameras(
    source: Capture, target: Path, cameras: Mapping[str, Camera], *, geometry: bool = True
) -> Path:
    """Write a copy of a capture with other cameras.

    Args:
        source: the capture.
        target: the folder; it must not exist.
        cameras: view's name -> its camera.
        geometry: with normals, depths and labels; else images, masks and landmarks alone, and the scan to measure with.

    Returns:
        `target`.
    """
    left_out = ("sparse", *(() if geometry else ("normals", "depth", "confidence", "segmentation")))
    shutil.copytree(source.root, target, ignore=shutil.ignore_patterns(*left_out))
    images = source.root / "images"
    names = {view.image.relative_to(images).as_posix(): cameras[view.name] for view in source.views}
    write_model(target / "sparse", names, *read_points(source.root / "sparse"))
    return target


def rig_errors_px(
    cameras: Sequence[Camera], true: Sequence[Camera], points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "N"]:
    """Return the rms shift of points in each image between two rigs, px, but for a similarity of the world.

    The small rotation, translation and scale of all points that explains most of the shifts is taken out: it moves the
    subject with the rig, and no image tells it.

    Args:
        cameras: without regard to distortion.
        true: the same cameras of the other rig.
        points: of the subject, world, metres.
    """
    centred, step = points - points.mean(0), 1e-6
    moves = [
        *(np.cross(axis, centred) for axis in np.eye(3)),
        *(np.tile(a, (len(points), 1)) for a in np.eye(3)),
        centred,
    ]
    shift = np.stack([a.project(points)[0] - b.project(points)[0] for a, b in zip(cameras, true, strict=True)])
    columns = [
        np.stack([camera.project(points + step * move)[0] - camera.project(points)[0] for camera in true]) / step
        for move in moves
    ]
    matrix = np.stack([column.ravel() for column in columns], 1)
    left = shift - (matrix @ np.linalg.lstsq(matrix, shift.ravel(), rcond=None)[0]).reshape(shift.shape)
    return np.sqrt(np.square(left).sum(-1).mean(-1))
