"""The native capture folder, read: `capture.toml`, a COLMAP model, and image files beside it (docs/formats.md)."""

import json
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

from registration.capture.headers import require_size
from registration.errors import InputError
from registration.types import Camera, Capture, View

_RESERVED = ("subject", "expression", "units", "segmentation")
_NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(nan|inf(inity)?)(?![\w.])", re.IGNORECASE)
# COLMAP's parameters -> (fx, fy, cx, cy, OpenCV distortion in the order k1 k2 p1 p2 k3 k4 k5 k6)
_MODELS: dict[str, Callable[..., tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: (f, f, cx, cy),
    "PINHOLE": lambda fx, fy, cx, cy: (fx, fy, cx, cy),
    "SIMPLE_RADIAL": lambda f, cx, cy, k1: (f, f, cx, cy, k1, 0.0, 0.0, 0.0),
    "RADIAL": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2, 0.0, 0.0),
    "OPENCV": lambda *parameters: parameters,
    "FULL_OPENCV": lambda *parameters: parameters,
}


def read(root: Path) -> Capture:
    """Read a native capture folder; of images only the headers. Views come in natural order of their names.

    Raises InputError for a broken `capture.toml`, COLMAP model or landmark file, an unsupported camera model, a
    singular or non-finite pose, a missing image, an image of another size than its camera's, and a symbolic link that
    leads out of the folder: a capture may come from anyone, and must not make us read what is not in it.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(
            "The capture folder is missing",
            where=root,
            expected="a folder with capture.toml and sparse/",
            got="no such folder",
            fix="check the path",
        )
    settings = _read_settings(_inside(root, root / "capture.toml"))
    for path in (root / "sparse", *sorted((root / "sparse").glob("*"))):
        _inside(root, path)
    cameras = read_cameras(root / "sparse")
    views = tuple(_read_view(root, name, cameras[name]) for name in sorted(cameras, key=natural_key))
    _check_names(root, views)
    scan, truth = root / "scan.ply", root / "ground_truth.npz"
    return Capture(
        root=root,
        subject=settings["subject"],
        expression=settings["expression"],
        views=views,
        classes=tuple(settings.get("segmentation", {}).get("classes", ())),
        tags={key: value for key, value in settings.items() if key not in _RESERVED},
        scan=_optional(root, scan),
        ground_truth=_optional(root, truth),
    )


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts cam2 before cam10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def read_cameras(sparse: Path) -> dict[str, Camera]:
    """The cameras of a COLMAP model (text or binary) by image name. Raises InputError as `read` does."""
    if not sparse.is_dir():
        raise InputError(
            "The COLMAP model is missing",
            where=sparse,
            expected="cameras, images and points3D as .txt or .bin",
            got="no such folder",
            fix="store the calibration there; architecture: docs/formats.md",
        )
    try:
        model = pycolmap.Reconstruction(str(sparse))
    except (ValueError, IndexError, RuntimeError) as error:
        raise _unreadable_model(sparse, error) from None
    cameras: dict[str, Camera] = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.name in cameras:
            raise InputError(
                "Two images of the COLMAP model have one name",
                where=sparse,
                expected="unique names",
                got=image.name,
                fix="rename one of them",
            )
        where = f"{sparse}: image {image.name}"
        cameras[image.name] = _camera(image.camera, _pose(image, where), where)
    return cameras


def _camera(source: pycolmap.Camera, T_cam_world: Float[np.ndarray, "4 4"], where: str) -> Camera:
    if source.model_name not in _MODELS:
        raise InputError(
            "The camera model is not supported",
            where=where,
            expected=", ".join(_MODELS),
            got=source.model_name,
            fix="undistort the images with COLMAP's image_undistorter, or calibrate with a supported model",
        )
    fx, fy, cx, cy, *distortion = _MODELS[source.model_name](*map(float, source.params))
    if not all(map(math.isfinite, (fx, fy, cx, cy, *distortion))) or fx <= 0 or fy <= 0:
        raise InputError(
            "The intrinsics are singular or not finite",
            where=where,
            expected="finite numbers, focal lengths > 0",
            got=source.params_to_string(),
            fix="calibrate the camera again",
        )
    if not (0 < source.width < 2**16 and 0 < source.height < 2**16):
        raise InputError(
            "The camera's image size is absurd",
            where=where,
            expected="1 to 65535 px a side",
            got=f"{source.width} x {source.height}",
            fix="write the image's size into the COLMAP model",
        )
    return Camera(
        width_px=source.width,
        height_px=source.height,
        intrinsics=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        T_cam_world=T_cam_world,
        distortion=tuple(distortion) if any(distortion) else (),
    )


def _pose(image: pycolmap.Image, where: str) -> Float[np.ndarray, "4 4"]:
    pose = image.cam_from_world() if image.has_pose else None
    quaternion = np.zeros(4) if pose is None else np.array(pose.rotation.quat)
    T_cam_world = np.eye(4)
    if pose is not None:
        T_cam_world[:3] = pose.matrix()
    # pycolmap turns a zero quaternion into the identity without a word: only the quaternion itself tells.
    if not np.isfinite(T_cam_world).all() or not np.linalg.norm(quaternion) > 1e-6:
        raise InputError(
            "The pose is singular or not finite",
            where=where,
            expected="a unit quaternion and a finite translation",
            got="no pose" if pose is None else f"quaternion xyzw {quaternion}, translation {pose.translation}",
            fix="calibrate the camera again, or remove its image from the COLMAP model",
        )
    return T_cam_world


def _read_view(root: Path, file_name: str, camera: Camera) -> View:
    relative = PurePosixPath(file_name)
    if relative.is_absolute() or ".." in relative.parts or not relative.suffix:
        raise InputError(
            "An image name cannot be used",
            where=root / "sparse",
            expected="a path inside images/, with a suffix",
            got=file_name,
            fix="rename the image",
        )
    image = _inside(root, root / "images" / relative)
    require_size(image, "image", camera.width_px, camera.height_px)
    landmarks = _optional(root, root / "landmarks" / relative.with_suffix(".json"))
    return View(
        name=str(relative.with_suffix("")),
        camera=camera,
        image=image,
        mask=_optional(root, root / "masks" / relative.with_suffix(".png")),
        normals=_optional(root, root / "normals" / relative.with_suffix(".png")),
        segmentation=_optional(root, root / "segmentation" / relative.with_suffix(".png")),
        landmarks={} if landmarks is None else read_landmarks(landmarks),
    )


def _optional(root: Path, path: Path) -> Path | None:
    return _inside(root, path) if path.is_file() else None


def _inside(root: Path, path: Path) -> Path:
    """The path itself, if it stays within the capture when symbolic links are followed."""
    if not (target := path.resolve()).is_relative_to(root.resolve()):
        raise InputError(
            "A link leads out of the capture",
            where=path,
            expected="a file inside the capture's folder",
            got=f"a link to {target}",
            fix="put the file itself there",
        )
    return path


def _check_names(root: Path, views: tuple[View, ...]) -> None:
    lengths: dict[str, tuple[int, str]] = {}
    for first, second in zip(views, views[1:], strict=False):
        if first.name == second.name:
            raise InputError(
                "Two images differ in their suffix only",
                where=root / "images",
                expected="names that stay unique without it: masks and landmarks are found by them",
                got=f"{first.image.name} and {second.image.name}",
                fix="rename one of them",
            )
    for view in views:
        for scheme, points in view.landmarks.items():
            count, name = lengths.setdefault(scheme, (len(points), view.name))
            if len(points) != count:
                raise InputError(
                    "A landmark scheme has two lengths",
                    where=root / "landmarks" / f"{view.name}.json",
                    expected=f'{count} points in scheme "{scheme}", as for {name}',
                    got=f"{len(points)} points",
                    fix="give every view the whole scheme, with confidence 0 where a point is not seen",
                )


def read_landmarks(path: Path) -> dict[str, Float[np.ndarray, "L 3"]]:
    """Landmark schemes of one view: scheme -> (x_px, y_px, confidence) rows, distorted pixels."""

    def refuse(expected: str, got: object) -> InputError:
        return InputError(
            "The landmark file is malformed",
            where=path,
            expected=expected,
            got=got,
            fix='write {"<scheme>": [[x_px, y_px, confidence], ...]}',
        )

    try:
        content = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise refuse("JSON", error) from None
    if not isinstance(content, dict):
        raise refuse("an object of schemes", type(content).__name__)
    landmarks = {}
    for scheme, rows in content.items():
        try:
            points = np.array(rows, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise refuse(f'three numbers a point in scheme "{scheme}"', error) from None
        if points.ndim != 2 or points.shape[1] != 3:
            raise refuse(f'three numbers a point in scheme "{scheme}"', f"an array of shape {points.shape}")
        if not np.isfinite(points).all():
            broken = int(np.argwhere(~np.isfinite(points))[0, 0])
            raise refuse(f'finite numbers in scheme "{scheme}"', f"point {broken}: {rows[broken]}")
        landmarks[scheme] = points
    return landmarks


def _read_settings(path: Path) -> dict[str, Any]:
    def refuse(what: str, expected: str, got: object) -> InputError:
        return InputError(what, where=path, expected=expected, got=got, fix="see the capture folder in docs/formats.md")

    try:
        settings = tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise refuse("capture.toml is missing", "subject, expression and units", "no such file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise refuse("capture.toml cannot be read", "TOML", error) from None
    for key in ("subject", "expression"):
        if not isinstance(settings.get(key), str):
            raise refuse(f'capture.toml lacks "{key}"', f'{key} = "..."', settings.get(key, "nothing"))
    if settings.get("units") != "m":
        raise refuse("The units are not metres", 'units = "m"', settings.get("units", "nothing"))
    segmentation = settings.get("segmentation", {})
    classes = segmentation.get("classes", []) if isinstance(segmentation, dict) else None
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise refuse("The segmentation classes are malformed", 'classes = ["background", ...]', segmentation)
    if len(set(classes)) != len(classes):
        raise refuse("A segmentation class is named twice", "unique names", ", ".join(classes))
    return settings


def _unreadable_model(sparse: Path, error: Exception) -> InputError:
    """COLMAP's own messages name neither line nor reason, so look for the usual one: a number that is none."""
    for path in (sparse / "cameras.txt", sparse / "images.txt"):
        lines = path.read_text("utf-8", "replace").splitlines() if path.is_file() else []
        for number, line in enumerate(lines, 1):
            if not line.startswith("#") and _NOT_FINITE.search(line):
                return InputError(
                    "The intrinsics are singular or not finite"
                    if path.stem == "cameras"
                    else "The pose is singular or not finite",
                    where=f"{path}, line {number}",
                    expected="finite numbers",
                    got=line[:120],
                    fix="calibrate the camera again, or remove its image from the COLMAP model",
                )
    return InputError(
        "The COLMAP model cannot be read",
        where=sparse,
        expected="cameras, images and points3D as .txt or .bin, as COLMAP writes them",
        got=error,
        fix="export the model again with COLMAP's model_converter",
    )
