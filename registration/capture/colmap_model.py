"""What a capture needs of a COLMAP model, as its files hold it: https://colmap.github.io/format.html."""

import os
from dataclasses import dataclass
from pathlib import Path

from registration.errors import InputError

# Camera models in the order of their numbers in binary files -> number of parameters.
PARAMETER_COUNTS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """One row of cameras.txt or cameras.bin."""

    model: str
    width_px: int
    height_px: int
    parameters: tuple[float, ...]
    where: str  # file and line, or file and record


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """One image and its pose, camera from world."""

    id: int
    name: str
    camera_id: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    where: str  # file and line, or file and record


@dataclass(frozen=True, kw_only=True)
class ColmapFrame:
    """Where a rig stood: its pose, rig from world, and the images that it took."""

    rig_id: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    images: tuple[tuple[int, int], ...]  # (camera id, image id)


Pose = tuple[tuple[float, ...], tuple[float, ...]]  # quaternion wxyz, translation


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """What a capture needs of a model; tracks and image points are skipped. Numbers may be NaN or infinite."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    sensors_from_rig: dict[tuple[int, int], Pose | None]  # (rig id, camera id) -> pose; None: the rig's reference
    frames: tuple[ColmapFrame, ...]


def malformed(where: object, expected: object, got: object) -> InputError:
    """Return the error of a file that is not as COLMAP writes it."""
    return InputError(
        "The COLMAP model cannot be read",
        where=where,
        expected=expected,
        got=got,
        fix="export the model again with COLMAP's model_converter, or see docs/formats.md",
    )


def rig_files(folder: Path, suffix: str) -> tuple[Path | None, Path | None]:
    """Return the files of rigs and of frames, None for one that is missing; COLMAP before 3.12 wrote neither."""
    rigs, frames = folder / f"rigs.{suffix}", folder / f"frames.{suffix}"
    return rigs if os.path.lexists(rigs) else None, frames if os.path.lexists(frames) else None
