"""Read the text files of a COLMAP model; every malformed line is an `InputError` that names it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

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
from registration.storage.reading import raw_lines


def read_text_model(folder: Path) -> ColmapModel:
    """Read cameras.txt and images.txt, and rigs.txt and frames.txt where they are there.

    An image may lack its line of image points, as hand-written models do. An image's name is the rest of its line.

    Raises:
        InputError: a file is missing or not UTF-8, or a line is malformed; the line is named.
    """
    cameras: dict[int, ColmapCamera] = {}
    for line in _lines(folder / "cameras.txt"):
        words = line.words(at_least=4, form="CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS...")
        number, model = line.integer(words[0]), words[1]
        if number in cameras:
            raise line.error("every camera id once", words[0])
        if model in PARAMETER_COUNTS and len(words) - 4 != PARAMETER_COUNTS[model]:
            raise line.error(f"{PARAMETER_COUNTS[model]} parameters for {model}", len(words) - 4)
        size = [line.integer(word) for word in words[2:4]]
        parameters = tuple(line.real(word) for word in words[4:])
        where = f"{line.file}, line {line.number}"
        cameras[number] = ColmapCamera(
            model=model, width_px=size[0], height_px=size[1], parameters=parameters, where=where
        )
    rigs, frames = rig_files(folder, "txt")
    return ColmapModel(
        cameras=cameras,
        images=tuple(_text_images(folder / "images.txt")),
        sensors_from_rig=_text_rigs(rigs) if rigs else {},
        frames=tuple(_text_frames(frames)) if frames else (),
    )


def read_text_points(file: Path) -> tuple[Float[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Read positions (world) and colours of points3D.txt. Raises InputError, naming the malformed line."""
    points, colours = [], []
    for line in _lines(file):
        words = line.words(at_least=8, form="POINT3D_ID X Y Z R G B ERROR TRACK...")
        points.append([line.real(word) for word in words[1:4]])
        if not all(map(math.isfinite, points[-1])):
            raise line.error("finite numbers", line.text[:120])
        colours.append([min(max(line.integer(word), 0), 255) for word in words[4:7]])
    return np.array(points, np.float64).reshape(-1, 3), np.array(colours, np.uint8).reshape(-1, 3)


@dataclass(frozen=True)
class _Line:
    file: Path
    number: int
    text: str

    def error(self, expected: object, got: object) -> InputError:
        return malformed(f"{self.file}, line {self.number}", expected, got)

    def words(self, at_least: int, form: str) -> list[str]:
        words = self.text.split()
        if len(words) < at_least:
            raise self.error(form, self.text[:120])
        return words

    def integer(self, word: str) -> int:
        try:
            return int(word)
        except ValueError:
            raise self.error("a whole number", word[:40]) from None

    def real(self, word: str) -> float:
        try:
            return float(word)
        except ValueError:
            raise self.error("a number", word[:40]) from None

    def pose(self, words: list[str]) -> Pose:
        values = [self.real(word) for word in words]
        return tuple(values[:4]), tuple(values[4:])

    def is_image(self) -> bool:
        """Whether this looks like the first line of an image: a whole number, seven numbers, a whole number, a name."""
        words = self.text.split(maxsplit=9)
        if len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
            return False
        return all(map(_is_number, words[1:8])) and not all(map(_is_number, words[9].split()))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _lines(file: Path, blank: bool = False) -> Iterator[_Line]:
    """Yield the lines of a text file but for comments, and for blank ones unless asked for."""
    for number, raw in enumerate(raw_lines(file, partial(malformed, file)), 1):
        if raw.lstrip().startswith(b"#") or not (blank or raw.strip()):
            continue
        try:
            yield _Line(file, number, raw.decode("utf-8"))
        except UnicodeDecodeError as error:
            raise malformed(f"{file}, line {number}", "a text file in UTF-8", error) from None


def _text_images(file: Path) -> Iterator[ColmapImage]:
    points_may_follow = False
    for line in _lines(file, blank=True):
        if not line.text.strip():
            points_may_follow = False
            continue
        if points_may_follow and not line.is_image():
            if len(line.text.split()) % 3:
                raise line.error("image points as X Y POINT3D_ID, or the next image", line.text[:120])
            points_may_follow = False
            continue
        words = line.text.split(maxsplit=9)
        if len(words) < 10:
            raise line.error("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line.text[:120])
        quaternion, translation = line.pose(words[1:8])
        yield ColmapImage(
            id=line.integer(words[0]),
            name=words[9].strip(),
            camera_id=line.integer(words[8]),
            quaternion_wxyz=quaternion,
            translation=translation,
            where=f"{file}, line {line.number}",
        )
        points_may_follow = True


def _text_rigs(file: Path) -> dict[tuple[int, int], Pose | None]:
    """Read (rig, camera) -> the camera's pose in the rig; other sensors are skipped."""
    sensors: dict[tuple[int, int], Pose | None] = {}
    for line in _lines(file):
        words = line.words(at_least=2, form="RIG_ID NUM_SENSORS SENSORS...")
        rig, count, rest = line.integer(words[0]), line.integer(words[1]), words[2:]
        for index in range(count):
            form = "SENSOR_TYPE SENSOR_ID" + (" HAS_POSE [QW QX QY QZ TX TY TZ]" if index else "")
            has_pose = index > 0 and rest[2:3] == ["1"]
            length = (10 if has_pose else 3) if index else 2
            if len(rest) < length:
                raise line.error(form, " ".join(rest)[:120])
            if rest[0] == "CAMERA" and (has_pose or not index):
                sensors[rig, line.integer(rest[1])] = line.pose(rest[3:10]) if index else None
            rest = rest[length:]
    return sensors


def _text_frames(file: Path) -> Iterator[ColmapFrame]:
    form = "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS (SENSOR_TYPE SENSOR_ID DATA_ID)..."
    for line in _lines(file):
        words = line.words(at_least=10, form=form)
        quaternion, translation = line.pose(words[2:9])
        data = words[10:]
        if len(data) != 3 * line.integer(words[9]):
            raise line.error(form, line.text[:120])
        images = [data[i : i + 3] for i in range(0, len(data), 3) if data[i] == "CAMERA"]
        yield ColmapFrame(
            rig_id=line.integer(words[1]),
            quaternion_wxyz=quaternion,
            translation=translation,
            images=tuple((line.integer(camera), line.integer(image)) for _, camera, image in images),
        )
