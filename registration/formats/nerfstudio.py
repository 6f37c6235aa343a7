"""nerfstudio's `transforms.json`, and its relatives of instant-ngp and Blender.

Poses are camera to world with OpenGL's camera axes (x right, y up, z backwards). The principal point counts from the
corner of the image: the centre of pixel (0, 0) is at (0.5, 0.5), as here.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.formats import vhap
from registration.formats.fields import Fields, read_object
from registration.formats.files import find_image, stored_size, view_names
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView

_TITLE = "transforms.json"
_FILES = ("transforms.json", "transforms_train.json")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_LENSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
_UNREAD = {
    "depth_file_path": "depth maps",
    "normal_file_path": "normal maps",
    "ply_file_path": "the sparse point cloud",
    "time": "time stamps: all images are taken for one moment",
}


def _detect(path: Path) -> bool:
    if vhap.is_export(path):
        return False
    if path.is_dir():
        return any((path / name).is_file() for name in _FILES)
    return path.suffix == ".json" and path.name.startswith("transforms")


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read `transforms.json`, or all of `transforms_train.json`, `transforms_val.json` and `transforms_test.json`.

    Raises:
        InputError: a file is missing or malformed, a camera model is not one of a lens, or sizes are not the images'.
    """
    files = _files(path)
    notes: list[str] = []
    frames = [(file, top, frame) for file in files for top, frame in _frames(file)]
    if not frames:
        raise Fields(values={}, where=str(files[0]), title=_TITLE).error("frames", "at least one frame", "none")
    images = [
        find_image(file.parent, frame.text("file_path"), frame.error, "file_path", suffixes=(".png", ".jpg", ".jpeg"))
        for file, _, frame in frames
    ]
    names = view_names(images, files[0].parent)
    views = tuple(
        _view(name, image, file, top, frame, notes)
        for (file, top, frame), image, name in zip(frames, images, names, strict=True)
    )
    unread = [text for key, text in _UNREAD.items() if any(key in top or key in frame for _, top, frame in frames)]
    notes += [f"not read: {', '.join(unread)}"] if unread else []
    return SourceCapture(
        format=FORMAT.name,
        root=files[0].parent,
        subject=options.subject or files[0].parent.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=None,
        notes=tuple(dict.fromkeys(notes)),
    )


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if (path / _FILES[0]).is_file():
        return [path / _FILES[0]]
    return [path / f"transforms_{part}.json" for part in ("train", "val", "test") if _exists(path, part)] or [
        path / _FILES[0]
    ]


def _exists(path: Path, part: str) -> bool:
    return (path / f"transforms_{part}.json").is_file()


def _frames(file: Path) -> list[tuple[Fields, Fields]]:
    """The file's object and each of its frames, whose own values go before those of the file."""
    top = read_object(file, _TITLE)
    frames = []
    for frame in top.objects("frames"):
        merged: Mapping[str, Any] = ChainMap(dict(frame.values), dict(top.values))
        frames.append((top, Fields(values=merged, where=frame.where, title=frame.title, fix=frame.fix)))
    return frames


def _view(name: str, image: Path, file: Path, top: Fields, frame: Fields, notes: list[str]) -> SourceView:
    width_px, height_px = _size(image, frame, notes)
    mask = frame.text("mask_path", "")
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=_intrinsics(frame, width_px, height_px, notes),
        T_cam_world=_pose(top, frame, notes),
        distortion=_distortion(frame),
        mask=find_image(file.parent, mask, frame.error, "mask_path") if mask else None,
    )


def _size(image: Path, frame: Fields, notes: list[str]) -> tuple[int, int]:
    if "w" in frame or "h" in frame:
        return frame.size("w"), frame.size("h")
    notes.append("the file has no sizes w and h: the sizes of the images were used")
    return stored_size(image)


def _intrinsics(frame: Fields, width_px: int, height_px: int, notes: list[str]) -> Float[np.ndarray, "3 3"]:
    if "fl_x" in frame:
        fx = frame.number("fl_x")
        fy = frame.number("fl_y", fx)
    elif "camera_angle_x" in frame:
        fx = 0.5 * width_px / math.tan(0.5 * _angle(frame, "camera_angle_x"))
        fy = 0.5 * height_px / math.tan(0.5 * _angle(frame, "camera_angle_y")) if "camera_angle_y" in frame else fx
    else:
        raise frame.error("fl_x", "a focal length fl_x in px, or camera_angle_x in radians", "neither")
    if ("cx" in frame) != ("cy" in frame):
        raise frame.error("cx", "both cx and cy, or neither", "one of them")
    if "cx" not in frame:
        notes.append("the file has no principal points cx and cy: the middles of the images were used")
    cx, cy = frame.number("cx", width_px / 2), frame.number("cy", height_px / 2)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _angle(frame: Fields, name: str) -> float:
    angle = frame.number(name)
    if not 0 < angle < math.pi:
        raise frame.error(name, "an angle between 0 and pi radians", angle)
    return angle


def _distortion(frame: Fields) -> Distortion:
    k = [frame.number(f"k{i}", 0.0) for i in range(1, 5)]
    p = [frame.number(f"p{i}", 0.0) for i in range(1, 3)]
    fisheye = bool(frame.values.get("is_fisheye"))  # of instant-ngp
    model = frame.text("camera_model", "OPENCV_FISHEYE" if fisheye else "OPENCV").upper()
    if model not in _LENSES:
        raise frame.error("camera_model", " or ".join(_LENSES), model)
    if model == "OPENCV_FISHEYE":
        if any(p):
            raise frame.error("p1", "no tangential distortion of an OPENCV_FISHEYE lens", p)
        return Distortion(model="opencv_fisheye", coefficients=tuple(k))
    if not (any(k) or any(p)):
        return Distortion(model="none")
    if model.endswith("PINHOLE"):
        raise frame.error("camera_model", "no distortion of a pinhole camera", f"k {k}, p {p}")
    if k[3]:
        expected = "0: as polynomial's fourth and as rational model's fourth it means different lenses"
        raise frame.error("k4", expected, k[3])
    return Distortion(model="opencv", coefficients=(k[0], k[1], *p, k[2]))


def _pose(top: Fields, frame: Fields, notes: list[str]) -> Float[np.ndarray, "4 4"]:
    T_world_cam = frame.array("transform_matrix", (4, 4), (3, 4))
    T_world_cam = np.vstack([T_world_cam[:3], [0, 0, 0, 1]])
    if "applied_scale" in top:
        if (scale := top.number("applied_scale")) <= 0:
            raise top.error("applied_scale", "a number above 0", scale)
        T_world_cam[:3, 3] /= scale
    if "applied_transform" in top:
        applied = np.vstack([top.array("applied_transform", (3, 4), (4, 4))[:3], [0, 0, 0, 1]])
        if abs(np.linalg.det(applied)) < 1e-9:
            raise top.error("applied_transform", "an invertible matrix", applied[:3].tolist())
        T_world_cam = np.linalg.inv(applied) @ T_world_cam
    if "applied_scale" in top or "applied_transform" in top:
        notes.append("applied_transform and applied_scale were undone: the world is that of the original calibration")
    if abs(np.linalg.det(T_world_cam)) < 1e-9:
        raise frame.error("transform_matrix", "an invertible matrix", T_world_cam.tolist())
    return OPENGL_TO_OPENCV @ np.linalg.inv(T_world_cam)


FORMAT = Format(
    name="nerfstudio",
    title="nerfstudio, instant-ngp or Blender transforms.json",
    files="transforms.json or transforms_train.json",
    detect=_detect,
    read=read,
)
