"""Calibrations that OpenCV's FileStorage wrote: EasyMocap's `intri.yml` and `extri.yml`, or one file per camera.

Poses are world to camera in OpenCV's axes, rotations as matrices or Rodrigues vectors. OpenCV puts the centre of pixel
(0, 0) at (0, 0); half a pixel is added to the principal point. EasyMocap's unit is the metre,
https://chingswy.github.io/easymocap-public-doc/quickstart/calibration.html; other files do not state theirs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.formats.fields import Fields
from registration.formats.file_storage import read_file_storage
from registration.formats.recordings import FOLDERS, find_frame, frame_size
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView, VideoFrame

_INTRI, _EXTRI = "intri.yml", "extri.yml"
_SUFFIXES = (".yml", ".yaml")
_CALIBRATIONS = ("", "cameras", "calibration", "calib", "camera")  # folders of files of single cameras
_IMAGES = ("images", "image", "imgs", "rgb", "")
_MASKS = ("masks", "mask")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".PNG", ".JPG", ".JPEG")
_K = ("K", "camera_matrix", "cameraMatrix", "CameraMatrix", "Camera_Matrix", "intrinsic", "intrinsics", "M")
_DISTORTIONS = (
    *("dist", "D", "dist_coeffs", "distCoeffs", "dist_coeff", "distCoeff", "distortion"),
    *("distortion_coefficients", "Distortion_Coefficients"),
)
_ROTATIONS = ("R", "Rot", "rotation", "rotation_matrix", "rvec")
_TRANSLATIONS = ("T", "t", "tvec", "translation")
_TRANSFORMS = ("RT", "Rt", "extrinsic", "extrinsics", "T_cam_world")
_SIZES = (("image_width", "image_height"), ("image_Width", "image_Height"), ("W", "H"), ("width", "height"))
_SAME_ROTATION = 1e-4


def _detect(path: Path) -> bool:
    if path.is_dir() and (path / _INTRI).is_file() and (path / _EXTRI).is_file():
        return True
    return path.is_dir() and len(_camera_files(path)) > 1


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a folder with `intri.yml` and `extri.yml`, or with one YAML file per camera.

    Raises:
        InputError: a file cannot be read, a camera lacks intrinsics or a pose or has two that differ, a lens is not
            OpenCV's, or an image is missing.
    """
    easymocap = (path / _INTRI).is_file()
    cameras = _easymocap(path) if easymocap else _single_files(path)
    notes: list[str] = []
    views = tuple(_view(name, fields, path, options.frame, notes) for name, fields in cameras.items())
    return SourceCapture(
        format=FORMAT.name,
        root=path,
        subject=options.subject or path.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=1.0 if easymocap else None,
        notes=tuple(dict.fromkeys(notes)),
    )


def _easymocap(path: Path) -> dict[str, Fields]:
    """Camera's name -> its values of both files, whose names end with the camera's."""
    intri, extri = read_file_storage(path / _INTRI), read_file_storage(path / _EXTRI)
    listed = intri.values.get("names") or extri.values.get("names")
    if listed is None:
        listed = [name.removeprefix("K_") for name in intri.values if name.startswith("K_")]
    names = [str(name) for name in listed]
    if not names or len(set(names)) < len(names):
        raise intri.error("names", "the cameras' names, each once", ", ".join(names) or "none")
    cameras = {}
    for name in sorted(names, key=natural_key):
        values: dict[str, Any] = {}
        for fields in (intri, extri):
            ending = f"_{name}"
            values |= {key.removesuffix(ending): value for key, value in fields.values.items() if key.endswith(ending)}
        where = f"{intri.where} and {_EXTRI}: camera {name}"
        cameras[name] = Fields(values=values, where=where, title=intri.title, fix=intri.fix)
    return cameras


def _camera_files(path: Path) -> list[Path]:
    """YAML files that name intrinsics, in the first folder that has some."""
    for place in _CALIBRATIONS:
        folder = path / place
        files = sorted(folder.iterdir(), key=lambda file: natural_key(file.name)) if folder.is_dir() else []
        if found := [file for file in files if file.suffix.lower() in _SUFFIXES and _has_intrinsics(file)]:
            return found
    return []


def _has_intrinsics(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        start = stream.read(4096).decode("utf-8", "replace")
    return any(line.partition(":")[0].strip() in _K for line in start.splitlines())


def _single_files(path: Path) -> dict[str, Fields]:
    files = _camera_files(path)
    if not files:
        raise InputError(
            "There is no OpenCV calibration",
            where=path,
            expected=f"{_INTRI} and {_EXTRI}, or one YAML file per camera with {' or '.join(_K[:2])}",
            got="none",
            fix="check the path",
        )
    return {file.stem: read_file_storage(file) for file in files}


def _view(name: str, fields: Fields, path: Path, frame: int | None, notes: list[str]) -> SourceView:
    image = _image(name, fields, path, frame)
    width_px, height_px = _size(fields, image, notes)
    intrinsics = fields.array(_one_of(fields, _K, "intrinsics"), (3, 3))
    intrinsics[:2, 2] += 0.5
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=intrinsics,
        T_cam_world=_pose(fields),
        distortion=_distortion(fields),
        mask=_mask(path, name, image),
    )


def _one_of(fields: Fields, names: Sequence[str], what: str) -> str:
    """The name, of several in use, that the file has. Raises InputError if it has none, or two."""
    found = [name for name in names if name in fields]
    if len(found) != 1:
        raise fields.error("", f"one of {', '.join(names)} as {what}", ", ".join(found) or "none")
    return found[0]


def _size(fields: Fields, image: Path | VideoFrame, notes: list[str]) -> tuple[int, int]:
    for width, height in _SIZES:
        if width in fields or height in fields:
            return fields.size(width), fields.size(height)
    for name in ("image_size", "img_size", "imageSize"):
        if name in fields:
            size = np.ravel(fields.array(name, (2,), (1, 2), (2, 1)))
            return int(size[0]), int(size[1])
    notes.append("the calibration has no image sizes: the sizes of the images were used")
    return frame_size(image)


def _distortion(fields: Fields) -> Distortion:
    found = [name for name in _DISTORTIONS if name in fields]
    if len(found) > 1:
        raise fields.error("", "one set of distortion coefficients", ", ".join(found))
    if not found:
        return Distortion(model="none")
    values = np.ravel(fields.array(found[0], (-1,), (-1, 1), (1, -1)))
    model = str(fields.values.get("distortion_model", "")).lower()
    if model in ("equidistant", "fisheye", "kannala_brandt") or fields.values.get("fisheye_model"):
        if len(values) != 4:
            raise fields.error(found[0], "four coefficients of a fisheye lens", f"{len(values)}")
        return Distortion(model="opencv_fisheye", coefficients=tuple(values.tolist()))
    if len(values) > 8 and not values[8:].any():
        values = values[:8]
    if len(values) not in (4, 5, 8):
        expected = "4, 5 or 8 coefficients k1 k2 p1 p2 [k3 [k4 k5 k6]]; prisms and tilt are not read"
        raise fields.error(found[0], expected, f"{len(values)}")
    return Distortion(model="opencv", coefficients=tuple(values.tolist()))


def _pose(fields: Fields) -> Float[np.ndarray, "4 4"]:
    """World to camera, from a matrix, or from a rotation and a translation."""
    poses = {name: fields.array(name, (3, 4), (4, 4))[:3] for name in _TRANSFORMS if name in fields}
    rotations = {name: _rotation(fields, name) for name in _ROTATIONS if name in fields}
    if rotations:
        translation = np.ravel(fields.array(_one_of(fields, _TRANSLATIONS, "translation"), (3,), (3, 1), (1, 3)))
        poses |= {name: np.column_stack([R, translation]) for name, R in rotations.items()}
    if not poses:
        expected = f"a rotation ({', '.join(_ROTATIONS)}) with a translation, or one of {', '.join(_TRANSFORMS)}"
        raise fields.error("", expected, ", ".join(fields.values) or "nothing")
    (first, pose), *others = poses.items()
    for name, other in others:
        if not np.allclose(other, pose, atol=_SAME_ROTATION):
            raise fields.error(
                name, f"the pose that {first} has", f"one that differs by {np.abs(other - pose).max():.2g}"
            )
    return np.vstack([poses.get("Rot", pose), [0, 0, 0, 1]])  # of EasyMocap's two, the one that needs no conversion


def _rotation(fields: Fields, name: str) -> Float[np.ndarray, "3 3"]:
    value = fields.array(name, (3, 3), (3,), (3, 1), (1, 3))
    return value if value.shape == (3, 3) else np.asarray(cv2.Rodrigues(np.ravel(value))[0])


def _image(name: str, fields: Fields, path: Path, frame: int | None) -> Path | VideoFrame:
    """The image of a camera: one with its name, or one of its folder or video, by frame number."""
    if (found := find_frame([path / place for place in (*_IMAGES, *FOLDERS)], name, frame, fields.error)) is not None:
        return found
    for place in _IMAGES:
        for suffix in _IMAGE_SUFFIXES:
            if frame is None and (file := path / place / f"{name}{suffix}").is_file():
                return file
    looked = ", ".join(place or "." for place in _IMAGES)
    expected = f"an image {name}.png, .jpg or .tif, a folder {name}, or a video {name}.mp4, in one of {looked}, videos"
    raise fields.error("", expected, "none")


def _mask(path: Path, name: str, image: Path | VideoFrame) -> Path | None:
    inside = isinstance(image, Path) and image.parent.name == name
    for place in _MASKS:
        for suffix in _IMAGE_SUFFIXES:
            stem = image.stem if isinstance(image, Path) else name
            mask = path / place / (f"{name}/{stem}{suffix}" if inside else f"{name}{suffix}")
            if mask.is_file():
                return mask
    return None


FORMAT = Format(
    name="opencv",
    title="OpenCV YAML: EasyMocap, or one file per camera",
    files=f"{_INTRI} and {_EXTRI}, or one YAML file per camera",
    detect=_detect,
    read=read,
    physical=True,
    sequences=True,
)
