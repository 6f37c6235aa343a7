"""Pictures of a calibration: every photograph with the residuals of its points."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from registration.calibrate.photographs import read_pixels
from registration.calibrate.result import CalibratedView, Calibration
from registration.storage.files import atomic_file

_TILE, _HEADING, _CAPTION, _COLUMNS = 300, 64, 46, 6  # px of the page
_STRETCH = 10  # residuals are drawn so much longer
_GOOD, _FAIR, _BAD, _LANDMARK = (60, 200, 90), (245, 190, 40), (230, 50, 40), (90, 150, 255)
_FAIR_PX, _BAD_PX = 0.5, 1.5  # residuals above which a track's point is drawn fair and bad
_INK, _FAINT, _PAGE = (30, 32, 38), (110, 114, 122), (250, 250, 248)


def draw_residuals(calibration: Calibration, path: Path) -> None:
    """Write a PNG file: each view with its points, and their residuals ten times as long.

    Args:
        calibration: its photographs are decoded again.
        path: of the file.
    """
    columns = min(_COLUMNS, len(calibration.views))
    rows = math.ceil(len(calibration.views) / columns)
    tiles = [_tile(view) for view in calibration.views]
    height = max(tile.height for tile in tiles)
    page = Image.new("RGB", (columns * _TILE, _HEADING + rows * (height + _CAPTION)), _PAGE)
    pen = ImageDraw.Draw(page)
    pen.text((10, 4), f"Residuals, {_STRETCH} times as long", _INK, ImageFont.load_default(24))
    x = 10.0
    for text, colour in (
        (f"feature below {_FAIR_PX:g} px", _GOOD),
        (f"below {_BAD_PX:g} px", _FAIR),
        ("above", _BAD),
        ("landmark", _LANDMARK),
    ):
        pen.rectangle((x, 40, x + 12, 52), fill=colour)
        pen.text((x + 17, 35), text, _FAINT, ImageFont.load_default(17))
        x += 17 + pen.textlength(text, ImageFont.load_default(17)) + 18
    for number, (view, tile) in enumerate(zip(calibration.views, tiles, strict=True)):
        left, top = number % columns * _TILE, _HEADING + number // columns * (height + _CAPTION)
        page.paste(tile, (left, top))
        name = view.photograph.name[-26:]
        pen.text((left + 5, top + height + 1), name, _INK, ImageFont.load_default(18))
        rms = f"{view.tracks_rms_px:.2f} px" if view.tracks else "none"
        caption = f"{view.tracks} features {rms}, focal {view.camera.intrinsics[0, 0]:.0f} px"
        pen.text((left + 5, top + height + 22), caption, _FAINT, ImageFont.load_default(15))
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def _tile(view: CalibratedView) -> Image.Image:
    """The photograph, faded, with its residuals."""
    pixels, factor = read_pixels(view.photograph, _TILE * 2)
    image = Image.fromarray(_faded(pixels))
    pen = ImageDraw.Draw(image)
    observed, residual = view.observed_px / factor, view.residual_px / factor
    for (x, y), (dx, dy), is_track, length in zip(
        observed, residual, view.is_track, np.linalg.norm(view.residual_px, axis=1), strict=True
    ):
        if not np.isfinite(length):
            continue
        colour = _LANDMARK if not is_track else _GOOD if length < _FAIR_PX else _FAIR if length < _BAD_PX else _BAD
        pen.line((x, y, x + _STRETCH * dx, y + _STRETCH * dy), fill=colour, width=1)
        radius = 1.5 if is_track else 0.7
        pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
    size = _TILE - 6, round((_TILE - 6) * image.height / image.width)
    return image.resize(size, Image.Resampling.LANCZOS)


def _faded(pixels: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Grey and pale, so that colours stand out."""
    grey = pixels.mean(-1, keepdims=True)
    return np.repeat(110 + 0.55 * grey, 3, axis=-1).astype(np.uint8)
