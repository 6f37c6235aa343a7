"""The sheet of detected landmarks: every view with its faces, their points by residual, and what is refused."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from registration.capture.pixels import read_photograph
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.detect.capture_landmarks import CaptureLandmarks, ViewDetection
from registration.detect.provider import Face
from registration.doctor.contact_sheet import font, subpixel
from registration.storage.files import atomic_file
from registration.types import Capture, View

_TILE = (300, 360)  # px, of pictures
_CAPTION_PX, _GAP, _HEADING_PX = 84, 8, 150
_MAX_COLUMNS = 4  # so that captions stay legible where the sheet is shown small
_MARGIN = 0.6  # around a face, relative to its size
_BACKGROUND, _INK, _FAINT = (24, 24, 28), (240, 240, 240), (175, 175, 180)
_USED, _REFUSED, _NONE, _HIDDEN = (80, 210, 100), (255, 70, 60), (120, 120, 126), (150, 150, 155)
_SCALE = 3.5  # a residual of this many spreads has the last colour


@dataclass(frozen=True, kw_only=True, eq=False)
class _Window:
    """A part of an image, shown in a tile."""

    low: Float[np.ndarray, "2"]  # px of the undistorted image
    scale: float  # px of the tile per px of the image

    def place(self, points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        return (points - self.low) * self.scale


def draw_detections(capture: Capture, landmarks: CaptureLandmarks, path: Path) -> None:
    """Write the sheet as a PNG file.

    A view with a used face shows it from near, its points from green to red by their residual, in multiples of their
    spread; other views are shown whole, with the boxes of refused faces.

    Args:
        capture: the capture.
        landmarks: what was detected in it.
        path: the file; its folder is created.
    """
    columns = min(len(capture.views), _MAX_COLUMNS)
    rows = math.ceil(len(capture.views) / columns)
    cell = (_TILE[0] + _GAP, _TILE[1] + _CAPTION_PX + _GAP)
    width = max(columns * cell[0], 3 * cell[0]) + _GAP
    page = Image.new("RGB", (width, _HEADING_PX + rows * cell[1]), _BACKGROUND)
    _write_heading(page, capture, landmarks)
    pen = ImageDraw.Draw(page)
    detections = {detection.name: detection for detection in landmarks.views}
    for number, view in enumerate(capture.views):
        detection = detections[view.name]
        x, y = _GAP + number % columns * cell[0], _HEADING_PX + number // columns * cell[1]
        image = Image.fromarray(_draw_view(view, detection))
        page.paste(image, (x + (_TILE[0] - image.width) // 2, y + (_TILE[1] - image.height) // 2))
        colour = {"used": _USED, "refused": _REFUSED, "none": _NONE}[detection.state]
        pen.rectangle((x, y, x + _TILE[0] - 1, y + _TILE[1] - 1), outline=colour, width=5)
        pen.text((x, y + _TILE[1] + 2), _fitted(pen, view.name, 26), _INK, font(26))
        for line, text in enumerate(_lines(pen, detection.caption)):
            pen.text((x, y + _TILE[1] + 32 + 24 * line), text, _FAINT if colour != _REFUSED else _REFUSED, font(22))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def _write_heading(page: Image.Image, capture: Capture, landmarks: CaptureLandmarks) -> None:
    pen = ImageDraw.Draw(page)
    pen.text((_GAP, 8), _fitted(pen, f"{capture.subject}, {capture.expression}", 34, page.width), _INK, font(34))
    colour = _INK if landmarks.usable else _REFUSED
    pen.text((_GAP, 50), _fitted(pen, landmarks.reason, 26, page.width), colour, font(26))
    x = float(_GAP)
    for shade, text in (
        (_ramp(0.0), "agrees"),
        (_ramp(1.0), f"{_SCALE:g} spreads off"),
        (_HIDDEN, "hidden"),
        (_REFUSED, "refused"),
    ):
        pen.rectangle((x, 100, x + 22, 122), fill=shade)
        pen.text((x + 30, 96), text, _FAINT, font(24))
        x += 30 + pen.textlength(text, font(24)) + 26


def _draw_view(view: View, detection: ViewDetection) -> UInt8[np.ndarray, "h w 3"]:
    face = None if detection.chosen is None else detection.faces[detection.chosen]
    low, high = _part(view, face)
    step = max(1, math.floor(((high - low) / _TILE).max()))
    pixels, _ = read_photograph(view, downsample=step)
    scale = min(_TILE[0] / (high - low)[0], _TILE[1] / (high - low)[1])
    window = _Window(low=low, scale=scale)
    size = tuple(max(1, round(float(side))) for side in (high - low) * scale)
    # The tile's pixel (0, 0) has its centre at (0.5, 0.5), as the image's; OpenCV counts from the centres.
    matrix = np.array([[1 / (scale * step), 0, 0.0], [0, 1 / (scale * step), 0.0]])
    matrix[:, 2] = low / step + 0.5 / (scale * step) - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpAffine(pixels, matrix, size, flags=flags, borderValue=_BACKGROUND)
    for number, other in enumerate(detection.faces):
        if number != detection.chosen:
            corners = window.place(np.array([other.box[:2], other.box[2:]]))
            cv2.rectangle(image, subpixel(*corners[0]), subpixel(*corners[1]), _REFUSED, 3, cv2.LINE_AA, shift=4)
    if face is not None:
        _draw_points(image, detection, face, window)
    return image


def _part(view: View, face: Face | None) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Corners of what is shown: a face and its surroundings in the tile's proportions, or the whole image."""
    if face is None:
        return np.zeros(2), np.array([view.camera.width_px, view.camera.height_px], np.float64)
    low, high = face.points.min(0), face.points.max(0)
    centre, side = (low + high) / 2, float((high - low).max()) * (1 + _MARGIN)
    half = np.array([side * _TILE[0] / _TILE[1], side]) / 2
    return centre - half, centre + half


def _draw_points(image: UInt8[np.ndarray, "h w 3"], detection: ViewDetection, face: Face, window: _Window) -> None:
    off = detection.residual_px / (_SCALE * detection.spread_px)
    order = np.argsort(np.nan_to_num(off, nan=-1.0))  # the worst on top
    places = window.place(face.points)
    for k in order:
        hidden = face.confidence[k] <= MIN_CONFIDENCE
        colour = _HIDDEN if hidden else _ramp(0.0 if np.isnan(off[k]) else float(off[k]))
        cv2.circle(image, subpixel(*places[k]), 26, colour, -1, cv2.LINE_AA, shift=4)


def _ramp(value: float) -> tuple[int, int, int]:
    """From green over yellow to red."""
    value = float(np.clip(value, 0, 1))
    return round(255 * min(1.0, 2 * value)), round(255 * min(1.0, 2 - 2 * value)), 60


def _lines(pen: ImageDraw.ImageDraw, text: str) -> list[str]:
    """A caption in at most two lines."""
    words, lines = text.split(), [""]
    for word in words:
        longer = f"{lines[-1]} {word}".strip()
        if pen.textlength(longer, font(22)) <= _TILE[0] or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines if len(lines) <= 2 else [lines[0], _fitted(pen, " ".join(lines[1:]), 22)]


def _fitted(pen: ImageDraw.ImageDraw, text: str, size: int, width: float = _TILE[0]) -> str:
    """A text shortened to a width, px."""
    if pen.textlength(text, font(size)) <= width:
        return text
    while text and pen.textlength(f"{text} ...", font(size)) > width:
        text = text[:-1]
    return f"{text.rstrip()} ..."
