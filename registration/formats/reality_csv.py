"""Cameras that RealityScan or RealityCapture exported as "Internal/External camera parameters": a CSV file.

Position x, y, alt in the world (z up), orientation in degrees: a camera with all angles 0 looks down, along -z, the
top of its image towards +y. heading turns clockwise seen from above, then pitch about its x axis, then roll about y.
"""

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.files import stored_size
from registration.formats.photographs import (
    Photographs,
    left_out,
    scan_beside,
    unique_views,
    world_to_camera,
)
from registration.formats.reality_camera import Calibration, distortion, intrinsics
from registration.formats.source import Format, ReadOptions, SourceCapture, SourceView
from registration.storage.reading import read_text

_NAMES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}  # of RealityScan 2's template
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FIX = 'export "Internal/External camera parameters" from RealityScan again'
_OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes x right, y up, z backwards
_HEAD_BYTES = 4096


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A line of the file."""

    file: Path
    line: int
    values: dict[str, str]

    def error(self, column: str, expected: object, got: object) -> InputError:
        """Return the error of a value."""
        where = f"{self.file}, line {self.line}: {column}"
        return InputError("The RealityScan CSV file cannot be used", where=where, expected=expected, got=got, fix=_FIX)

    def number(self, column: str) -> float:
        """Return a column's number, 0 if the file does not have it. Raises InputError."""
        text = self.values.get(column)
        if text is None:
            return 0.0
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(column, "a finite number", text or "nothing")
        return value


def _detect(path: Path) -> bool:
    return _file(path) is not None


def _file(path: Path) -> Path | None:
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    found = [file for file in files if _is_ours(file)]
    return found[0] if len(found) == 1 else None


def _only(path: Path) -> Path:
    """The only CSV file in a folder, for the message about it; the path itself if it is no folder."""
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    if len(files) == 1:
        return files[0]
    got = listed([file.name for file in files], 5) or "none"
    raise InputError("The CSV file to read is not known", where=path, expected="one CSV file", got=got, fix=_FIX)


def _is_ours(file: Path) -> bool:
    if file.suffix.lower() != ".csv" or not file.is_file():
        return False
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES).decode("utf-8-sig", "replace")
    except OSError:
        return False
    return any(set(_NEEDED) <= set(_columns(line)) for line in head.splitlines()[:3])


def _columns(line: str) -> list[str]:
    names = [name.strip().lstrip("#").strip().lower() for name in next(csv.reader([line]), [])]
    return [_NAMES.get(name, name) for name in names]


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read the CSV file; photographs are looked for in its folder and below.

    Raises:
        InputError: the file is missing or malformed, or an image is missing.
    """
    file = _file(path) or _only(path)
    rows = list(_rows(file))
    if not rows:
        raise _refuse(file)(expected="a line for each camera", got="none")
    photographs = Photographs(file.parent)
    found = [(row, photographs.find_or_none(row.values["name"], row.error, "name")) for row in rows]
    missing = [row.values["name"] for row, image in found if image is None]
    if len(missing) == len(rows):
        raise rows[0].error("name", f"photographs in {file.parent} or below", missing[0])
    images = [(row, image) for row, image in found if image is not None]
    names = unique_views([image for _, image in images], file.parent)
    views = tuple(
        _view(name, row, image, photographs.mask(image)) for name, (row, image) in zip(names, images, strict=True)
    )
    notes = ["the file states neither unit nor lens model: Brown's model was taken, not the division model"]
    return SourceCapture(
        format=FORMAT.name,
        root=file.parent,
        subject=options.subject or file.parent.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=None,
        scan=scan_beside(file.parent),
        notes=(*notes, *left_out(missing, "without a photograph")),
    )


def _refuse(file: Path) -> "partial[InputError]":
    return partial(InputError, "The RealityScan CSV file cannot be read", where=file, fix=_FIX)


def _rows(file: Path) -> Iterator[_Row]:
    refuse = _refuse(file)
    lines = read_text(file, refuse).splitlines()
    columns: Sequence[str] = ()
    stated: int | None = None
    count = 0
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        if not columns:
            if line.lower().startswith("#cameras"):
                words = line.split()
                stated = int(words[1]) if len(words) == 2 and words[1].isdecimal() else None
                continue
            columns = _columns(line)
            absent = [name for name in _NEEDED if name not in columns]
            if absent or len(set(columns)) < len(columns):
                got = f"line {number}: {line[:80]!r}" + (f" without {', '.join(absent)}" if absent else "")
                raise refuse(expected=f"a first line with the columns {', '.join((*_NEEDED, *_OPTIONAL))}", got=got)
            continue
        if line.startswith("#"):
            continue
        values = [value.strip() for value in next(csv.reader([line]), [])]
        if len(values) != len(columns):
            expected = f"{len(columns)} values, as in the first line"
            raise refuse(expected=expected, got=f"{len(values)} in line {number}")
        count += 1
        yield _Row(file=file, line=number, values=dict(zip(columns, values, strict=True)))
    if stated is not None and stated != count:
        raise refuse(expected=f"{stated} cameras, as the first line says", got=f"{count}: the file was cut off")


def _view(name: str, row: _Row, image: Path, mask: Path | None) -> SourceView:
    width_px, height_px = stored_size(image)
    if (focal := row.number("f")) <= 0:
        raise row.error("f", "a focal length above 0 mm", focal)
    px, py = row.number("px"), row.number("py")
    for column, value in (("px", px), ("py", py)):
        if abs(value) > 0.5:
            expected = "an offset from the image's middle in units of its longer side, between -0.5 and 0.5"
            raise row.error(column, expected, value)
    coefficients = tuple(row.number(column) for column in _OPTIONAL[2:])
    calibration = Calibration(focal_35mm=focal, px=px, py=py, coefficients=coefficients)
    centre = np.array([row.number(column) for column in ("x", "y", "alt")])
    angles = [row.number(column) for column in ("heading", "pitch", "roll")]
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=intrinsics(calibration, width_px, height_px),
        T_cam_world=world_to_camera(rotation(angles), centre),
        distortion=distortion(calibration),
        mask=mask,
    )


def rotation(angles: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from world to camera, OpenCV's axes, of heading, pitch and roll in degrees."""
    heading, pitch, roll = angles
    world_from_opengl = Rotation.from_euler("ZXY", (-heading, pitch, roll), degrees=True).as_matrix()
    return _OPENGL @ world_from_opengl.T


FORMAT = Format(
    name="realityscan_csv",
    title="RealityScan or RealityCapture CSV",
    files="a CSV file with the columns #name, x, y, alt, heading, pitch, roll, f",
    detect=_detect,
    read=read,
)
