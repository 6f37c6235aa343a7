"""The contact sheet of a capture: every undistorted image with its mask outline, scan and landmarks."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from registration.capture.pixels import read_view, undistort_landmarks
from registration.capture.scan import Scan
from registration.capture.triangulation import MIN_CONFIDENCE, inlier_limit_px, residuals
from registration.frames import linear_to_srgb
from registration.storage.files import atomic_file
from registration.types import Camera, Capture, View

TILE_WIDTH_PX = 320
CAPTION_PX = 40
SCAN_POINTS = 60_000  # tested for visibility; a tenth of them is drawn
JAW = 17  # the first points of the 68 scheme: joined by a line, so that a wrong order shows
VISIBLE_M = 0.008  # a point this much behind the nearest one in its neighbourhood is hidden
_BACKGROUND, _INK, _FAINT = (24, 24, 28), (235, 235, 235), (165, 165, 170)
_SCAN, _MASK, _USED, _UNUSED, _TRIANGULATED, _OUTLIER = (
    (60, 200, 255),
    (255, 210, 60),
    (70, 255, 90),
    (170, 170, 170),
    (255, 90, 220),
    (255, 50, 40),
)


def draw_contact_sheet(
    capture: Capture,
    captions: Mapping[str, str],
    scheme: str | None,
    points: Float[np.ndarray, "L 3"],
    scan: Scan | None,
    path: Path,
) -> None:
    """Write the sheet as a PNG file.

    Args:
        capture: the capture.
        captions: view's name -> a line below its image.
        scheme: the landmark scheme that is drawn; None: none.
        points: the triangulated landmarks of `scheme`, metres, world.
        scan: drawn as points, if there is one.
        path: the file; its folder is created.
    """
    cloud = np.zeros((0, 3))
    if scan is not None:  # evenly sampled
        cloud = scan.vertices[np.unique(np.linspace(0, len(scan.vertices) - 1, SCAN_POINTS).astype(int))]
    aspect = float(np.median([view.camera.height_px / view.camera.width_px for view in capture.views]))
    tile = (TILE_WIDTH_PX, round(TILE_WIDTH_PX * aspect))
    columns = min(len(capture.views), math.ceil(math.sqrt(1.6 * len(capture.views) * aspect)))
    rows = math.ceil(len(capture.views) / columns)
    cell = (tile[0] + 8, tile[1] + CAPTION_PX)
    page = Image.new("RGB", (max(columns * cell[0], 720) + 8, rows * cell[1] + 72), _BACKGROUND)
    _write_heading(page, capture, scan is not None, scheme)
    pen = ImageDraw.Draw(page)
    for number, view in enumerate(capture.views):
        image = _draw_tile(view, capture, tile, scheme, points, cloud)
        x, y = 8 + number % columns * cell[0], 72 + number // columns * cell[1]
        page.paste(Image.fromarray(image), (x + (tile[0] - image.shape[1]) // 2, y + tile[1] - image.shape[0]))
        pen.text((x, y + tile[1] + 3), view.name, _INK, font(14))
        size = f"{view.camera.width_px} x {view.camera.height_px}"
        pen.text((x + tile[0], y + tile[1] + 5), size, _FAINT, font(12), anchor="ra")
        pen.text((x, y + tile[1] + 20), captions[view.name], _FAINT, font(12))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of captions and headings."""
    return ImageFont.load_default(size)


def _write_heading(page: Image.Image, capture: Capture, scan: bool, scheme: str | None) -> None:
    pen = ImageDraw.Draw(page)
    pen.text((8, 8), f"{capture.subject}, {capture.expression}: {len(capture.views)} views", _INK, font(24))
    entries = [(_MASK, "mask outline")] if any(view.mask for view in capture.views) else []
    entries += [(_SCAN, "scan, visible points")] if scan else []
    if scheme is not None:
        entries += [
            (_USED, f"landmarks {scheme}"),
            (_UNUSED, f"confidence up to {MIN_CONFIDENCE}: unused"),
            (_TRIANGULATED, "triangulated"),
            (_OUTLIER, "contradict other views"),
        ]
    x = 8.0
    for colour, text in entries:
        pen.rectangle((x, 49, x + 12, 61), fill=colour)
        pen.text((x + 18, 46), text, _INK, font(14))
        x += 18 + pen.textlength(text, font(14)) + 22


def _draw_tile(
    view: View,
    capture: Capture,
    tile: tuple[int, int],
    scheme: str | None,
    points: Float[np.ndarray, "L 3"],
    cloud: Float[np.ndarray, "P 3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """The image of one view, at most `tile` (width, height) px."""
    full = view.camera
    reduction = max(full.width_px / tile[0], full.height_px / tile[1])
    reduced = replace(view, normals=None, depth=None, segmentation=None)
    decoded = read_view(reduced, capture, downsample=max(1, math.floor(reduction)))
    scale = min(tile[0] / decoded.camera.width_px, tile[1] / decoded.camera.height_px)
    camera = decoded.camera.scaled(
        max(1, round(scale * decoded.camera.width_px)), max(1, round(scale * decoded.camera.height_px))
    )
    size = (camera.width_px, camera.height_px)
    resized = cv2.resize(decoded.rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    image = np.round(255 * linear_to_srgb(resized)).astype(np.uint8)
    if decoded.mask is not None:
        inside = (cv2.resize(decoded.mask, size, interpolation=cv2.INTER_LINEAR) > 0.5).astype(np.uint8)
        contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, contours, -1, _MASK, 1, cv2.LINE_AA)
    _draw_scan(image, camera, cloud)
    if scheme is not None and scheme in view.landmarks:
        _draw_landmarks(image, camera, view, scheme, points)
    return image


def _draw_scan(
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    cloud: Float[np.ndarray, "P 3"],
) -> None:
    """Every tenth scan point that is not behind others."""
    if not len(cloud):
        return
    height, width = image.shape[:2]
    xy, depth = camera.project(cloud)
    inside = (depth > 0) & (xy >= 0).all(-1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    cells = np.floor(xy[inside] / 4).astype(int)
    nearest = np.full((height // 4 + 1, width // 4 + 1), np.inf, np.float32)
    np.minimum.at(nearest, (cells[:, 1], cells[:, 0]), depth[inside].astype(np.float32))
    nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    visible = np.zeros(len(cloud), bool)
    visible[inside] = depth[inside] < nearest[cells[:, 1], cells[:, 0]] + VISIBLE_M
    shown = np.flatnonzero(visible)
    for x, y in xy[shown[:: max(1, min(10, len(shown) // 500))]]:
        cv2.circle(image, subpixel(x, y), 10, _SCAN, -1, cv2.LINE_AA, shift=4)


def _draw_landmarks(
    image: UInt8[np.ndarray, "h w 3"], camera: Camera, view: View, scheme: str, points: Float[np.ndarray, "L 3"]
) -> None:
    """Detected landmarks, their triangulated counterparts, and for outliers a line between the two."""
    landmarks = undistort_landmarks(view, scheme)
    detected = landmarks[:, :2] * np.diag(camera.intrinsics)[:2] / np.diag(view.camera.intrinsics)[:2]
    projected, depth = camera.project(points)
    outlier = residuals(view, scheme, points) > inlier_limit_px(view.camera)
    jaw = [index for index in range(JAW if scheme == "68" else 0) if landmarks[index, 2] > MIN_CONFIDENCE]
    for first, second in zip(jaw, jaw[1:], strict=False):
        cv2.line(image, subpixel(*detected[first]), subpixel(*detected[second]), _USED, 1, cv2.LINE_AA, shift=4)
    for index in range(len(landmarks)):
        used, center = landmarks[index, 2] > MIN_CONFIDENCE, subpixel(*detected[index])
        if np.isfinite(projected[index]).all() and used:
            x, y = projected[index]
            for a, b in ((subpixel(x - 4, y), subpixel(x + 4, y)), (subpixel(x, y - 4), subpixel(x, y + 4))):
                cv2.line(image, a, b, _TRIANGULATED, 1, cv2.LINE_AA, shift=4)
        colour = (_OUTLIER if outlier[index] else _USED) if used else _UNUSED
        if outlier[index] and depth[index] > 0:
            cv2.line(image, center, subpixel(*projected[index]), _OUTLIER, 1, cv2.LINE_AA, shift=4)
        cv2.circle(image, center, 28, colour, -1 if used else 1, cv2.LINE_AA, shift=4)


def subpixel(x: float, y: float) -> tuple[int, int]:
    """Convert pixel coordinates to OpenCV's with 4 fractional bits, clipped far outside the image to avoid overflow."""
    return round(float(np.clip(x - 0.5, -1e4, 1e4)) * 16), round(float(np.clip(y - 0.5, -1e4, 1e4)) * 16)
