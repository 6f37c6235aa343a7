"""Read and write COLMAP models: the cameras of a capture.

Our own reader, since pycolmap's wheel contains GPL code (docs/adr/0006-no-gpl-by-default.md).
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from registration.capture.colmap_binary import read_binary_model, read_binary_points
from registration.capture.colmap_model import ColmapCamera, ColmapImage, ColmapModel, Pose
from registration.capture.colmap_text import read_text_model, read_text_points
from registration.errors import InputError
from registration.types import Camera

# COLMAP's parameters -> (fx, fy, cx, cy, OpenCV distortion in the order k1 k2 p1 p2 k3 k4 k5 k6)
INTRINSICS: dict[str, Callable[..., tuple[float, ...]]] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: (f, f, cx, cy),
    "PINHOLE": lambda fx, fy, cx, cy: (fx, fy, cx, cy),
    "SIMPLE_RADIAL": lambda f, cx, cy, k1: (f, f, cx, cy, k1, 0.0, 0.0, 0.0),
    "RADIAL": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2, 0.0, 0.0),
    "OPENCV": lambda *parameters: parameters,
    "FULL_OPENCV": lambda *parameters: parameters,
}
_TWO_FOCALS = frozenset(
    ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
    + ("DIVISION", "FISHEYE", "EUCM")
)
_WRITTEN = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}  # by number of distortion coefficients
_READERS = {"bin": read_binary_model, "txt": read_text_model}
_NEEDED = ("cameras", "images")  # files of a model; points, rigs and frames may be missing
_GREY = 128  # colour of points that have none
_FAR_M, _MAX_ROUNDING, _MAX_MOVED_M = (
    1e3,
    1e-4,
    5e-4,
)  # of a world; of quaternions that are meant to be of length 1; of a camera
_SAME_POSE, _ROUNDING = 1e-6, 1e-11  # of entries of two matrices of one pose, metres and cosines; relative


@dataclass(frozen=True, kw_only=True)
class PosedImage:
    """An image of a model: its camera, with any lens, and its pose."""

    camera: ColmapCamera
    T_cam_world: Float[np.ndarray, "4 4"]
    where: str  # the camera's file and line or record, and the image


def read_cameras(sparse: Path) -> dict[str, Camera]:
    """Read the cameras of a COLMAP model, text or binary, in `sparse` or `sparse/0`.

    Returns:
        Image's file name -> its camera.

    Raises:
        InputError: as `read_images`; a camera model is not supported, or intrinsics are singular or not finite.
    """
    return {name: _camera(image) for name, image in read_images(sparse).items()}


def read_images(sparse: Path) -> dict[str, PosedImage]:
    """Read the images of a COLMAP model as `read_cameras`, with lenses of any model.

    Returns:
        Image's file name -> its camera and pose.

    Raises:
        InputError: the model cannot be read, is there twice with other cameras, two images have one name, a quaternion
            is too coarse for a far world, or a pose is singular, not finite, or not that of the frames.
    """
    images: dict[str, PosedImage] = {}
    model = _read_model(_model_folder(sparse))
    _check_frames(model)
    for image in sorted(model.images, key=lambda image: image.name):
        if image.name in images:
            raise InputError(
                "Two images of the COLMAP model have one name",
                where=sparse,
                expected="unique names",
                got=image.name,
                fix="rename one of them",
            )
        where = f"{image.where}: image {image.name}"
        if image.camera_id not in model.cameras:
            raise InputError(
                "An image of the COLMAP model has no camera",
                where=where,
                expected=f"one of {len(model.cameras)} cameras' ids",
                got=image.camera_id,
                fix="add the camera, or correct the image's camera id",
            )
        camera = model.cameras[image.camera_id]
        pose = _matrix((image.quaternion_wxyz, image.translation), where)
        _check_digits(image, where)
        where = f"{camera.where}: image {image.name}"
        images[image.name] = PosedImage(camera=camera, T_cam_world=pose, where=where)
    return images


def read_points(sparse: Path) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Read the points of a COLMAP model.

    Returns:
        Positions (metres, world) and sRGB colours; none if the model has no file of points.

    Raises:
        InputError: the file of points is malformed.
    """
    folder = _model_folder(sparse)
    if os.path.lexists(folder / "points3D.bin"):
        return read_binary_points(folder / "points3D.bin")
    if os.path.lexists(folder / "points3D.txt"):
        return read_text_points(folder / "points3D.txt")
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def write_model(
    sparse: Path,
    cameras: Mapping[str, Camera],
    points: Float[np.ndarray, "P 3"],
    colours: UInt8[np.ndarray, "P 3"] | None = None,
) -> None:
    """Write a COLMAP text model of one camera per image and of points without tracks.

    Args:
        sparse: the folder; it must not exist.
        cameras: image's file name -> its camera.
        points: metres, world.
        colours: of the points; None: grey.

    Raises:
        ValueError: COLMAP has no model for a camera: it has skew, or another number of distortion coefficients than 0,
            4, 5 or 8.
    """
    lenses = _header("Camera list with one line of data per camera", "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")
    images = _header(
        "Image list with two lines of data per image", "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    )
    images.append("#   POINTS2D[] as (X, Y, POINT3D_ID)")
    for number, (name, camera) in enumerate(cameras.items(), 1):
        K, count = camera.intrinsics, len(camera.distortion)
        if count not in _WRITTEN or K[0, 1] != 0:
            raise ValueError(f"{name}: COLMAP has no model for this camera")
        parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion, *[0.0] * (3 if count == 5 else 0)]
        lenses.append(f"{number} {_WRITTEN[count]} {camera.width_px} {camera.height_px} {_numbers(parameters)}")
        x, y, z, w = Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_quat(canonical=True)
        images += [f"{number} {_numbers((w, x, y, z, *camera.T_cam_world[:3, 3]))} {number} {name}", ""]
    shades = np.full((len(points), 3), _GREY, np.uint8) if colours is None else colours
    columns = "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    rows = _header("3D point list with one line of data per point", columns)
    for number, (point, shade) in enumerate(zip(points, shades, strict=True), 1):
        rows.append(f"{number} {_numbers(point)} {' '.join(map(str, shade))} 0")
    sparse.mkdir()
    for file, lines in (("cameras.txt", lenses), ("images.txt", images), ("points3D.txt", rows)):
        (sparse / file).write_text("\n".join(lines) + "\n", "utf-8")


def _header(content: str, columns: str) -> list[str]:
    return [f"# {content}:", f"#   {columns}"]


def _numbers(values: object) -> str:
    """Return numbers with all their digits."""
    return " ".join(f"{value:.17g}" for value in np.asarray(values, np.float64))


def _model_folder(sparse: Path) -> Path:
    """The folder that holds the model: `sparse` itself, or `sparse/0`, where COLMAP's mapper writes its first one."""
    if not sparse.is_dir():
        raise InputError(
            "The COLMAP model is missing",
            where=sparse,
            expected="cameras, images and points3D as .txt or .bin",
            got="no such folder",
            fix="store the calibration there; see docs/formats.md",
        )
    if not _kinds(sparse) and _kinds(sparse / "0"):
        if others := [path.name for path in sparse.iterdir() if path.name != "0" and _kinds(path)]:
            raise InputError(
                "There are several COLMAP models",
                where=sparse,
                expected="one model, in this folder or in its folder 0",
                got=", ".join(["0", *sorted(others)]),
                fix="move the files of the one to use into this folder",
            )
        return sparse / "0"
    return sparse


def _kinds(folder: Path) -> list[str]:
    """Which of the two kinds of files hold cameras and images."""
    return [kind for kind in ("bin", "txt") if all((folder / f"{name}.{kind}").is_file() for name in _NEEDED)]


def _read_model(folder: Path) -> ColmapModel:
    """Read the model; one that is there as text and as binary must be the same."""
    kinds = _kinds(folder)
    if not kinds:
        raise InputError(
            "The COLMAP model cannot be read",
            where=folder,
            expected="cameras and images, both as .txt or both as .bin, as COLMAP writes them",
            got=", ".join(sorted(path.name for path in folder.iterdir())) or "an empty folder",
            fix="export the model again with COLMAP's model_converter",
        )
    model = _READERS[kinds[0]](folder)
    copies = [(folder, kind) for kind in kinds[1:]] + [(folder / "0", kind) for kind in _kinds(folder / "0")]
    for place, kind in copies:
        if name := _difference(model, _READERS[kind](place)):
            raise InputError(
                "The COLMAP model is there twice, with other cameras",
                where=folder,
                expected="one model, or the same as .bin and as .txt, and in the folder 0",
                got=f"images.{kinds[0]} and {(place / f'images.{kind}').relative_to(folder)} differ in {name}",
                fix="remove the files that are out of date",
            )
    return model


def _difference(first: ColmapModel, second: ColmapModel) -> str | None:
    """Where two models differ by more than rounding: the name of an image."""

    def rows(model: ColmapModel) -> dict[str, np.ndarray]:
        table = {}
        for image in model.images:
            camera = model.cameras.get(image.camera_id)
            numbers = (*image.quaternion_wxyz, *image.translation, *(camera.parameters if camera else ()))
            size = (camera.width_px, camera.height_px) if camera else ()
            table[image.name] = np.array([*numbers, *size], np.float64)
        return table

    ours, theirs = rows(first), rows(second)
    for name in sorted(ours.keys() | theirs.keys()):
        a, b = ours.get(name), theirs.get(name)
        if a is None or b is None or a.shape != b.shape or not np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True):
            return f"image {name}"
    return None


def _check_frames(model: ColmapModel) -> None:
    """Compare the images' poses with those of rigs and frames, where the model has these: neither wins silently."""
    images = {image.id: image for image in model.images}
    for frame in model.frames:
        for camera_id, image_id in frame.images:
            image = images.get(image_id)
            if image is None:  # its view was removed
                continue
            key = (frame.rig_id, camera_id)
            if key not in model.sensors_from_rig and (model.sensors_from_rig or len(frame.images) > 1):
                continue  # without rigs a camera that is alone in its frame is the frame
            where = f"{image.where}: image {image.name}"
            rig_from_world = _matrix((frame.quaternion_wxyz, frame.translation), f"frame of image {image.name}")
            sensor = model.sensors_from_rig.get(key)
            expected = (
                rig_from_world if sensor is None else _matrix(sensor, f"rig of image {image.name}") @ rig_from_world
            )
            pose = _matrix((image.quaternion_wxyz, image.translation), where)
            tolerance = _SAME_POSE + _ROUNDING * np.abs(pose).max()  # of far worlds, whose translations are large
            if not np.allclose(pose, expected, rtol=0, atol=tolerance):
                raise InputError(
                    "An image's pose is not that of its frame",
                    where=where,
                    expected="one pose in the files of images and of rigs and frames",
                    got=f"poses that differ by up to {np.abs(pose - expected).max():.3g}",
                    fix="remove the rigs' and frames' files if the images' poses are right, or export the model again",
                )


def _camera(image: PosedImage) -> Camera:
    source, where = image.camera, image.where
    if source.model not in INTRINSICS:
        raise InputError(
            "The camera model is not supported",
            where=where,
            expected=", ".join(INTRINSICS),
            got=source.model,
            fix="undistort the capture with `gnmreg capture import`, which takes other lenses: masks, normals, labels "
            "and landmarks likewise; or calibrate with a supported model, OPENCV or FULL_OPENCV for wide lenses",
        )
    check_camera(image)
    fx, fy, cx, cy, *distortion = INTRINSICS[source.model](*source.parameters)
    return Camera(
        width_px=source.width_px,
        height_px=source.height_px,
        intrinsics=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        T_cam_world=image.T_cam_world,
        distortion=tuple(distortion) if any(distortion) else (),
    )


def check_camera(image: PosedImage) -> None:
    """Refuse a camera whose numbers are not finite, whose focal length is not above 0, or whose size is no image's.

    Raises:
        InputError: as above.
    """
    source = image.camera
    focals = source.parameters[:2] if source.model in _TWO_FOCALS else source.parameters[:1]
    if not all(map(math.isfinite, source.parameters)) or min(focals) <= 0:
        raise InputError(
            "The intrinsics are singular or not finite",
            where=image.where,
            expected="finite numbers, focal lengths > 0",
            got=", ".join(map(str, source.parameters)),
            fix="calibrate the camera again",
        )
    if not (0 < source.width_px < 2**16 and 0 < source.height_px < 2**16):
        raise InputError(
            "The camera's image size is out of range",
            where=image.where,
            expected="1 to 65535 px a side",
            got=f"{source.width_px} x {source.height_px}",
            fix="write the image's size into the COLMAP model",
        )


def _check_digits(image: ColmapImage, where: str) -> None:
    """Refuse a rounded quaternion, whose length shows the rounding, where it moves a far camera noticeably."""
    rounding = abs(float(np.linalg.norm(image.quaternion_wxyz)) - 1)
    distance_m = float(np.linalg.norm(image.translation))
    moved_m = rounding * distance_m
    if distance_m > _FAR_M and rounding < _MAX_ROUNDING and moved_m > _MAX_MOVED_M:
        raise InputError(
            "The pose has too few digits for a world so far from its origin",
            where=where,
            expected=f"a quaternion whose rounding moves the camera by less than {_MAX_MOVED_M:g} m",
            got=f"a length that differs from 1 by {rounding:.1g}, {moved_m:.2g} m at the camera",
            fix="write all 17 digits of quaternions and translations, or move the world's origin near the subject",
        )


def _matrix(pose: Pose, where: str) -> Float[np.ndarray, "4 4"]:
    """The transform of a pose; the quaternion is normalized."""
    quaternion, translation = np.array(pose[0]), np.array(pose[1])
    length = math.hypot(*pose[0])  # does not overflow where the sum of squares would
    if not np.isfinite([*quaternion, *translation, length]).all() or not length > 1e-6:
        raise InputError(
            "The pose is singular or not finite",
            where=where,
            expected="a unit quaternion and a finite translation",
            got=f"quaternion wxyz {quaternion}, translation {translation}",
            fix="calibrate the camera again, or remove its image from the COLMAP model",
        )
    w, x, y, z = quaternion / length
    T = np.eye(4)
    T[0, :3] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    T[1, :3] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    T[2, :3] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    T[:3, 3] = translation
    return T
