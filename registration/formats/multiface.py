"""The Multiface dataset: `KRT`, and `images/SEGMENT/CAMERA/FRAME.png`.

`KRT` has a block of lines for each camera: its name, K, five distortion values, and [R | t], world to camera with
OpenCV's axes in millimetres. The images are linear light of the sensor; the dataset's `gammaCorrect` balances it with
a black level, gains of red, green and blue, and a factor. github.com/facebookresearch/multiface
"""

import math
import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.native import natural_key
from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.files import stored_size
from registration.formats.photographs import check_rotation, left_out
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView
from registration.storage.reading import read_text
from registration.types import Colour

_KRT = "KRT"
_MM = 0.001
_SUBJECT = re.compile(r"m-+\d+-+\d+-+(\w+)-+\w+")  # m--20180227--0000--6795937--GHS
_BLACK, _GAINS, _FACTOR = 3 / 255, (1.4 / 1.1, 1.1 / 1.1, 1.6 / 1.1), 0.95  # of the dataset's gammaCorrect
_LINES = (("K", 3, 3), ("distortion", 1, 5), ("R t", 3, 4))
_FIX = "download KRT again"


@dataclass(frozen=True, kw_only=True)
class KrtCamera:
    """A camera of the file `KRT`."""

    K: Float[np.ndarray, "3 3"]
    distortion: tuple[float, ...]
    T_cam_world: Float[np.ndarray, "4 4"]  # millimetres


def _detect(path: Path) -> bool:
    return _root(path) is not None


def _root(path: Path) -> Path | None:
    """The entity's folder: the path, or two levels above a segment's folder."""
    for folder in (path, path.resolve().parent.parent):
        if is_entity(folder):
            return folder
    return None


def is_entity(path: Path) -> bool:
    """Whether a folder is an entity's: with `KRT` and `images`."""
    return (path / _KRT).is_file() and (path / "images").is_dir()


def subject_of(entity: Path) -> str:
    """Return the subject's number in the name of an entity's folder, or else the name."""
    name = entity.resolve().name
    found = _SUBJECT.fullmatch(name)
    return found[1] if found else name


def segments(path: Path) -> list[Path]:
    """Return the segments' folders of images in an entity's folder, or the one that the path is."""
    root = _root(path)
    if root is None:
        return []
    if path.resolve().parent == (root / "images").resolve():
        return [path]
    below = [folder for folder in (root / "images").iterdir() if folder.is_dir() and not folder.name.startswith(".")]
    return sorted(below, key=lambda folder: natural_key(folder.name))


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read one frame of a segment; of an entity's folder the segment that `options.expression` names.

    Raises:
        InputError: `KRT` is missing or malformed, no segment is named, or the frame does not exist.
    """
    root = _root(path)
    if root is None:
        raise _error("The Multiface capture cannot be read", path, "a folder with KRT and images/", "none", "check it")
    segment = _segment(path, options.expression)
    cameras = read_krt(root / _KRT)
    frame, images = _frame(segment, options.frame)
    unknown = [name for name in images if name not in cameras]
    used = [name for name in images if name in cameras]
    if not used:
        raise _error("No camera is calibrated", root / _KRT, listed(list(images), 4), listed(list(cameras), 4), _FIX)
    views = tuple(_view(name, images[name], cameras[name]) for name in used)
    notes = [f"frame {frame} was read", *left_out(unknown, f"not in {_KRT}")]
    if any(any(cameras[name].distortion) for name in used):
        notes.append(
            "the distortion values were taken in OpenCV's order k1 k2 p1 p2 k3, which the dataset does not state"
        )
    if (root / "tracked_mesh").is_dir():
        notes.append("tracked_mesh was left out: it is another model's registration, not a scan")
    return SourceCapture(
        format=FORMAT.name,
        root=root,
        subject=options.subject or subject_of(root),
        expression=options.expression or segment.name,
        views=views,
        unit_m=_MM,
        notes=tuple(notes),
    )


def _error(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


def _segment(path: Path, expression: str | None) -> Path:
    found = segments(path)
    if len(found) == 1:
        return found[0]
    named = [folder for folder in found if folder.name == expression]
    if not named:
        names = listed([folder.name for folder in found], 8) if found else "none"
        fix = "name one of them with --expression, or give its folder below images/"
        raise _error("The segment to read is not known", path, "one segment of images/", names, fix)
    return named[0]


def _frame(segment: Path, number: int | None) -> tuple[int, dict[str, Path]]:
    """The frame that is read, and its images by camera."""
    frames: dict[int, dict[str, Path]] = {}
    for camera in sorted((f for f in segment.iterdir() if f.is_dir()), key=lambda f: natural_key(f.name)):
        for file in camera.glob("*.png"):
            if file.stem.isdecimal():
                frames.setdefault(int(file.stem), {})[camera.name] = file
    if not frames:
        raise _error("The segment has no images", segment, "CAMERA/FRAME.png", "none", "check the path")
    if number is None:
        most = max(len(images) for images in frames.values())
        number = min(frame for frame, images in frames.items() if len(images) == most)
    if number not in frames:
        fix = "choose another with --frame"
        raise _error("There is no such frame", segment, f"one of {listed(sorted(frames), 8)}", number, fix)
    return number, frames[number]


def _view(name: str, image: Path, camera: KrtCamera) -> SourceView:
    width_px, height_px = stored_size(image)
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=camera.K,
        T_cam_world=camera.T_cam_world,
        distortion=Distortion(model="opencv", coefficients=camera.distortion)
        if any(camera.distortion)
        else Distortion(model="none"),
        colour=_balance(),
    )


def _balance() -> Colour:
    """The dataset's colour balance of linear light, without its display curve."""
    factor = _FACTOR / (1 - _BLACK)
    rows = np.column_stack([np.diag(_GAINS) * factor, np.full(3, -_BLACK * factor)])
    return Colour(encoding="linear", matrix=tuple(tuple(map(float, row)) for row in rows), matrix_space="linear")


def read_krt(file: Path) -> dict[str, KrtCamera]:
    """Read the cameras of a file `KRT`.

    Raises:
        InputError: a line has other numbers than it should, K or R is none, or a name is there twice; with the line.
    """
    refuse = partial(InputError, "The camera file KRT cannot be used", where=file, fix=_FIX)
    lines = [(number, line.strip()) for number, line in enumerate(read_text(file, refuse).splitlines(), 1)]
    lines = [(number, line) for number, line in lines if line]
    cameras: dict[str, KrtCamera] = {}
    size = 1 + sum(rows for _, rows, _ in _LINES)
    for first in range(0, len(lines), size):
        block = lines[first : first + size]
        number, name = block[0]
        if len(block) < size:
            raise refuse(expected=f"{size} lines for each camera", got=f"{len(block)} for {name}, line {number}")
        if name in cameras or len(name.split()) != 1:
            raise refuse(expected=f"a camera's name in line {number}, each once", got=name)
        values, at = {}, 1
        for what, rows, columns in _LINES:
            values[what] = np.array([_numbers(refuse, what, columns, line) for line in block[at : at + rows]])
            at += rows
        cameras[name] = _camera(refuse, name, number, values)
    if not cameras:
        raise refuse(expected="cameras", got="none")
    return cameras


def _numbers(refuse: "partial[InputError]", what: str, count: int, line: tuple[int, str]) -> list[float]:
    number, text = line
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise refuse(expected=f"{count} finite numbers of {what} in line {number}", got=repr(text)[:80])
    return values


def _camera(refuse: "partial[InputError]", name: str, number: int, values: dict[str, np.ndarray]) -> KrtCamera:
    K, Rt = values["K"], values["R t"]

    def error(_: str, expected: object, got: object) -> InputError:
        return refuse(expected=f"{expected} for camera {name}, line {number}", got=got)

    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.abs(K[2] - [0, 0, 1]).max() < 1e-9 and abs(K[1, 0]) < 1e-9):
        raise error("", "K with fx 0 cx / 0 fy cy / 0 0 1", K.tolist())
    check_rotation(Rt[:, :3], error, "R t")
    T = np.vstack([Rt, [0, 0, 0, 1]])
    return KrtCamera(K=K, distortion=tuple(values["distortion"][0].tolist()), T_cam_world=T)


FORMAT = Format(
    name="multiface",
    title="Multiface segment",
    files="KRT and images/SEGMENT/CAMERA/FRAME.png",
    detect=_detect,
    read=read,
    sequences=True,
)
