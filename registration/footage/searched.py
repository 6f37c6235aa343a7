"""Where no face was found: a picture of what was searched, and the error that says what to do."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from registration.doctor.contact_sheet import font
from registration.errors import InputError
from registration.storage.files import atomic_file

_TILE_PX, _CAPTION_PX, _COLUMNS = 480, 40, 4
_INK, _PAGE = (30, 32, 38), (250, 250, 248)
_MAX_SHOWN = 12


def no_face(images: Sequence[tuple[str, UInt8[np.ndarray, "H W 3"]]], source: object, out: Path) -> InputError:
    """Return the error for images without a face, after a picture of them was written beside `out`.

    Args:
        images: name and pixels, sRGB.
        source: the input, for the message.
        out: the folder that would have been written.
    """
    picture = Path(out).with_name(f"{Path(out).name}.searched.png")
    _draw(images[:_MAX_SHOWN], picture)
    return InputError(
        "No face was found",
        where=source,
        expected="a face that looks about towards a camera, 60 px wide or more, not covered",
        got=f"none in {len(images)} images, upright, turned and in tiles; {picture} shows what was searched",
        fix="choose another image, cut out the head, or give landmarks with --landmarks",
    )


def _draw(images: Sequence[tuple[str, UInt8[np.ndarray, "H W 3"]]], path: Path) -> None:
    columns = min(len(images), _COLUMNS)
    rows = -(-len(images) // columns)
    page = Image.new("RGB", (columns * _TILE_PX, rows * (_TILE_PX + _CAPTION_PX)), _PAGE)
    pen = ImageDraw.Draw(page)
    for k, (name, pixels) in enumerate(images):
        height, width = pixels.shape[:2]
        scale = _TILE_PX / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        left, top = k % columns * _TILE_PX, k // columns * (_TILE_PX + _CAPTION_PX)
        page.paste(Image.fromarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)), (left, top))
        pen.text((left + 6, top + _TILE_PX + 4), f"no face: {name[-24:]}, {width} x {height}", _INK, font(24))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")
