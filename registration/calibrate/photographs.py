"""The photographs of a calibration: files, sizes, what EXIF tells, and groups that share a focal length."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.calibrate.options import GroupBy
from registration.capture.native import natural_key
from registration.capture.pixels import read_image
from registration.errors import InputError
from registration.storage.hashing import hash_file
from registration.storage.image_files import image_size
from registration.types import Camera

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
MAX_PHOTOGRAPHS = 300
_DIAGONAL_35MM = float(np.hypot(36.0, 24.0))  # of the film that EXIF's equivalent focal length refers to, mm
_EXIF, _MAKE, _MODEL, _SERIAL, _FOCAL_MM, _FOCAL_35MM = 0x8769, 0x010F, 0x0110, 0xA431, 0x920A, 0xA405


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """One image file; its pixels are used as they are stored, whatever orientation EXIF states."""

    name: str  # of the view: path below the folder, without suffix
    relative: PurePosixPath  # path below the folder
    file: Path
    width_px: int
    height_px: int
    device: str  # maker, model and serial number by EXIF; "" if unknown
    focal_mm: float | None  # by EXIF
    focal_px: float | None  # by EXIF's equivalent focal length

    @property
    def side_px(self) -> int:
        """The longer side."""
        return max(self.width_px, self.height_px)

    @property
    def centre_px(self) -> tuple[float, float]:
        """The middle of the image, where its principal point is taken to be."""
        return self.width_px / 2, self.height_px / 2

    def camera(self, focal_px: float, T_cam_world: Float[np.ndarray, "4 4"], k1: float = 0.0) -> Camera:
        """The camera that took it, with this focal length, pose and radial distortion."""
        cx, cy = self.centre_px
        return Camera(
            width_px=self.width_px,
            height_px=self.height_px,
            intrinsics=np.array([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1.0]]),
            T_cam_world=T_cam_world,
            distortion=(k1, 0.0, 0.0, 0.0) if k1 else (),
        )


def find_photographs(source: Path | Sequence[Path]) -> list[Photograph]:
    """Return the photographs of a folder and of its subfolders, or those of a list of files, in natural order.

    Raises:
        InputError: the folder is missing, there are no images or more than `MAX_PHOTOGRAPHS`, two have one name, or a
            file is no image.
    """
    if isinstance(source, Path):
        root, files = Path(source), _files_below(Path(source))
    else:
        files = [Path(file) for file in source]
        root = Path(os.path.commonpath([file.absolute().parent for file in files])) if files else Path(".")
        files = [file.absolute() for file in files]
    if not 0 < len(files) <= MAX_PHOTOGRAPHS:
        raise InputError(
            "The photographs cannot be calibrated",
            where=root,
            expected=f"1 to {MAX_PHOTOGRAPHS} images ({', '.join(SUFFIXES)})",
            got=f"{len(files)} images",
            fix="name the folder of the photographs of one moment",
        )
    photographs = [_read_header(root, file) for file in sorted(files, key=lambda file: natural_key(str(file)))]
    names: dict[str, Photograph] = {}
    for photograph in photographs:
        if other := names.setdefault(photograph.name, photograph):
            if other is not photograph:
                raise InputError(
                    "Two photographs have one name",
                    where=root,
                    expected="names that differ in more than the suffix",
                    got=f"{other.relative} and {photograph.relative}",
                    fix="rename or remove one of them",
                )
    return photographs


def _files_below(root: Path) -> list[Path]:
    if not root.is_dir():
        raise InputError(
            "The folder of photographs is missing",
            where=root,
            expected="a folder of images of one moment",
            got="a file" if root.exists() else "no such folder",
            fix="check the path",
        )
    files = []
    for parent, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        files += [Path(parent) / name for name in names if Path(name).suffix.lower() in SUFFIXES and name[0] != "."]
    return files


def _read_header(root: Path, file: Path) -> Photograph:
    refuse = partial(
        InputError.unreadable, "photograph", where=file, fix="convert it to PNG, JPEG or TIFF, or remove it"
    )
    width_px, height_px = image_size(file, refuse)
    device, focal_mm, focal_35mm = _exif(file)
    relative = PurePosixPath(file.relative_to(root).as_posix())
    focal_px = None if focal_35mm is None else focal_35mm / _DIAGONAL_35MM * float(np.hypot(width_px, height_px))
    return Photograph(
        name=str(relative.with_suffix("")),
        relative=relative,
        file=file,
        width_px=width_px,
        height_px=height_px,
        device=device,
        focal_mm=focal_mm,
        focal_px=focal_px,
    )


def _exif(file: Path) -> tuple[str, float | None, float | None]:
    """Device, focal length and equivalent focal length (mm); damaged or missing entries count as none."""
    from PIL import Image

    try:
        with warnings.catch_warnings(), Image.open(file) as image:
            warnings.simplefilter("ignore")
            exif = image.getexif()
            details = exif.get_ifd(_EXIF)
    except Exception:  # of the pixels a decoder judges; metadata may be anything
        return "", None, None
    words = [str(value).strip("\0 ") for value in (exif.get(_MAKE), exif.get(_MODEL), details.get(_SERIAL)) if value]
    return " ".join(words), _positive(details.get(_FOCAL_MM)), _positive(details.get(_FOCAL_35MM))


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and 1 <= number < 5000 else None


def focal_groups(photographs: Sequence[Photograph], by: GroupBy) -> tuple[list[str], Int[np.ndarray, "N"]]:
    """Return the names of the groups that share a focal length, and the group of each photograph.

    Args:
        photographs: all of the calibration. Portrait and landscape of one size are the same camera.
        by: camera: one size, device and focal length by EXIF; size: one size; folder: one folder and size; view: each
            photograph has its own.
    """
    names = []
    for photograph in photographs:
        long, short = photograph.side_px, min(photograph.width_px, photograph.height_px)
        words = [f"{long} x {short}"]
        if by == "camera":
            words += [photograph.device] if photograph.device else []
            words += [f"{photograph.focal_mm:g} mm"] if photograph.focal_mm is not None else []
        elif by == "folder":
            words.insert(0, str(photograph.relative.parent))
        elif by == "view":
            words.insert(0, photograph.name)
        names.append(", ".join(words))
    unique = list(dict.fromkeys(names))
    return unique, np.array([unique.index(name) for name in names], np.int64)


def read_pixels(photograph: Photograph, max_side_px: int) -> tuple[UInt8[np.ndarray, "H W 3"], float]:
    """Decode a photograph, reduced to a longer side of at most `max_side_px`.

    Returns:
        Red green blue, sRGB, 8 bit, and how many pixels of the file one pixel of the result is.

    Raises:
        InputError: it cannot be decoded.
    """
    camera = photograph.camera(float(photograph.side_px), np.eye(4))
    pixels = read_image(photograph.file, camera)
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257).astype(np.uint8)
    height, width = pixels.shape[:2]
    factor = max(photograph.side_px / max_side_px, 1.0)
    if factor == 1.0:
        return pixels, factor
    size = round(width / factor), round(height / factor)
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), factor


def duplicates(photographs: Sequence[Photograph]) -> dict[int, int]:
    """Return the photographs whose files are equal to an earlier one's: index -> index of the first."""
    first: dict[str, int] = {}
    return {
        number: earlier
        for number, photograph in enumerate(photographs)
        if (earlier := first.setdefault(hash_file(photograph.file), number)) != number
    }
