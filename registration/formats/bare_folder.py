"""A folder of images with `cameras.npz`: intrinsics and poses as arrays, for those who have a calibration of their own.

    K                        (N, 3, 3) px; (3, 3) for all images with `shared_intrinsics = True`
    T_cam_world              (N, 4, 4) or (N, 3, 4), world to camera; or else
    T_world_cam              the same, camera to world
    names                    (N,) image files, relative to images/ or to the folder; or cameras, each with a folder of
                             numbered images or a video NAME.mp4 there or in videos/
    distortion               (N, 4), (N, 5) or (N, 8), OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; optional
    sizes                    (N, 2) width and height of the calibrated images, px; optional
    axes                     "opencv" (x right, y down, z forward) or "opengl" (x right, y up, z backwards); optional
    pixel_centre             coordinate of the first pixel's centre in K: 0.5 or, as in OpenCV, 0; optional
    unit_m                   metres per world unit; optional

Masks and landmarks lie as in a native capture, and so does a scan.
"""

import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.landmark_files import ViewLandmarks, read_landmarks
from registration.capture.scan import SCANS
from registration.errors import InputError
from registration.formats.fields import number_array
from registration.formats.files import find_image, view_names
from registration.formats.nerfstudio import OPENGL_TO_OPENCV
from registration.formats.recordings import FOLDERS, find_frame, frame_size
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView, VideoFrame
from registration.storage.npz import NpzSchema
from registration.storage.reading import open_file

FILE = "cameras.npz"
_SHAPES = {
    "K": ((-1, 3, 3), (3, 3)),
    "T_cam_world": ((-1, 4, 4), (-1, 3, 4)),
    "T_world_cam": ((-1, 4, 4), (-1, 3, 4)),
    "distortion": ((-1, 4), (-1, 5), (-1, 8)),
    "sizes": ((-1, 2),),
    "pixel_centre": ((),),
    "unit_m": ((),),
}
_TEXTS = ("names", "axes", "shared_intrinsics")
_MASKS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_SCHEMA = NpzSchema(title="camera file", fix="see docs/formats.md", fields={}, max_bytes=2**28)


def _detect(path: Path) -> bool:
    file = path / FILE if path.is_dir() else path
    if file.suffix != ".npz" or not file.is_file():
        return False
    try:
        with open_file(file, _refuse(file)) as stream:
            names = zipfile.ZipFile(stream).namelist()
    except (InputError, zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
    return "K.npy" in names


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a folder with `cameras.npz`, or the NPZ file itself, whose folder then holds the images.

    Raises:
        InputError: the file cannot be read, an array is missing, unknown, of another shape, or not finite; both poses
            or no poses are given; or an image is missing.
    """
    file = path / FILE if path.is_dir() else path
    folder = file.parent
    arrays = _arrays(file)
    refuse = _refuse(file)
    names = _names(arrays, refuse)
    images = [_image(folder, name, options.frame, refuse) for name in names]
    count = len(images)
    for name in ("T_cam_world", "T_world_cam", "distortion", "sizes"):
        if name in arrays and len(arrays[name]) != count:
            raise refuse(expected=f"{name} of {count} rows, one for each name", got=f"{len(arrays[name])} rows")
    notes: list[str] = []
    sizes = _sizes(arrays, images, notes)
    intrinsics = _intrinsics(arrays, count, sizes, refuse)
    poses = _poses(arrays, refuse)
    lenses = arrays.get("distortion", np.zeros((count, 0)))
    views = tuple(
        SourceView(
            name=name,
            image=image,
            width_px=int(size[0]),
            height_px=int(size[1]),
            intrinsics=K,
            T_cam_world=pose,
            distortion=Distortion(model="opencv", coefficients=tuple(lens.tolist())),
            mask=_mask(folder, name, image),
            landmarks={} if marks is None else marks.points,
            landmark_spread_px={} if marks is None else marks.spread_px,
        )
        for name, image, size, K, pose, lens in zip(
            _view_names(names, images, folder), images, sizes, intrinsics, poses, lenses, strict=True
        )
        for marks in [_landmarks(folder / "landmarks" / f"{name}.json")]
    )
    return SourceCapture(
        format=FORMAT.name,
        root=folder,
        subject=options.subject or folder.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=_unit(arrays, refuse),
        scan=next((scan for name in SCANS if (scan := folder / name).is_file()), None),
        notes=tuple(notes),
    )


def _refuse(file: Path) -> "partial[InputError]":
    return partial(InputError, "The camera file cannot be used", where=file, fix="see docs/formats.md for its arrays")


def _arrays(file: Path) -> dict[str, np.ndarray]:
    arrays, refuse = _SCHEMA.read(file), _refuse(file)
    if unknown := sorted(set(arrays) - set(_SHAPES) - set(_TEXTS)):
        raise refuse(expected=", ".join((*_SHAPES, *_TEXTS)), got=f"the unknown array {unknown[0]}")
    return {
        name: number_array(
            array, _SHAPES[name], lambda want, got, name=name: refuse(expected=f"{name} as {want}", got=got)
        )
        if name in _SHAPES
        else array
        for name, array in arrays.items()
    }


def _names(arrays: Mapping[str, np.ndarray], refuse: "partial[InputError]") -> list[str]:
    names = arrays.get("names")
    if names is None or names.dtype.kind != "U" or names.ndim != 1 or not len(names):
        got = "none" if names is None else f"an array of type {names.dtype} and shape {names.shape}"
        raise refuse(expected="names, the image files as text, one for each camera", got=got)
    return [str(name) for name in names]


def _view_names(names: list[str], images: list[Path | VideoFrame], folder: Path) -> list[str]:
    """The names of the views: those of the files, or of the cameras of which frames were taken."""
    files = [image for image in images if isinstance(image, Path)]
    if len(files) < len(images) or any(image.parent.name == name for image, name in zip(files, names, strict=True)):
        return names
    return view_names(files, folder)


def _landmarks(file: Path) -> ViewLandmarks | None:
    return read_landmarks(file) if file.is_file() else None


def _mask(folder: Path, name: str, image: Path | VideoFrame) -> Path | None:
    within = [f"{name}/{image.stem}"] if isinstance(image, Path) and image.parent.name == name else []
    masks = [folder / "masks" / f"{part}{suffix}" for part in (*within, name) for suffix in _MASKS]
    return next((mask for mask in masks if mask.is_file()), None)


def _image(folder: Path, name: str, frame: int | None, refuse: "partial[InputError]") -> Path | VideoFrame:
    def error(entry: str, expected: object, got: object) -> InputError:
        return refuse(expected=f"{entry}: {expected}", got=got)

    if (recorded := find_frame([folder / p for p in ("images", "", *FOLDERS)], name, frame, error)) is not None:
        return recorded
    if frame is not None:
        raise error(name, f"a folder or a video of camera {name}, of which --frame takes one", "none")
    if (folder / "images" / name).is_file():
        return folder / "images" / name
    return find_image(folder, name, error, "names", suffixes=(".png", ".jpg", ".jpeg", ".tif", ".tiff"))


def _sizes(
    arrays: Mapping[str, np.ndarray], images: list[Path | VideoFrame], notes: list[str]
) -> Float[np.ndarray, "N 2"]:
    if "sizes" in arrays:
        return arrays["sizes"]
    notes.append(f"{FILE} has no sizes: the sizes of the images were used")
    return np.array([frame_size(image) for image in images], np.float64)


def _intrinsics(
    arrays: Mapping[str, np.ndarray], count: int, sizes: Float[np.ndarray, "N 2"], refuse: "partial[InputError]"
) -> Float[np.ndarray, "N 3 3"]:
    if "K" not in arrays:
        raise refuse(expected="K, (N, 3, 3) px", got="none")
    K = arrays["K"]
    if K.ndim == 2:
        if not bool(arrays.get("shared_intrinsics", False)):
            expected = "a K for each image, (N, 3, 3), or shared_intrinsics = True for one camera that took all"
            raise refuse(expected=expected, got="one K of shape (3, 3)")
        if len(different := np.unique(sizes, axis=0)) > 1:
            got = " and ".join(f"{int(w)} x {int(h)} px" for w, h in different[:2])
            raise refuse(expected="a K for each image: images of several sizes have several", got=f"one K, {got}")
        K = np.repeat(K[None], count, 0)
    elif len(K) != count:
        raise refuse(expected=f"K of {count} rows, one for each name", got=f"{len(K)} rows")
    centre = float(arrays.get("pixel_centre", 0.5))
    if centre not in (0.0, 0.5):
        raise refuse(expected="pixel_centre 0 or 0.5", got=centre)
    shifted = K.copy()
    shifted[:, :2, 2] += 0.5 - centre
    return shifted


def _poses(arrays: Mapping[str, np.ndarray], refuse: "partial[InputError]") -> Float[np.ndarray, "N 4 4"]:
    given = [name for name in ("T_cam_world", "T_world_cam") if name in arrays]
    if len(given) != 1:
        expected = "T_cam_world (world to camera) or T_world_cam (camera to world)"
        raise refuse(expected=expected, got="both" if given else "neither")
    poses: np.ndarray = np.tile(np.eye(4), (len(arrays[given[0]]), 1, 1))
    poses[:, :3] = arrays[given[0]][:, :3]
    if given[0] == "T_world_cam":
        singular = np.flatnonzero(np.abs(np.linalg.det(poses)) < 1e-9)
        if len(singular):
            raise refuse(expected="poses that can be inverted", got=f"row {singular[0]} of T_world_cam is singular")
        poses = np.linalg.inv(poses)
    axes = str(arrays.get("axes", "opencv"))
    if axes not in ("opencv", "opengl"):
        raise refuse(expected='axes "opencv" or "opengl"', got=axes)
    return OPENGL_TO_OPENCV @ poses if axes == "opengl" else poses


def _unit(arrays: Mapping[str, np.ndarray], refuse: "partial[InputError]") -> float | None:
    if "unit_m" not in arrays:
        return None
    if (unit_m := float(arrays["unit_m"])) <= 0:
        raise refuse(expected="unit_m, metres per world unit, above 0", got=unit_m)
    return unit_m


FORMAT = Format(
    name="bare",
    title="folder of images with cameras.npz",
    files=f"{FILE} with K, a pose and names",
    detect=_detect,
    read=read,
    physical=True,
    sequences=True,
)
