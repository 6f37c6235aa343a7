"""Realistic errors of a capture's cameras, images, masks, labels, normals and landmarks, as functions of arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from registration.frames import linear_to_srgb, srgb_to_linear
from registration.types import Camera

FAULTS = ("shifted", "black", "exposure")  # of a view; they can be combined
SHIFT_PX = 30  # of the fault "shifted": to the right
EXPOSURE = 2.5  # of the fault "exposure": factor of linear light
# Relative size of each component of a camera's error: three rotations, three translations, the focal length.
_CAMERA_WEIGHTS = np.array([1, 1, 1, 1, 1, 1, 0.3])


@dataclass(frozen=True, kw_only=True)
class DegradationPreset:
    """Magnitude of each error. Pixels are those of the images on disk; the defaults change nothing."""

    name: str
    camera_rms_px: float = 0.0  # of the subject's points in the undistorted image, for every camera
    normal_rms_deg: float = 0.0  # smooth noise: angle to the true normal
    normal_correlation_px: float = 8.0  # the distance at which that noise's correlation has fallen to 1 / e
    normal_outliers: float = 0.0  # fraction of the pixels that have a random direction towards the camera
    normals_missing: float = 0.0  # fraction of the views that lose them
    landmark_std_px: float = 0.0  # of x and of y
    landmark_outliers: float = 0.0  # fraction of the landmarks; their confidence stays
    landmark_outlier_px: tuple[float, float] = (20.0, 80.0)  # their smallest and largest error
    boundary_px: float = 0.0  # largest growth or shrinkage of masks and classes: one sample per view and class
    gain_spread: float = 0.0  # cameras' gains are within 1 +- this, in linear light
    channel_spread: float = 0.0  # and the gains of their channels within 1 +- this of that
    noise_at_white: float = 0.0  # std of each pixel at linear 1; proportional to the square root of the light
    dropped_views: int = 0


PRESETS: Mapping[str, DegradationPreset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            DegradationPreset(name="none"),
            DegradationPreset(
                name="studio",
                camera_rms_px=0.3,
                normal_rms_deg=5.0,
                normal_outliers=0.02,
                landmark_std_px=2.0,
                landmark_outliers=0.05,
                boundary_px=2.0,
                gain_spread=0.1,
                channel_spread=0.02,
                noise_at_white=0.02,
                dropped_views=1,
            ),
            DegradationPreset(
                name="harsh",
                camera_rms_px=0.6,
                normal_rms_deg=10.0,
                normal_correlation_px=16.0,
                normal_outliers=0.04,
                normals_missing=0.25,
                landmark_std_px=4.0,
                landmark_outliers=0.1,
                boundary_px=4.0,
                gain_spread=0.2,
                channel_spread=0.04,
                noise_at_white=0.04,
                dropped_views=3,
            ),
        )
    }
)


def perturbed_camera(
    camera: Camera, points: Float[np.ndarray, "P 3"], rms_px: float, rng: np.random.Generator
) -> Camera:
    """The camera with errors of pose and focal length that move visible points (m, world) by `rms_px` in its image."""
    before, depth = camera.project(points)
    front = depth > 0
    if not (rms_px and front.any()):
        return camera

    def perturb(step: Float[np.ndarray, "7"]) -> Camera:
        """Rotate about the camera's centre (rad), translate (m, camera frame), scale focal lengths by exp(last)."""
        T_cam_world, intrinsics = camera.T_cam_world.copy(), camera.intrinsics.copy()
        T_cam_world[:3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T_cam_world[:3]
        T_cam_world[:3, 3] += step[3:6]
        intrinsics[[0, 1], [0, 1]] *= np.exp(step[6])
        return replace(camera, T_cam_world=T_cam_world, intrinsics=intrinsics)

    def change_px(step: Float[np.ndarray, "7"]) -> float:
        shift = perturb(step).project(points[front])[0] - before[front]
        return float(np.sqrt((shift**2).sum(-1).mean()))

    small = 1e-6  # within the linear range of all seven
    per_step_px = np.array([change_px(small * axis) / small for axis in np.eye(7)])
    step = rng.standard_normal(7) * _CAMERA_WEIGHTS / per_step_px
    return perturb(step * rms_px / change_px(step))


def degraded_image(
    raw: np.ndarray, preset: DegradationPreset, faults: frozenset[str], rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"]:
    """Change exposure and colour balance and add noise, in linear light; back to sRGB of the same depth."""
    top = np.iinfo(raw.dtype).max
    gain = (1 + preset.gain_spread * rng.uniform(-1, 1)) * (1 + preset.channel_spread * rng.uniform(-1, 1, 3))
    if "exposure" in faults:
        gain *= EXPOSURE
    if "black" in faults:
        return np.zeros_like(raw)
    light = srgb_to_linear(raw.astype(np.float32) / top) * gain.astype(np.float32)
    if preset.noise_at_white:
        light += preset.noise_at_white * np.sqrt(light) * rng.standard_normal(light.shape, np.float32)
    return np.round(linear_to_srgb(light) * top).astype(raw.dtype)


def degraded_mask(
    mask: UInt8[np.ndarray, "H W"], preset: DegradationPreset, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W"]:
    """Grow or shrink by up to `boundary_px`; the boundary is one pixel wide."""
    if not preset.boundary_px:
        return mask
    grown_px = preset.boundary_px * rng.uniform(-1, 1)
    coverage = np.clip(_inside_px(mask >= 128) + grown_px + 0.5, 0, 1)
    return np.round(255 * coverage).astype(np.uint8)


def degraded_labels(
    labels: UInt8[np.ndarray, "H W"], preset: DegradationPreset, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W"]:
    """Offset the signed distance of every class by a random number; each pixel gets the class with the largest.

    Where two classes touch, their boundary moves by half the difference of their offsets, at most by `boundary_px`.
    """
    if not preset.boundary_px:
        return labels
    offsets_px = 2 * preset.boundary_px * rng.uniform(-1, 1, 256)
    result, best, deep = labels.copy(), np.full(labels.shape, -np.inf, np.float32), np.zeros(labels.shape, bool)
    for index in np.unique(labels):
        inside = _inside_px(labels == index)
        deep |= inside > preset.boundary_px
        score = inside + np.float32(offsets_px[index])
        result[score > best] = index
        best = np.maximum(best, score)
    return np.where(deep, labels, result)


def _inside_px(region: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Return the distance (px) of each pixel's centre from a region's boundary; negative outside."""
    inside = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(region, inside - 0.5, 0.5 - outside).astype(np.float32)


def degraded_normals(
    raw: UInt16[np.ndarray, "H W 3"], preset: DegradationPreset, rng: np.random.Generator
) -> UInt16[np.ndarray, "H W 3"]:
    """Rotate by a smooth field of small rotations and replace outliers by random directions; background stays."""
    if not (preset.normal_rms_deg or preset.normal_outliers):
        return raw
    subject = raw.any(-1)
    normals = raw[subject] * np.float32(2 / 65535) - 1
    unit = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    # Only the component across the normal rotates it, two of three axes: hence the square root.
    std = np.float32(np.radians(preset.normal_rms_deg) / np.sqrt(2))
    rotation = (
        np.stack([_smooth(subject.shape, preset.normal_correlation_px, rng)[subject] for _ in range(3)], -1) * std
    )
    rotation -= (rotation * unit).sum(-1, keepdims=True) * unit
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    normals = np.cos(angle) * normals + np.sinc(angle / np.pi) * np.cross(rotation, normals)
    random = rng.standard_normal(normals.shape, np.float32)
    random /= np.maximum(np.linalg.norm(random, axis=-1, keepdims=True), 1e-6)
    random[:, 2] = -np.abs(random[:, 2])  # towards the camera, which looks along +z
    outlier = rng.random(len(normals)) < preset.normal_outliers
    normals[outlier] = random[outlier]
    result = np.zeros_like(raw)
    result[subject] = np.round(np.clip((normals + 1) / 2, 0, 1) * 65535).astype(np.uint16)
    return result


def _smooth(shape: tuple[int, ...], correlation_px: float, rng: np.random.Generator) -> Float[np.ndarray, "H W"]:
    """Sample a periodic Gaussian field of variance 1 whose correlation is exp(-(distance / correlation_px)^2)."""
    blurred = gaussian_filter(rng.standard_normal(shape, np.float32), correlation_px / 2, mode="wrap")
    return blurred / blurred.std()


def degraded_landmarks(
    points: Float[np.ndarray, "L 3"], preset: DegradationPreset, rng: np.random.Generator
) -> Float[np.ndarray, "L 3"]:
    """Add noise to all landmarks and large errors to outliers; all keep their confidence."""
    count = len(points)
    noise = preset.landmark_std_px * rng.standard_normal((count, 2))
    angle, distance = rng.uniform(0, 2 * np.pi, count), rng.uniform(*preset.landmark_outlier_px, count)
    outlier = rng.random(count) < preset.landmark_outliers
    noise[outlier] = (distance * [np.cos(angle), np.sin(angle)]).T[outlier]
    return points + np.column_stack([noise, np.zeros(count)])


def shifted(content: np.ndarray, shift_px: int) -> np.ndarray:
    """Shift to the right, repeating the left edge."""
    return content[:, np.maximum(np.arange(content.shape[1]) - shift_px, 0)]
