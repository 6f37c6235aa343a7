"""Spoiled copies of good captures, to see how a registration stands what real ones have (docs/formats.md).

A copy has the errors of a calibration, of estimated normals, labels and landmarks, and of sensors. The scan and the
truth stay, so that whatever the registration of the copy loses can be measured. All random numbers of a view follow
from the seed and the view's place in the capture: other presets and other broken views leave them alone.
"""

import json
import shutil
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float, UInt8, UInt16
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from registration.capture import doctor, native, pixels, triangulation
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.frames import linear_to_srgb, srgb_to_linear
from registration.types import Camera, Capture, View

SHIFT_PX = 30  # of a view that is broken as "shifted": to the right
EXPOSURE = 2.5  # of one that is broken as "exposure": factor of linear light
BREAKS = ("shifted", "black", "exposure")  # how a view can be broken; several at once go together
LEAST_VIEWS = 2  # that a copy must have: a capture with fewer is none
_TAG = "spoiled"
_SUBJECT_POINTS = 2000  # over which a camera's error is measured
# How much each way of being off counts in a camera's error: three turns, three moves, the focal length.
_CAMERA_SHARES = np.array([1, 1, 1, 1, 1, 1, 0.3])
_LENSES = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}  # COLMAP's names by number of distortion coefficients


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How much of each error. Pixels are those of the images as they lie on disk; the defaults change nothing."""

    name: str
    camera_rms_px: float = 0.0  # of the subject's points in the undistorted image, for every camera
    normal_rms_deg: float = 0.0  # smooth noise: angle between a normal and the true one
    normal_correlation_px: float = 8.0  # the distance at which that noise's correlation has fallen to 1 / e
    normal_outliers: float = 0.0  # share of the pixels that show any direction towards the camera
    normals_missing: float = 0.0  # share of the views that have none
    landmark_std_px: float = 0.0  # of x and of y
    landmark_outliers: float = 0.0  # share of the landmarks; their confidence stays
    landmark_outlier_px: tuple[float, float] = (20.0, 80.0)  # the least and the most that they are off
    boundary_px: float = 0.0  # the most by which masks and classes grow or shrink: one draw per view and class
    gain_spread: float = 0.0  # cameras' gains are within 1 +- this, in linear light
    channel_spread: float = 0.0  # and their channels within 1 +- this of that
    noise_at_white: float = 0.0  # standard deviation at linear 1 of each pixel; grows with the root of the light
    dropped_views: int = 0


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            Preset(name="none"),
            Preset(
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
            Preset(
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


def spoil(
    source: Path,
    target: Path,
    *,
    preset: Preset,
    seed: int = 0,
    breaks: Mapping[str, Collection[str]] = MappingProxyType({}),
) -> Path:
    """Write a spoiled copy of the native capture `source` beside `target` and move it there in one rename.

    `breaks` names views and how they are broken, each by some of `BREAKS`; they are never dropped. Equal arguments
    give equal files. Every image becomes a PNG of its depth; files that are no part of a capture are left behind.
    Returns `target`. Raises InputError, before anything is written, if `target` exists, the source is no sound
    capture or a spoiled one, a broken view is unknown, or too few views would be left.
    """
    source, target = Path(source), Path(target)
    if target.exists():
        raise _wrong("The capture folder exists already", target, "a path that is free", "a file or folder")
    if seed < 0:
        raise _wrong("The seed is out of range", "seed", "a whole number from 0", seed)
    capture = native.read(source)
    doctor.validate(capture)
    _check(capture, preset, breaks)
    dropped, bare = _unlucky(capture, preset, seed, breaks)
    points = _subject(capture) if preset.camera_rms_px else np.zeros((0, 3))
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as beside:
        fresh = Path(beside) / "capture"
        fresh.mkdir()
        cameras = {}
        for number, view in enumerate(capture.views, 1):
            if view.name in dropped:
                continue
            broken = frozenset(breaks.get(view.name, ()))
            rngs = np.random.default_rng([seed, number]).spawn(6)
            cameras[view.name] = _moved(view.camera, points, preset.camera_rms_px, rngs[0])
            bare_view = replace(view, normals=None) if view.name in bare else view
            _write_view(fresh, bare_view, capture.classes, preset, broken, rngs[1:])
        _write_model(fresh / "sparse", cameras, source / "sparse")
        _write_settings(fresh / "capture.toml", source / "capture.toml", _told(preset, seed, dropped, breaks))
        for file in (capture.scan, capture.ground_truth):
            if file is not None:
                shutil.copyfile(file, fresh / file.name)
        fresh.rename(target)
    return target


def _wrong(what: str, where: object, expected: object, got: object, fix: str = "change it") -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


def _check(capture: Capture, preset: Preset, breaks: Mapping[str, Collection[str]]) -> None:
    if _TAG in capture.tags:
        fix = "spoil the capture that it was made from"
        raise _wrong("The capture is a spoiled one", capture.root, "a good capture", capture.tags[_TAG], fix)
    names = [view.name for view in capture.views]
    for name, kinds in breaks.items():
        if name not in names:
            raise _wrong("There is no such view to break", capture.root, ", ".join(names), name)
        if unknown := sorted(set(kinds) - set(BREAKS)):
            raise _wrong("A view cannot be broken like this", name, ", ".join(BREAKS), ", ".join(unknown))
    droppable = min(len(names) - LEAST_VIEWS, len(names) - len(breaks))
    if preset.dropped_views > droppable:
        expected = f"{preset.dropped_views} views that are not broken and may go, and {LEAST_VIEWS} at least that stay"
        got = f"{len(names)} views, {len(breaks)} of them to be broken"
        raise _wrong("Too few views would be left", capture.root, expected, got, "take a milder preset or more views")


def _unlucky(
    capture: Capture, preset: Preset, seed: int, breaks: Mapping[str, Collection[str]]
) -> tuple[frozenset[str], frozenset[str]]:
    """The views that are dropped, and those of the others that lose their normals."""
    order = [capture.views[i] for i in np.random.default_rng([seed, 0]).permutation(len(capture.views))]
    dropped = frozenset([view.name for view in order if view.name not in breaks][: preset.dropped_views])
    left = [view.name for view in reversed(order) if view.name not in dropped and view.normals is not None]
    return dropped, frozenset(left[: round(preset.normals_missing * len(left))])


def _subject(capture: Capture) -> Float[np.ndarray, "P 3"]:
    """Points of the subject (m, world): of the scan, or else the triangulated landmarks."""
    if capture.scan is not None:
        points = read_scan(capture.scan).vertices
    else:
        schemes = sorted({scheme for view in capture.views for scheme in view.landmarks})
        found = [triangulation.triangulate(capture, scheme)[0] for scheme in schemes]
        points = np.concatenate([np.zeros((0, 3)), *found])
        points = points[np.isfinite(points).all(-1)]
    if len(points) < 3:
        expected, fix = "a scan, or landmarks in two views", "add one, or take a preset that leaves the cameras alone"
        raise _wrong("Nothing tells where the subject is", capture.root, expected, "neither", fix)
    return points[:: -(-len(points) // _SUBJECT_POINTS)]


def _moved(camera: Camera, points: Float[np.ndarray, "P 3"], rms_px: float, rng: np.random.Generator) -> Camera:
    """The camera with a wrong pose and focal length: points (m, world) before it move by `rms_px` in its image."""
    before, depth = camera.project(points)
    front = depth > 0
    if not (rms_px and front.any()):
        return camera

    def stepped(step: Float[np.ndarray, "7"]) -> Camera:
        """Turned about the camera's centre (rad), moved (m, camera frame), focal lengths times exp of the last."""
        T_cam_world, intrinsics = camera.T_cam_world.copy(), camera.intrinsics.copy()
        T_cam_world[:3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T_cam_world[:3]
        T_cam_world[:3, 3] += step[3:6]
        intrinsics[[0, 1], [0, 1]] *= np.exp(step[6])
        return replace(camera, T_cam_world=T_cam_world, intrinsics=intrinsics)

    def moved_px(step: Float[np.ndarray, "7"]) -> float:
        shift = stepped(step).project(points[front])[0] - before[front]
        return float(np.sqrt((shift**2).sum(-1).mean()))

    tiny = 1e-6  # small enough for all seven to be linear
    per_step_px = np.array([moved_px(tiny * axis) / tiny for axis in np.eye(7)])
    step = rng.standard_normal(7) * _CAMERA_SHARES / per_step_px
    return stepped(step * rms_px / moved_px(step))


def _write_view(
    root: Path,
    view: View,
    classes: tuple[str, ...],
    preset: Preset,
    broken: frozenset[str],
    rngs: list[np.random.Generator],
) -> None:
    for_image, for_mask, for_normals, for_labels, for_landmarks = rngs
    shift_px = SHIFT_PX if "shifted" in broken else 0
    files = {"images": _spoiled_image(pixels.read_colour(view.image, view.camera), preset, broken, for_image)}
    if view.mask is not None:
        files["masks"] = _spoiled_mask(pixels.read_mask(view.mask, view.camera), preset, for_mask)
    if view.normals is not None:
        files["normals"] = _spoiled_normals(pixels.read_normals(view.normals, view.camera), preset, for_normals)
    if view.segmentation is not None:
        labels = pixels.read_labels(view.segmentation, view.camera, classes)
        files["segmentation"] = _spoiled_labels(labels, preset, for_labels)
    for folder, content in files.items():
        _write_png(root / folder / f"{view.name}.png", _shifted(content, shift_px))
    if view.landmarks:
        spoiled = {
            scheme: _spoiled_landmarks(points, preset, for_landmarks) + [shift_px, 0, 0]
            for scheme, points in sorted(view.landmarks.items())
        }
        path = root / "landmarks" / f"{view.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({scheme: points.tolist() for scheme, points in spoiled.items()}), "utf-8")


def _spoiled_image(
    raw: np.ndarray, preset: Preset, broken: frozenset[str], rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"]:
    """Another exposure and colour balance, and noise; in linear light, back to sRGB of the same depth."""
    top = np.iinfo(raw.dtype).max
    gain = (1 + preset.gain_spread * rng.uniform(-1, 1)) * (1 + preset.channel_spread * rng.uniform(-1, 1, 3))
    if "exposure" in broken:
        gain *= EXPOSURE
    if "black" in broken:
        return np.zeros_like(raw)
    light = srgb_to_linear(raw.astype(np.float32) / top) * gain.astype(np.float32)
    if preset.noise_at_white:
        light += preset.noise_at_white * np.sqrt(light) * rng.standard_normal(light.shape, np.float32)
    return np.round(linear_to_srgb(light) * top).astype(raw.dtype)


def _spoiled_mask(mask: UInt8[np.ndarray, "H W"], preset: Preset, rng: np.random.Generator) -> UInt8[np.ndarray, "H W"]:
    """Grown or shrunk by a fraction of `boundary_px`; its rim is a pixel wide."""
    if not preset.boundary_px:
        return mask
    grown_px = preset.boundary_px * rng.uniform(-1, 1)
    coverage = np.clip(_inside_px(mask >= 128) + grown_px + 0.5, 0, 1)
    return np.round(255 * coverage).astype(np.uint8)


def _spoiled_labels(
    labels: UInt8[np.ndarray, "H W"], preset: Preset, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W"]:
    """Every class claims more or less than it has; the strongest claim wins.

    Where two classes touch, their boundary moves by half the difference of what they claim, at most by `boundary_px`.
    """
    if not preset.boundary_px:
        return labels
    claims_px = 2 * preset.boundary_px * rng.uniform(-1, 1, 256)
    result, best, deep = labels.copy(), np.full(labels.shape, -np.inf, np.float32), np.zeros(labels.shape, bool)
    for index in np.unique(labels):
        inside = _inside_px(labels == index)
        deep |= inside > preset.boundary_px
        claim = inside + np.float32(claims_px[index])
        result[claim > best] = index
        best = np.maximum(best, claim)
    return np.where(deep, labels, result)


def _inside_px(region: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How far (px) each pixel's centre lies inside a region's boundary; negative outside."""
    inside = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(region, inside - 0.5, 0.5 - outside).astype(np.float32)


def _spoiled_normals(
    raw: UInt16[np.ndarray, "H W 3"], preset: Preset, rng: np.random.Generator
) -> UInt16[np.ndarray, "H W 3"]:
    """Turned by a smooth field of small rotations, some replaced by any direction; the background stays."""
    if not (preset.normal_rms_deg or preset.normal_outliers):
        return raw
    subject = raw.any(-1)
    normals = raw[subject] * np.float32(2 / 65535) - 1
    unit = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    # The part of the rotation vector across the normal turns it: two of three axes, hence the root.
    spread = np.float32(np.radians(preset.normal_rms_deg) / np.sqrt(2))
    turn = np.stack([_smooth(subject.shape, preset.normal_correlation_px, rng)[subject] for _ in range(3)], -1) * spread
    turn -= (turn * unit).sum(-1, keepdims=True) * unit
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    normals = np.cos(angle) * normals + np.sinc(angle / np.pi) * np.cross(turn, normals)
    anything = rng.standard_normal(normals.shape, np.float32)
    anything /= np.maximum(np.linalg.norm(anything, axis=-1, keepdims=True), 1e-6)
    anything[:, 2] = -np.abs(anything[:, 2])  # towards the camera, which looks along +z
    outlier = rng.random(len(normals)) < preset.normal_outliers
    normals[outlier] = anything[outlier]
    result = np.zeros_like(raw)
    result[subject] = np.round(np.clip((normals + 1) / 2, 0, 1) * 65535).astype(np.uint16)
    return result


def _smooth(shape: tuple[int, ...], correlation_px: float, rng: np.random.Generator) -> Float[np.ndarray, "H W"]:
    """A Gaussian field of variance 1 whose correlation is exp(-(distance / correlation_px)^2); periodic."""
    blurred = gaussian_filter(rng.standard_normal(shape, np.float32), correlation_px / 2, mode="wrap")
    return blurred / blurred.std()


def _spoiled_landmarks(
    points: Float[np.ndarray, "L 3"], preset: Preset, rng: np.random.Generator
) -> Float[np.ndarray, "L 3"]:
    """Noise on all, some far off; all keep their confidence."""
    count = len(points)
    noise = preset.landmark_std_px * rng.standard_normal((count, 2))
    angle, distance = rng.uniform(0, 2 * np.pi, count), rng.uniform(*preset.landmark_outlier_px, count)
    outlier = rng.random(count) < preset.landmark_outliers
    noise[outlier] = (distance * [np.cos(angle), np.sin(angle)]).T[outlier]
    return points + np.column_stack([noise, np.zeros(count)])


def _shifted(content: np.ndarray, shift_px: int) -> np.ndarray:
    """Moved to the right; what comes in is what stood at the left edge."""
    return content[:, np.maximum(np.arange(content.shape[1]) - shift_px, 0)]


def _write_png(path: Path, content: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), content[..., ::-1] if content.ndim == 3 else content):
        raise OSError(f"{path} cannot be written")


def _write_model(sparse: Path, cameras: Mapping[str, Camera], source: Path) -> None:
    """A COLMAP text model of one camera per image, with the points of the source's model but not their tracks."""
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), 1):
        K = camera.intrinsics
        lens = pycolmap.Camera(
            camera_id=number,
            model=_LENSES[len(camera.distortion)],
            width=camera.width_px,
            height=camera.height_px,
            params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion],
        )
        model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=f"{name}.png", camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.T_cam_world[:3]))
    for _, point in sorted(pycolmap.Reconstruction(str(source)).points3D.items()):
        model.add_point3D(point.xyz, pycolmap.Track(), point.color)
    sparse.mkdir()
    model.write_text(str(sparse))


def _told(preset: Preset, seed: int, dropped: Collection[str], breaks: Mapping[str, Collection[str]]) -> str:
    """What was done, in one line: the copy's tag."""
    parts = [f"preset {preset.name}, seed {seed}"]
    parts += [f"dropped {', '.join(sorted(dropped, key=native.natural_key))}"] if dropped else []
    parts += [f"{name} {' '.join(sorted(kinds))}" for name, kinds in sorted(breaks.items())]
    return "; ".join(parts)


def _write_settings(path: Path, source: Path, told: str) -> None:
    """The source's settings as they are, after the new tag: a top-level key must stand before any table."""
    settings = source.read_text("utf-8")
    path.write_text(f"{_TAG} = {json.dumps(told, ensure_ascii=False)}\n{settings}", "utf-8")
