"""The native capture folder, written: for tests, and for studios that make captures (docs/formats.md)."""

import json
import secrets
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from scipy.spatial.transform import Rotation

from registration.capture.scan import Scan
from registration.errors import InputError
from registration.frames import linear_to_srgb
from registration.storage.mesh import write_ply
from registration.types import Camera

_MODELS = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}  # by number of distortion coefficients


@dataclass(frozen=True, kw_only=True)
class PlainView:
    """One view in memory, at the camera's full size and with its distortion."""

    name: str  # may hold subfolders, as "left/cam00"; no suffix
    camera: Camera
    rgb: Float[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W 3"]  # float is linear light
    mask: Float[np.ndarray, "H W"] | Bool[np.ndarray, "H W"] | None = None  # coverage of the subject in [0, 1]
    normals: Float[np.ndarray, "H W 3"] | None = None  # unit, camera frame; 0 where there is none
    labels: UInt8[np.ndarray, "H W"] | None = None  # index into the capture's classes
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)  # scheme -> x_px y_px confidence


def write(
    root: Path,
    views: Sequence[PlainView],
    *,
    subject: str,
    expression: str,
    classes: Sequence[str] = (),
    tags: Mapping[str, Any] | None = None,
    points: Float[np.ndarray, "P 3"] | None = None,
    scan: Scan | None = None,
    truth: Float[np.ndarray, "N 3"] | None = None,
    bits: int = 8,
) -> Path:
    """Write a whole capture folder beside `root` and move it there in one rename.

    `points` (m, world) become the COLMAP model's points; `bits` (8 or 16) is the depth of linear `rgb` on disk;
    tags are strings, numbers, booleans or lists of these. Returns `root`.
    Raises InputError if `root` exists, ValueError if an array has another size than its camera.
    """
    root = Path(root)
    if root.exists():
        raise InputError(
            "The capture folder exists already",
            where=root,
            expected="a path that is free",
            got="a file or folder",
            fix="choose another folder, or remove this one",
        )
    root.parent.mkdir(parents=True, exist_ok=True)
    fresh = root.with_name(f".{root.name}.{secrets.token_hex(4)}.tmp")
    try:
        fresh.mkdir()
        for view in views:
            _write_view(fresh, view, bits)
        _write_model(fresh / "sparse", views, points)
        _write_settings(fresh / "capture.toml", subject, expression, classes, tags or {})
        if scan is not None:
            write_ply(fresh / "scan.ply", scan.vertices, scan.triangles)
        if truth is not None:
            np.savez(fresh / "ground_truth.npz", vertices=truth)
        fresh.rename(root)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return root


def _write_view(root: Path, view: PlainView, bits: int) -> None:
    rgb = view.rgb if view.rgb.dtype.kind == "u" else _quantised(linear_to_srgb(view.rgb), bits)
    _write_png(root / "images", view, rgb)
    if view.mask is not None:
        _write_png(root / "masks", view, _quantised(view.mask.astype(np.float64), 8))
    if view.normals is not None:
        encoded = _quantised((view.normals + 1) / 2, 16)
        encoded[~view.normals.any(-1)] = 0
        _write_png(root / "normals", view, encoded)
    if view.labels is not None:
        _write_png(root / "segmentation", view, view.labels)
    if view.landmarks:
        path = _file(root / "landmarks", view, ".json")
        path.write_text(json.dumps({scheme: points.tolist() for scheme, points in view.landmarks.items()}), "utf-8")


def _quantised(share: np.ndarray, bits: int) -> np.ndarray:
    """[0, 1] to unsigned integers."""
    if bits not in (8, 16):
        raise ValueError(f"bits: expected 8 or 16, got {bits}")
    top = 2**bits - 1
    return np.round(np.clip(share, 0, 1) * top).astype(np.uint8 if bits == 8 else np.uint16)


def _write_png(folder: Path, view: PlainView, pixels: np.ndarray) -> None:
    if pixels.shape[:2] != (view.camera.height_px, view.camera.width_px):
        raise ValueError(f"{folder.name} of {view.name}: {pixels.shape[:2]} is not the camera's (height, width)")
    path = _file(folder, view, ".png")
    if not cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels):
        raise OSError(f"{path} cannot be written")


def _file(folder: Path, view: PlainView, suffix: str) -> Path:
    path = folder / f"{view.name}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_model(sparse: Path, views: Sequence[PlainView], points: Float[np.ndarray, "P 3"] | None) -> None:
    """A COLMAP text model with one camera per image and points without tracks."""
    sparse.mkdir()
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of POINTS2D[]"]
    for number, view in enumerate(views, 1):
        camera, K = view.camera, view.camera.intrinsics
        if len(camera.distortion) not in _MODELS or K[0, 1] != 0:
            raise ValueError(f"{view.name}: COLMAP has no model for this camera")
        parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion]
        parameters += [0.0] * (3 if len(camera.distortion) == 5 else 0)
        size = f"{camera.width_px} {camera.height_px}"
        cameras.append(f"{number} {_MODELS[len(camera.distortion)]} {size} {_numbers(parameters)}")
        x, y, z, w = Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_quat()
        pose = _numbers([w, x, y, z, *camera.T_cam_world[:3, 3]])
        images += [f"{number} {pose} {number} {view.name}.png", ""]
    rows = [] if points is None else points.tolist()
    lines = [f"{number} {_numbers(row)} 128 128 128 0" for number, row in enumerate(rows, 1)]
    for name, content in (("cameras", cameras), ("images", images), ("points3D", lines)):
        (sparse / f"{name}.txt").write_text("\n".join(content) + "\n", "utf-8")


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write_settings(path: Path, subject: str, expression: str, classes: Sequence[str], tags: Mapping[str, Any]) -> None:
    settings = {"subject": subject, "expression": expression, "units": "m", **tags}
    lines = [f"{json.dumps(key)} = {_toml(value)}" for key, value in settings.items()]
    if classes:
        lines += ["", "[segmentation]", f"classes = {_toml(list(classes))}"]
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _toml(value: Any) -> str:
    """A TOML value; JSON writes these few kinds alike."""
    if isinstance(value, (str, bool, int, float)) or (
        isinstance(value, (list, tuple)) and all(isinstance(item, (str, bool, int, float)) for item in value)
    ):
        return json.dumps(value, ensure_ascii=False)
    raise ValueError(f"a tag must be a string, number, boolean or a list of these, not {value!r}")
