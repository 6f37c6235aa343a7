"""Pictures of what was made: landmarks, masks and labels, normals and confidences beside the photographs."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from registration.capture.pixels import read_view, undistort_landmarks
from registration.fit.initialization import select_spread_views
from registration.frames import linear_to_srgb
from registration.storage.files import atomic_file
from registration.types import Capture, View, ViewPixels

SHEET = "made.jpg"
_VIEWS = 4  # that are shown, spread around the head
_TILE_PX = 300  # width of one picture
_CAPTION_PX = 26
_MARGIN = 0.15  # around the subject
_DOT = (70, 255, 90)
_DARK, _INK = (24, 24, 28), (235, 235, 235)
_BACKGROUND = "background"
COLUMNS = ("photograph", "landmarks", "mask and labels", "normals", "confidence")


def draw_made(capture: Capture, scheme: str, path: Path) -> None:
    """Write the sheet as a JPEG file: a row for each of some views, a column for each channel.

    Args:
        capture: with the made channels.
        scheme: of the landmarks that are drawn.
        path: of the file.
    """
    chosen = [capture.views[i] for i in select_spread_views([view.camera for view in capture.views], _VIEWS)]
    rows = [_row(view, capture, scheme) for view in chosen]
    width = len(COLUMNS) * _TILE_PX
    height = sum(row.shape[0] for row in rows) + _CAPTION_PX * (1 + len(rows))
    sheet = Image.new("RGB", (width, height), _DARK)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=15)
    for column, title in enumerate(COLUMNS):
        draw.text((column * _TILE_PX + 6, 4), title, fill=_INK, font=font)
    top = _CAPTION_PX
    for view, row in zip(chosen, rows, strict=True):
        sheet.paste(Image.fromarray(row), (0, top))
        top += row.shape[0]
        draw.text((6, top + 3), _caption(view, capture), fill=_INK, font=font)
        top += _CAPTION_PX
    with atomic_file(path) as temporary:
        sheet.save(temporary, quality=88)


def _row(view: View, capture: Capture, scheme: str) -> UInt8[np.ndarray, "h w 3"]:
    pixels = read_view(view, capture)
    image = np.round(255 * linear_to_srgb(pixels.rgb)).astype(np.uint8)
    window = _window(pixels)
    scale = _TILE_PX / (window[1].stop - window[1].start)
    tiles = [image, _with_landmarks(image, view, scheme, scale), _with_labels(image, pixels, capture.classes)]
    normals = np.zeros_like(image)
    if pixels.normals is not None:
        normals = np.round(255 * (0.5 + 0.5 * pixels.normals * (1, -1, -1)) * pixels.normals.any(-1, keepdims=True))
    confidence = np.zeros(image.shape[:2]) if pixels.confidence is None else pixels.confidence
    tiles += [normals.astype(np.uint8), np.repeat(np.round(255 * confidence).astype(np.uint8)[..., None], 3, -1)]
    size = (_TILE_PX, round((window[0].stop - window[0].start) * scale))
    return np.hstack([cv2.resize(tile[window], size, interpolation=cv2.INTER_AREA) for tile in tiles])


def _window(pixels: ViewPixels) -> tuple[slice, slice]:
    """The part of the image around what is compared."""
    shown = np.ones(pixels.rgb.shape[:2], bool) if pixels.mask is None else pixels.mask > 0.5
    if not shown.any():
        shown[:] = True
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(shown.any(axis))
        margin = int(_MARGIN * np.ptp(where))
        spans.append(slice(max(0, where[0] - margin), min(shown.shape[1 - axis], where[-1] + 1 + margin)))
    return spans[0], spans[1]


def _with_landmarks(
    image: UInt8[np.ndarray, "H W 3"], view: View, scheme: str, scale: float
) -> UInt8[np.ndarray, "H W 3"]:
    drawn = image.copy()
    if scheme in view.landmarks:
        for x, y, confidence in undistort_landmarks(view, scheme):
            if confidence > 0:
                cv2.circle(drawn, (int(x), int(y)), max(1, round(1.2 / scale)), _DOT, -1, cv2.LINE_AA)
    return drawn


def _with_labels(
    image: UInt8[np.ndarray, "H W 3"], pixels: ViewPixels, classes: Sequence[str]
) -> UInt8[np.ndarray, "H W 3"]:
    """The labels as colours over the image; what is not the subject is dark."""
    result = image.astype(np.float32)
    if pixels.label_coverage is not None:
        colours = np.array([class_colour(k, name) for k, name in enumerate(classes)], np.float32)
        shown = [name != _BACKGROUND for name in classes]
        result = 0.5 * result + 0.5 * (pixels.label_coverage[..., shown] @ colours[shown])
    if pixels.mask is not None:
        result *= 0.25 + 0.75 * pixels.mask[..., None]
    return np.clip(np.round(result), 0, 255).astype(np.uint8)


def class_colour(index: int, name: str) -> Float[np.ndarray, "3"]:
    """Return the colour of a class in pictures, 0 to 255; the skin is shown as it is photographed."""
    hue = np.array([[[int(index * 137.5 / 2) % 180, 170, 240]]], np.uint8)
    return cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float32) if name != "skin" else np.full(3, 200.0)


def _caption(view: View, capture: Capture) -> str:
    return view.name
