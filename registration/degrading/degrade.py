"""Degrade a clean capture with realistic errors, to measure the robustness of a registration (docs/formats.md).

The copy has errors of calibration, of estimated normals, labels and landmarks, and of sensors. Scan and ground truth
stay, so that the loss of accuracy can be measured. The random numbers of a view depend on the seed and on its index in
the capture only, not on the preset or on faults of other views.
"""

import json
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture import native, pixels, triangulation
from registration.capture.colmap import read_points, write_model
from registration.capture.dense_maps import is_colmap_map
from registration.capture.landmark_files import write_landmarks
from registration.capture.native_writer import check_new
from registration.capture.scan import read_scan
from registration.capture.settings_text import without_tables
from registration.degrading import degradation
from registration.degrading.degradation import FAULTS, DegradationPreset
from registration.doctor.validation import validate_capture
from registration.errors import InputError, check_seed
from registration.storage.files import atomic_directory
from registration.types import Camera, Capture, Colour, View

MIN_VIEWS = 2  # of a capture
_TAG = "spoiled"  # key in the copy's capture.toml
_SUBJECT_POINTS = 2000  # over which a camera's error is measured


def degrade(
    source: Path,
    target: Path,
    *,
    preset: DegradationPreset,
    seed: int = 0,
    faults: Mapping[str, Collection[str]] = MappingProxyType({}),
) -> Path:
    """Write a degraded copy of a native capture, which appears in one rename. Equal arguments give equal files.

    Every image becomes a PNG of its depth; files that are not part of a capture are not copied.

    Args:
        source: the capture folder.
        target: the folder of the copy; it must not exist.
        preset: the magnitudes of errors.
        seed: of the random numbers.
        faults: view's name -> some of `FAULTS`; these views are never dropped.

    Returns:
        `target`.

    Raises:
        InputError: `target` exists, the source is not a valid capture or is degraded already, a view or fault is
            unknown, or too few views would remain. Nothing is written then.
    """
    source, target = Path(source), Path(target)
    check_new(target)
    check_seed(seed)
    capture = native.read_capture(source)
    validate_capture(capture)
    _check(capture, preset, faults)
    dropped, without_normals = _sample_views(capture, preset, seed, faults)
    points = _subject_points(capture) if preset.camera_rms_px else np.zeros((0, 3))
    with atomic_directory(target) as temporary:
        cameras = {}
        for number, view in enumerate(capture.views, 1):
            if view.name in dropped:
                continue
            rngs = np.random.default_rng([seed, number]).spawn(6)
            cameras[f"{view.name}.png"] = degradation.perturbed_camera(
                view.camera, points, preset.camera_rms_px, rngs[0]
            )
            source_view = replace(view, normals=None) if view.name in without_normals else view
            errors = _ViewErrors(preset=preset, faults=frozenset(faults.get(view.name, ())), rngs=rngs[1:])
            _write_view(temporary, source_view, capture, errors)
        _write_cameras(temporary / "sparse", cameras, source / "sparse")
        _write_settings(temporary / "capture.toml", capture, _description(preset, seed, dropped, faults))
        for file in (capture.scan, capture.ground_truth):
            if file is not None:
                shutil.copyfile(file, temporary / file.name)
    return target


def _check(capture: Capture, preset: DegradationPreset, faults: Mapping[str, Collection[str]]) -> None:
    where = capture.root
    if _TAG in capture.tags:
        got, fix = capture.tags[_TAG], "degrade the capture that it was made from"
        raise InputError("The capture is degraded already", where=where, expected="a clean capture", got=got, fix=fix)
    if any(view.depth or view.confidence or (view.normals and is_colmap_map(view.normals)) for view in capture.views):
        expected, fix = "normal maps as PNG, or none", "take the maps out of the source"
        got = "depth maps, confidence maps or maps of COLMAP"
        raise InputError("Dense maps cannot be degraded", where=where, expected=expected, got=got, fix=fix)
    names = [view.name for view in capture.views]
    for name, kinds in faults.items():
        if name not in names:
            raise InputError("There is no such view", where=where, expected=", ".join(names), got=name)
        if unknown := sorted(set(kinds) - set(FAULTS)):
            expected = ", ".join(FAULTS)
            raise InputError("There is no such fault", where=name, expected=expected, got=", ".join(unknown))
    droppable = min(len(names) - MIN_VIEWS, len(names) - len(faults))
    if preset.dropped_views > droppable:
        raise InputError(
            "Too few views would remain",
            where=where,
            expected=f"{preset.dropped_views} views without a fault to drop, and at least {MIN_VIEWS} others",
            got=f"{len(names)} views, {len(faults)} of them with faults",
            fix="choose a milder preset, or add views",
        )


def _sample_views(
    capture: Capture, preset: DegradationPreset, seed: int, faults: Mapping[str, Collection[str]]
) -> tuple[frozenset[str], frozenset[str]]:
    """The views that are dropped, and those of the others that lose their normals."""
    order = [capture.views[i] for i in np.random.default_rng([seed, 0]).permutation(len(capture.views))]
    dropped = frozenset([view.name for view in order if view.name not in faults][: preset.dropped_views])
    left = [view.name for view in reversed(order) if view.name not in dropped and view.normals is not None]
    return dropped, frozenset(left[: round(preset.normals_missing * len(left))])


def _subject_points(capture: Capture) -> Float[np.ndarray, "P 3"]:
    """Points of the subject (m, world): of the scan, or else the triangulated landmarks."""
    if capture.scan is not None:
        points = read_scan(capture.scan).vertices
    else:
        schemes = sorted({scheme for view in capture.views for scheme in view.landmarks})
        landmarks = [triangulation.triangulate(capture, scheme)[0] for scheme in schemes]
        points = np.concatenate([np.zeros((0, 3)), *landmarks])
        points = points[np.isfinite(points).all(-1)]
    if len(points) < 3:
        raise InputError(
            "The position of the subject is unknown",
            where=capture.root,
            expected="a scan, or landmarks in two views",
            got="neither",
            fix="add one, or choose a preset without camera errors",
        )
    return points[:: -(-len(points) // _SUBJECT_POINTS)]


@dataclass(frozen=True, kw_only=True)
class _ViewErrors:
    """The errors of one view."""

    preset: DegradationPreset
    faults: frozenset[str]
    rngs: list[np.random.Generator]  # of image, mask, normals, labels and landmarks


def _write_view(root: Path, view: View, capture: Capture, errors: _ViewErrors) -> None:
    preset = errors.preset
    for_image, for_mask, for_normals, for_labels, for_landmarks = errors.rngs
    shift_px = degradation.SHIFT_PX if "shifted" in errors.faults else 0
    image = pixels.read_image(view.image, view.camera, view.colour)
    files = {"images": degradation.degraded_image(image, preset, errors.faults, for_image)}
    if view.mask is not None:
        files["masks"] = degradation.degraded_mask(pixels.read_mask(view.mask, view.camera), preset, for_mask)
    if view.normals is not None:
        files["normals"] = degradation.degraded_normals(
            pixels.read_normals(view.normals, view.camera), preset, for_normals
        )
    if view.segmentation is not None:
        labels = pixels.read_labels(view.segmentation, view.camera, capture.classes, capture.labels)
        files["segmentation"] = degradation.degraded_labels(labels, preset, for_labels)
    for folder, content in files.items():
        _write_png(root / folder / f"{view.name}.png", degradation.shifted(content, shift_px))
    if view.landmarks:
        degraded = {
            scheme: degradation.degraded_landmarks(points, preset, for_landmarks) + [shift_px, 0, 0]
            for scheme, points in sorted(view.landmarks.items())
        }
        spreads = {
            scheme: np.hypot(spread_px, preset.landmark_std_px) for scheme, spread_px in view.landmark_spread_px.items()
        }
        write_landmarks(root / "landmarks" / f"{view.name}.json", degraded, spreads)


def _write_png(path: Path, content: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), content[..., ::-1] if content.ndim == 3 else content):
        raise OSError(f"{path} cannot be written")


def _write_cameras(sparse: Path, cameras: Mapping[str, Camera], source: Path) -> None:
    """Write the COLMAP model, with the points of the source's model."""
    write_model(sparse, cameras, *read_points(source))


def _description(
    preset: DegradationPreset, seed: int, dropped: Collection[str], faults: Mapping[str, Collection[str]]
) -> str:
    """The value of the copy's tag, in one line."""
    parts = [f"preset {preset.name}, seed {seed}"]
    parts += [f"dropped {', '.join(sorted(dropped, key=native.natural_key))}"] if dropped else []
    parts += [f"{name} {' '.join(sorted(kinds))}" for name, kinds in sorted(faults.items())]
    return "; ".join(parts)


def _write_settings(path: Path, capture: Capture, description: str) -> None:
    """Write the source's settings after the new tag: a top-level key must precede any table."""
    source = capture.root / "capture.toml"
    settings = source.read_text("utf-8-sig")
    changed = set()
    if capture.labels.indices or capture.labels.colours:  # the copy's label maps hold positions in the classes
        changed.add("segmentation")
    if any(view.colour != Colour() for view in capture.views):  # the copy's images are sRGB
        changed.add("colour")
    settings = without_tables(source, settings, changed)
    if "segmentation" in changed:
        settings += f"\n[segmentation]\nclasses = {json.dumps(capture.classes)}\n"
    path.write_text(f"{_TAG} = {json.dumps(description, ensure_ascii=False)}\n{settings}", "utf-8")
