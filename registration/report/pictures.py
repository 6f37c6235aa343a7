"""Pictures of the report as 8 bit sRGB arrays, and the metrics of each view."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.frames import linear_to_srgb
from registration.report.inputs import ReportView

Picture = UInt8[np.ndarray, "H W 3"]

PAPER = (246, 246, 243)  # background
OUTLINE = (0, 214, 190)
# Distances and differences, from small (teal) to large (crimson): even in lightness, distinct for the colour-blind.
SCALE = ((38, 128, 122), (127, 196, 168), (245, 232, 170), (242, 160, 88), (209, 68, 84), (112, 22, 56))
CLASS_COLOURS = (
    (226, 188, 160),
    (66, 133, 190),
    (98, 190, 216),
    (214, 92, 92),
    (163, 48, 84),
    (236, 170, 70),
    (110, 72, 130),
    (140, 160, 120),
    (120, 120, 128),
)
COLOUR_LIMIT = 0.25  # sRGB difference at the end of the colour scale
ANGLE_LIMIT = 40.0  # degrees at the end of the colour scale
PICTURE_HEIGHT = 640  # px; larger views are reduced to it


@dataclass(frozen=True, kw_only=True)
class ViewPictures:
    """Content of one view's card: rows of (caption, picture), and metrics, measured at full resolution."""

    name: str
    rows: dict[str, list[tuple[str, Picture]]]
    numbers: dict[str, str]


def view_pictures(view: ReportView) -> ViewPictures:
    """Compare one view: colours, normals and classes, each as target, rendering and difference."""
    target, rendered = (linear_to_srgb(rgb.astype(np.float32)) for rgb in (view.target_rgb, view.rendered_rgb))
    difference = np.where(view.compared & (view.rendered_mask > 0.5), np.abs(target - rendered).mean(-1), np.nan)
    rows = {"Colour": _colour_row(view, target, rendered, difference)}
    numbers = {}
    if np.isfinite(difference).any():
        numbers["colour"] = f"{np.nanmean(difference):.3f}"
    if view.target_normals is not None:
        angle = _normal_angle(view, view.target_normals)
        rows["Normals"] = _normal_row(view, view.target_normals, angle)
        if np.isfinite(angle).any():
            numbers["normals"] = f"{np.nanmedian(angle):.1f}°"
    if view.target_classes is not None:
        both = (view.target_classes >= 0) & (view.rendered_classes >= 0)
        wrong = both & (view.target_classes != view.rendered_classes)
        rows["Classes"] = _class_row(view, view.target_classes, target, wrong)
        if both.any():
            numbers["classes"] = f"{100 * (1 - wrong.sum() / both.sum()):.1f} %"
    if view.target_mask is not None:
        numbers["mask overlap"] = f"{100 * overlap(view.target_mask, view.rendered_mask):.1f} %"
    return ViewPictures(name=view.name, rows=rows, numbers=numbers)


def scale_colours(value: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 3"]:
    """Map values to colours in [0, 255]: 0 to 1 along the scale, other values to the end colours."""
    stops = np.linspace(0, 1, len(SCALE))
    value = np.clip(np.nan_to_num(value), 0, 1)
    return np.stack([np.interp(value, stops, np.array(SCALE, float)[:, k]) for k in range(3)], -1)


def data_uri(picture: Picture, quality: int = 86) -> str:
    """Encode a picture as a JPEG data URI."""
    ok, encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode a picture of shape {picture.shape}")
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def overlap(target: Float[np.ndarray, "H W"], rendered: Float[np.ndarray, "H W"]) -> float:
    """Compute the intersection over union of two masks; 1 if both are empty."""
    union = np.maximum(target, rendered).sum()
    return float(np.minimum(target, rendered).sum() / union) if union else 1.0


def _colour_row(
    view: ReportView, target: np.ndarray, rendered: np.ndarray, difference: np.ndarray
) -> list[tuple[str, Picture]]:
    return [
        ("capture, render's outline", _outlined(_shrunk(_bytes(target)), view.rendered_mask)),
        ("render", _shrunk(_on_paper(_bytes(rendered), view.rendered_mask))),
        (f"difference, 0 to {COLOUR_LIMIT:g}", _shrunk(_heat(difference / COLOUR_LIMIT))),
    ]


def _normal_row(view: ReportView, target: np.ndarray, angle: np.ndarray) -> list[tuple[str, Picture]]:
    return [
        ("capture", _shrunk(_on_paper(_bytes((target + 1) / 2), np.asarray(target.any(-1), np.float32)))),
        ("render", _shrunk(_on_paper(_bytes((view.rendered_normals + 1) / 2), view.rendered_mask))),
        (f"angle, 0 to {ANGLE_LIMIT:g}°", _shrunk(_heat(angle / ANGLE_LIMIT))),
    ]


def _class_row(view: ReportView, target: np.ndarray, srgb: np.ndarray, wrong: np.ndarray) -> list[tuple[str, Picture]]:
    faded = np.repeat(255 * (1 - 0.45 * (1 - srgb.mean(-1, keepdims=True))), 3, -1)
    covered = [view.rendered_mask] if view.target_mask is None else [view.rendered_mask, view.target_mask]
    disagreement = _on_paper(faded.astype(np.uint8), np.maximum.reduce(covered))
    disagreement[wrong] = SCALE[-2]
    return [
        ("capture", _shrunk(_class_picture(target))),
        ("render", _shrunk(_class_picture(view.rendered_classes))),
        ("disagreement", _shrunk(disagreement)),
    ]


def _normal_angle(view: ReportView, target: np.ndarray) -> np.ndarray:
    """Angle between the normals in degrees; NaN where either is missing."""
    both = target.any(-1) & view.rendered_normals.any(-1)
    lengths = np.linalg.norm(target, axis=-1) * np.linalg.norm(view.rendered_normals, axis=-1)
    cosine = (target * view.rendered_normals).sum(-1) / np.where(both, lengths, 1)
    return np.where(both, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def _class_picture(classes: Int[np.ndarray, "H W"]) -> Picture:
    palette = np.array([*CLASS_COLOURS, PAPER], np.uint8)
    return palette[np.where(classes < 0, len(CLASS_COLOURS), classes % len(CLASS_COLOURS))]


def _heat(value: Float[np.ndarray, "H W"]) -> Picture:
    """Values in [0, 1] as colours of the scale, NaN as background."""
    return np.where(np.isfinite(value)[..., None], scale_colours(value), PAPER).astype(np.uint8)


def _bytes(srgb: Float[np.ndarray, "H W 3"]) -> Picture:
    return (np.clip(srgb, 0, 1) * 255 + 0.5).astype(np.uint8)


def _on_paper(picture: Picture, coverage: Float[np.ndarray, "H W"]) -> Picture:
    share = np.clip(coverage, 0, 1)[..., None]
    return (picture * share + np.array(PAPER) * (1 - share) + 0.5).astype(np.uint8)


def _shrunk(picture: Picture) -> UInt8[np.ndarray, "h w 3"]:
    height, width = picture.shape[:2]
    if height <= PICTURE_HEIGHT:
        return picture
    return cv2.resize(picture, (round(width * PICTURE_HEIGHT / height), PICTURE_HEIGHT), interpolation=cv2.INTER_AREA)


def _outlined(picture: Picture, mask: Float[np.ndarray, "h w"]) -> Picture:
    """Draw the outline of a mask on a picture of any size."""
    size = (picture.shape[1], picture.shape[0])
    filled = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
    contours, _ = cv2.findContours(filled, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    drawn = picture.copy()
    cv2.drawContours(drawn, contours, -1, OUTLINE, 1 + picture.shape[0] // 600, cv2.LINE_8)
    return drawn
