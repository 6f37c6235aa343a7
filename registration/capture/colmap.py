"""Read and write COLMAP models: the cameras of a capture."""

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, UInt8

from registration.errors import InputError
from registration.types import Camera

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
_WRITTEN = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV", 8: "FULL_OPENCV"}  # by number of distortion coefficients
_GREY = 128  # colour of points that have none


def read_cameras(sparse: Path) -> dict[str, Camera]:
    """Read the cameras of a COLMAP model, text or binary.

    Returns:
        Image's file name -> its camera.

    Raises:
        InputError: the model cannot be read, two images have one name, a camera model is not supported, or intrinsics
            or a pose are singular or not finite.
    """
    if not sparse.is_dir():
        raise InputError(
            "The COLMAP model is missing",
            where=sparse,
            expected="cameras, images and points3D as .txt or .bin",
            got="no such folder",
            fix="store the calibration there; see docs/formats.md",
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
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), 1):
        K, count = camera.intrinsics, len(camera.distortion)
        if count not in _WRITTEN or K[0, 1] != 0:
            raise ValueError(f"{name}: COLMAP has no model for this camera")
        lens = pycolmap.Camera(
            camera_id=number,
            model=_WRITTEN[count],
            width=camera.width_px,
            height=camera.height_px,
            params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion, *[0.0] * (3 if count == 5 else 0)],
        )
        model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.T_cam_world[:3]))
    shades = np.full((len(points), 3), _GREY, np.uint8) if colours is None else colours
    for point, shade in zip(points, shades, strict=True):
        model.add_point3D(point, pycolmap.Track(), shade)
    sparse.mkdir()
    model.write_text(str(sparse))
    for name in ("rigs.txt", "frames.txt"):  # trivial; without them poses have one home, images.txt
        (sparse / name).unlink()


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
            "The camera's image size is out of range",
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
    # pycolmap silently turns a zero quaternion into the identity: check the quaternion itself.
    if not np.isfinite(T_cam_world).all() or not np.linalg.norm(quaternion) > 1e-6:
        raise InputError(
            "The pose is singular or not finite",
            where=where,
            expected="a unit quaternion and a finite translation",
            got="no pose" if pose is None else f"quaternion xyzw {quaternion}, translation {pose.translation}",
            fix="calibrate the camera again, or remove its image from the COLMAP model",
        )
    return T_cam_world


def _unreadable_model(sparse: Path, error: Exception) -> InputError:
    """COLMAP's own messages name neither line nor reason, so look for the most frequent one: NaN or infinity."""
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
