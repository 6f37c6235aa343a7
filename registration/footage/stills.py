"""Photographs of unknown cameras: decoded upright, with what EXIF says of the focal length."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from registration.calibrate.photographs import Photograph, find_photographs, focal_groups, read_pixels
from registration.errors import InputError

MAX_VIEWS = 60
_ORIENTATION = 0x0112  # of EXIF


@dataclass(frozen=True, kw_only=True, eq=False)
class Still:
    """One photograph, upright."""

    name: str
    file: Path
    pixels: UInt8[np.ndarray, "H W 3"]  # sRGB
    focal_px: float | None  # by EXIF's equivalent focal length
    group: int  # photographs of one group were taken by one camera
    orientation: int  # that EXIF states and that was undone

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        height, width = self.pixels.shape[:2]
        return width, height


def read_stills(source: Path) -> list[Still]:
    """Read an image, or the images of a folder.

    Raises:
        InputError: an image cannot be decoded, or there are more than `MAX_VIEWS`.
    """
    photographs = find_photographs(source if source.is_dir() else [source])
    if len(photographs) > MAX_VIEWS:
        raise InputError(
            "There are too many images for one moment",
            where=source,
            expected=f"at most {MAX_VIEWS} views of one moment",
            got=f"{len(photographs)} images",
            fix="give a video as a video file; cameras of many photographs are found by gnmreg capture calibrate",
        )
    _, groups = focal_groups(photographs, "camera")
    return [_read(photograph, int(group)) for photograph, group in zip(photographs, groups, strict=True)]


def _read(photograph: Photograph, group: int) -> Still:
    pixels, _ = read_pixels(photograph, photograph.side_px)
    orientation = _orientation(photograph.file)
    return Still(
        name=photograph.name,
        file=photograph.file,
        pixels=turned_upright(pixels, orientation),
        focal_px=photograph.focal_px,
        group=group,
        orientation=orientation,
    )


def turned_upright(pixels: UInt8[np.ndarray, "H W 3"], orientation: int) -> UInt8[np.ndarray, "h w 3"]:
    """Undo the orientation that EXIF states, 1 to 8; any other number is no turn."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _orientation(file: Path) -> int:
    from PIL import Image

    try:
        with warnings.catch_warnings(), Image.open(file) as image:
            warnings.simplefilter("ignore")
            value = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # metadata may be anything; pixels have been decoded
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1
