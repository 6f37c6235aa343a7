"""Depth, normal and confidence maps as stereo makes them, from a scan: with its noise, outliers and holes."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.native import read_capture
from registration.capture.native_writer import ViewArrays, write_channels
from registration.capture.scan import read_scan
from registration.geometry.surface_views import SurfaceView, SurfaceViews
from registration.types import Camera

_GRAIN_PX = 3.0  # standard deviation of what noise is smoothed with
_BLOB_PX = 6.0  # of what holes and outliers are made of


@dataclass(frozen=True, kw_only=True)
class StereoErrors:
    """How wrong the maps are."""

    depth_mm: float = 0.25  # standard deviation
    normals_deg: float = 4.0  # rms angle
    outliers: float = 0.07  # share of the pixels, in blobs
    outlier_mm: tuple[float, float] = (1.0, 5.0)
    missing: float = 0.25  # share of the pixels, in blobs


CLEAN = StereoErrors(depth_mm=0.0, normals_deg=0.0, outliers=0.0, missing=0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoMaps:
    """Those of one view; 0 where there is nothing."""

    depth: Float[np.ndarray, "H W"]  # along the optical axis, metres
    normals: Float[np.ndarray, "H W 3"]  # camera frame
    confidence: Float[np.ndarray, "H W"]


def stereo_maps(seen: SurfaceView, camera: Camera, errors: StereoErrors, rng: np.random.Generator) -> StereoMaps:
    """What stereo would make of a surface; confidences are lower where the depth is wrong, on average."""
    shape = seen.depth.shape
    wrong = _blobs(shape, errors.outliers, rng)
    sign = np.where(_smooth(shape, 4 * _BLOB_PX, rng) > 0, 1.0, -1.0)
    low, high = errors.outlier_mm
    away = sign * (low + (high - low) * 0.5 * (1 + np.tanh(_smooth(shape, 4 * _BLOB_PX, rng))))
    error_mm = errors.depth_mm * _smooth(shape, _GRAIN_PX, rng) + wrong * away
    known = (seen.weight > 0) & ~_blobs(shape, errors.missing, rng)
    depth = np.where(known, np.where(known, seen.depth, 0) + 1e-3 * error_mm, 0)
    axis = np.stack([_smooth(shape, _GRAIN_PX, rng) for _ in range(3)], -1)  # of a rotation
    angle = np.radians(errors.normals_deg) * np.where(wrong, 4.0, 1.0)[..., None] / np.sqrt(2)
    normals = seen.normals @ camera.T_cam_world[:3, :3].T
    normals = normals + angle * np.cross(axis, normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    doubt = np.abs(error_mm) / 0.5 * rng.uniform(0.5, 2.0, shape) if errors.depth_mm else np.zeros(shape)
    confidence = np.clip(1.1 / (1 + cv2.GaussianBlur(doubt, (0, 0), 2.0) ** 2), 0, 1)
    return StereoMaps(depth=depth, normals=normals * known[..., None], confidence=confidence * known)


def with_stereo(
    source: Path, target: Path, errors: StereoErrors, *, without: tuple[str, ...] = (), parts: tuple[str, ...]
) -> Path:
    """Copy a capture that has a scan, with such maps in place of its normals.

    Args:
        source: without distortion.
        target: the folder to write.
        errors: of the maps.
        without: folders that are left out, besides `normals`.
        parts: of `normals`, `depth` and `confidence`, those that are written.
    """
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("normals", *without))
    if "segmentation" in without:
        settings = (target / "capture.toml").read_text(encoding="utf-8")
        (target / "capture.toml").write_text(settings.split("[segmentation]")[0], encoding="utf-8")
    capture = read_capture(source)
    assert capture.scan is not None
    scan = read_scan(capture.scan)
    surface = SurfaceViews(scan.vertices, scan.triangles, [view.camera for view in capture.views])
    for number, view in enumerate(capture.views):
        assert not view.camera.distortion
        maps = stereo_maps(surface.view(view.camera), view.camera, errors, np.random.default_rng([21, number]))
        channels = {part: getattr(maps, part) for part in parts}
        write_channels(target, ViewArrays(name=view.name, camera=view.camera, rgb=None, **channels))
    return target


def _smooth(shape: tuple[int, ...], sigma_px: float, rng: np.random.Generator) -> Float[np.ndarray, "H W"]:
    """Gaussian noise of this grain and unit variance."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma_px)
    return noise / noise.std()


def _blobs(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> Bool[np.ndarray, "H W"]:
    """Blobs that cover this share of an image."""
    noise = _smooth(shape, _BLOB_PX, rng)
    return noise > np.quantile(noise, 1 - share) if share else np.zeros(shape, bool)
