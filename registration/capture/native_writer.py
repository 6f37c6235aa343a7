"""Write native capture folders (docs/formats.md), as synthetic studios and tests do."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from registration.capture.colmap import write_model
from registration.capture.colour_settings import colours_to_toml
from registration.capture.landmark_files import write_landmarks
from registration.capture.scan import Scan
from registration.errors import InputError
from registration.frames import linear_to_srgb
from registration.storage.exr_files import write_exr_depth
from registration.storage.files import atomic_directory
from registration.storage.mesh import write_ply
from registration.types import Camera, Colour, HeadPose


@dataclass(frozen=True, kw_only=True)
class ViewArrays:
    """One view in memory, at the camera's full size and with its distortion."""

    name: str  # may hold subfolders, as "left/cam00"; no suffix
    camera: Camera
    # Float is linear light; None: the image is not written.
    rgb: Float[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"] | None
    mask: Float[np.ndarray, "H W"] | Bool[np.ndarray, "H W"] | None = None  # coverage of the subject in [0, 1]
    normals: Float[np.ndarray, "H W 3"] | None = None  # unit, camera frame; 0 where there is none
    depth: Float[np.ndarray, "H W"] | None = None  # along the optical axis, metres; 0 where there is none
    confidence: Float[np.ndarray, "H W"] | None = None  # of normals and depth, in [0, 1]
    labels: UInt8[np.ndarray, "H W"] | None = None  # index into the capture's classes
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)  # scheme -> x_px y_px confidence
    landmark_spread_px: Mapping[str, Float[np.ndarray, "L"]] = field(default_factory=dict)  # of schemes that have it


@dataclass(frozen=True, kw_only=True)
class CaptureDescription:
    """What `capture.toml` says."""

    subject: str
    expression: str
    classes: Sequence[str] = ()  # names of the label maps' indices
    tags: Mapping[str, Any] = field(default_factory=dict)  # strings, numbers, booleans, lists or tables of these
    photographs: bool = True  # whether the images' colours count
    head: HeadPose | None = None  # where a fit without landmarks starts
    colours: Mapping[str, Colour] = field(default_factory=dict)  # view's name -> of its image; the rest is sRGB


def write_capture(
    root: Path,
    views: Sequence[ViewArrays],
    description: CaptureDescription,
    *,
    points: Float[np.ndarray, "P 3"] | None = None,
    scan: Scan | None = None,
    truth: Float[np.ndarray, "N 3"] | None = None,
    bits: int = 8,
) -> Path:
    """Write a capture folder, which appears in one rename.

    Args:
        root: the folder; it must not exist.
        views: the images and their cameras.
        description: of the capture.
        points: points of the COLMAP model, metres, world.
        scan: of the subject, metres, world.
        truth: the true vertices of the subject, metres, world.
        bits: 8 or 16, the depth of linear `rgb` on disk.

    Returns:
        `root`.

    Raises:
        InputError: `root` exists.
        ValueError: an array has another size than its camera, or COLMAP has no model for a camera.
    """
    root = Path(root)
    check_new(root)
    with atomic_directory(root) as temporary:
        for view in views:
            write_channels(temporary, view, bits)
        cameras = {f"{view.name}.png": view.camera for view in views}
        write_model(temporary / "sparse", cameras, np.zeros((0, 3)) if points is None else points)
        write_settings(temporary / "capture.toml", description)
        if scan is not None:
            write_ply(temporary / "scan.ply", scan.vertices, scan.triangles)
        if truth is not None:
            np.savez(temporary / "ground_truth.npz", vertices=truth)
    return root


def check_new(root: Path) -> None:
    """Refuse a capture folder that exists, before anything is computed. Raises InputError."""
    if root.exists():
        raise InputError(
            "The capture folder exists already",
            where=root,
            expected="a path that does not exist",
            got="a file or folder",
            fix="choose another folder, or remove this one",
        )


def write_channels(root: Path, view: ViewArrays, bits: int = 8) -> None:
    """Write the files of one view into a capture folder; `bits` as in `write_capture`."""
    if view.rgb is not None:
        rgb = view.rgb if view.rgb.dtype.kind == "u" else _quantized(linear_to_srgb(view.rgb), bits)
        _write_png(root / "images", view, rgb)
    if view.mask is not None:
        _write_png(root / "masks", view, _quantized(view.mask.astype(np.float64), 8))
    if view.normals is not None:
        encoded = _quantized((view.normals + 1) / 2, 16)
        encoded[~view.normals.any(-1)] = 0
        _write_png(root / "normals", view, encoded)
    if view.depth is not None:
        _check_size(root / "depth", view, view.depth)
        write_exr_depth(_file(root / "depth", view, ".exr"), view.depth)
    if view.confidence is not None:
        _write_png(root / "confidence", view, _quantized(view.confidence.astype(np.float64), 8))
    if view.labels is not None:
        _write_png(root / "segmentation", view, view.labels)
    if view.landmarks:
        write_landmarks(_file(root / "landmarks", view, ".json"), view.landmarks, view.landmark_spread_px)


def _quantized(values: np.ndarray, bits: int) -> np.ndarray:
    """Convert [0, 1] to unsigned integers."""
    if bits not in (8, 16):
        raise ValueError(f"bits: expected 8 or 16, got {bits}")
    top = 2**bits - 1
    return np.round(np.clip(values, 0, 1) * top).astype(np.uint8 if bits == 8 else np.uint16)


def _write_png(folder: Path, view: ViewArrays, pixels: np.ndarray) -> None:
    _check_size(folder, view, pixels)
    path = _file(folder, view, ".png")
    if not cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels):
        raise OSError(f"{path} cannot be written")


def _check_size(folder: Path, view: ViewArrays, pixels: np.ndarray) -> None:
    if pixels.shape[:2] != (view.camera.height_px, view.camera.width_px):
        raise ValueError(f"{folder.name} of {view.name}: {pixels.shape[:2]} is not the camera's (height, width)")


def _file(folder: Path, view: ViewArrays, suffix: str) -> Path:
    path = folder / f"{view.name}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def write_settings(path: Path, description: CaptureDescription) -> None:
    """Write a `capture.toml`. Raises ValueError for a tag that is no string, number, boolean, or list of these."""
    settings = {"subject": description.subject, "expression": description.expression, "units": "m", **description.tags}
    settings |= {} if description.photographs else {"photographs": False}
    lines = [f"{json.dumps(key)} = {_toml(value)}" for key, value in settings.items()]
    if description.classes:
        lines += ["", "[segmentation]", f"classes = {_toml(list(description.classes))}"]
    if description.head is not None:
        lines += ["", "[head]", f"rotation = {_toml(description.head.rotation.ravel().tolist())}"]
        lines += [f"translation = {_toml(description.head.translation.tolist())}"]
        lines += [f"scale = {_toml(description.head.scale)}"]
    lines += colours_to_toml(description.colours)
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _toml(value: Any) -> str:
    """Return a TOML value; JSON writes these few types alike, but for tables."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (str, bool, int, float)) or (
        isinstance(value, (list, tuple)) and all(isinstance(item, (str, bool, int, float)) for item in value)
    ):
        return json.dumps(value, ensure_ascii=False)
    raise ValueError(f"a tag must be a string, number, boolean, or a list or table of these, not {value!r}")
