"""Read the binary files of a COLMAP model.

A capture may come from anybody: counts are compared with the file's size before anything is read or allocated.
"""

import mmap
import os
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from registration.capture.colmap_model import (
    PARAMETER_COUNTS,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    ColmapModel,
    Pose,
    malformed,
    rig_files,
)
from registration.errors import InputError
from registration.storage.reading import open_file

_MODEL_NAMES = tuple(PARAMETER_COUNTS)
_CAMERA_SENSOR = 0  # of frames' data in binary files; "CAMERA" in text files
_MAX_NAME_BYTES = 4096


def read_binary_model(folder: Path) -> ColmapModel:
    """Read cameras.bin and images.bin, and rigs.bin and frames.bin where they are there.

    Raises:
        InputError: a file is missing, cut short, has a count that its size cannot hold, or an unknown camera model.
    """
    cameras: dict[int, ColmapCamera] = {}
    with _Binary.opened(folder / "cameras.bin") as data:
        for record in range(data.count("Q", least_bytes=24)):
            number, model, width, height = data.take("IiQQ")
            if not 0 <= model < len(_MODEL_NAMES):
                raise data.error("a camera model that COLMAP has", f"number {model}")
            if number in cameras:
                raise data.error("every camera id once", number)
            name = _MODEL_NAMES[model]
            parameters = data.take(f"{PARAMETER_COUNTS[name]}d")
            where = f"{folder / 'cameras.bin'}, camera {record + 1}"
            cameras[number] = ColmapCamera(
                model=name, width_px=width, height_px=height, parameters=parameters, where=where
            )
    rigs, frames = rig_files(folder, "bin")
    return ColmapModel(
        cameras=cameras,
        images=tuple(_binary_images(folder / "images.bin")),
        sensors_from_rig=_binary_rigs(rigs) if rigs else {},
        frames=tuple(_binary_frames(frames)) if frames else (),
    )


def read_binary_points(file: Path) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Read positions (world) and colours of points3D.bin. Raises InputError if it is cut short."""
    with _Binary.opened(file) as data:
        count = data.count("Q", least_bytes=51)
        points, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        for row in range(count):
            _, *points[row], red, green, blue, _ = data.take("Q3d3Bd")
            colours[row] = red, green, blue
            data.skip(8 * data.count("Q", least_bytes=8))
    if not np.isfinite(points).all():
        raise malformed(file, "finite numbers", "NaN or infinity")
    return points, colours


class _Binary:
    """A little-endian file read from front to back; never reads, nor allocates for, what the file does not hold."""

    def __init__(self, file: Path, data: "bytes | mmap.mmap"):
        self._file, self._data, self._offset = file, data, 0

    @classmethod
    def opened(cls, file: Path) -> "_Binary":
        with open_file(file, partial(malformed, file)) as stream:
            empty = os.fstat(stream.fileno()).st_size == 0
            data = b"" if empty else mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        return cls(file, data)

    def __enter__(self) -> "_Binary":
        return self

    def __exit__(self, *_: object) -> None:
        if isinstance(self._data, mmap.mmap):
            self._data.close()

    def error(self, expected: object, got: object) -> InputError:
        return malformed(f"{self._file}, byte {self._offset}", expected, got)

    def take(self, form: str) -> tuple[Any, ...]:
        layout = struct.Struct(f"<{form}")
        self._require(layout.size)
        values = layout.unpack_from(self._data, self._offset)
        self._offset += layout.size
        return values

    def pose(self) -> Pose:
        values = self.take("7d")
        return values[:4], values[4:]

    def count(self, form: str, least_bytes: int) -> int:
        """A number of records of at least so many bytes each, which the rest of the file must be able to hold."""
        (count,) = self.take(form)
        rest = len(self._data) - self._offset
        if count * least_bytes > rest:
            raise self.error(f"at most {rest // least_bytes} records in the {rest} bytes that follow", count)
        return int(count)

    def name(self) -> str:
        end = self._data.find(b"\0", self._offset, self._offset + _MAX_NAME_BYTES)
        if end < 0:
            raise self.error("a name that ends with a zero byte", "none")
        try:
            text = self._data[self._offset : end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise self.error("a name in UTF-8", error) from None
        self._offset = end + 1
        return text

    def skip(self, size: int) -> None:
        self._require(size)
        self._offset += size

    def _require(self, size: int) -> None:
        if (rest := len(self._data) - self._offset) < size:
            raise self.error(f"{size} more bytes", f"{rest}: the file is cut short")


def _binary_images(file: Path) -> Iterator[ColmapImage]:
    with _Binary.opened(file) as data:
        for record in range(data.count("Q", least_bytes=73)):
            (number,) = data.take("I")
            quaternion, translation = data.pose()
            (camera_id,) = data.take("I")
            name = data.name()
            data.skip(24 * data.count("Q", least_bytes=24))
            yield ColmapImage(
                id=number,
                name=name,
                camera_id=camera_id,
                quaternion_wxyz=quaternion,
                translation=translation,
                where=f"{file}, image {record + 1}",
            )


def _binary_rigs(file: Path) -> dict[tuple[int, int], Pose | None]:
    sensors: dict[tuple[int, int], Pose | None] = {}
    with _Binary.opened(file) as data:
        for _ in range(data.count("Q", least_bytes=8)):
            (rig,) = data.take("I")
            for index in range(data.count("I", least_bytes=8)):
                kind, sensor = data.take("iI")
                has_pose = index > 0 and data.take("B")[0] != 0
                pose = data.pose() if has_pose else None
                if kind == _CAMERA_SENSOR and (has_pose or not index):
                    sensors[rig, sensor] = pose
    return sensors


def _binary_frames(file: Path) -> Iterator[ColmapFrame]:
    with _Binary.opened(file) as data:
        for _ in range(data.count("Q", least_bytes=68)):
            _, rig = data.take("II")
            quaternion, translation = data.pose()
            items = [data.take("iIQ") for _ in range(data.count("I", least_bytes=16))]
            images = tuple((camera, image) for kind, camera, image in items if kind == _CAMERA_SENSOR)
            yield ColmapFrame(rig_id=rig, quaternion_wxyz=quaternion, translation=translation, images=images)
