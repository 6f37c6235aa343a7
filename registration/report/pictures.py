"""Images of the report, 8 bit sRGB: comparisons of each view, and the colour scale."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.frames import linear_to_srgb
from registration.report.inputs import ReportView

RgbImage = UInt8[np.ndarray, "H W 3"]

BACKGROUND = (246, 246, 243)
OUTLINE = (0, 214, 190)
# Distances and differences, from small (teal) to large (crimson): even in lightness, distinct for the colour-blind.
COLOUR_SCALE = ((38, 128, 122), (127, 196, 168), (245, 232, 170), (242, 160, 88), (209, 68, 84), (112, 22, 56))
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
MAX_IMAGE_HEIGHT = 640  # px; larger views are downscaled


@dataclass(frozen=True, kw_only=True)
class ViewImages:
    """The comparison of one view."""

    name: str
    rows: dict[str, list[tuple[str, RgbImage]]]  # title -> captions and images


def view_images(view: ReportView) -> ViewImages:
    """Compare the colours, normals and classes of one view.

    Args:
        view: its optional targets may be missing; their rows are then omitted.

    Returns:
        A row of target, rendering and difference for each of colour, normals and classes.
    """
    target, rendered = (linear_to_srgb(rgb.astype(np.float32)) for rgb in (view.target_rgb, view.rendered_rgb))
    rows = {"Colour": _colour_row(view, target, rendered)}
    if view.target_normals is not None:
        rows["Normals"] = _normal_row(view, view.target_normals)
    if view.target_classes is not None:
        both = (view.target_classes >= 0) & (view.rendered_classes >= 0)
        wrong = both & (view.target_classes != view.rendered_classes)
        rows["Classes"] = _class_row(view, view.target_classes, target, wrong)
    return ViewImages(name=view.name, rows=rows)


def scale_colours(value: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 3"]:
    """Return the colours, in [0, 255], of values on a scale from 0 to 1; other values get the end colours."""
    stops = np.linspace(0, 1, len(COLOUR_SCALE))
    value = np.clip(np.nan_to_num(value), 0, 1)
    return np.stack([np.interp(value, stops, np.array(COLOUR_SCALE, float)[:, k]) for k in range(3)], -1)


def jpeg(image: RgbImage, quality: int = 86) -> bytes:
    """Encode an image as a JPEG file.

    Args:
        image: 8 bit sRGB.
        quality: up to 100.

    Raises:
        ValueError: OpenCV cannot encode the array.
    """
    ok, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape}")
    return encoded.tobytes()


def data_uri(image: RgbImage, quality: int = 86) -> str:
    """Encode an image as the data URI of a JPEG; arguments and errors as for `jpeg`."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(image, quality)).decode("ascii")


def _colour_row(view: ReportView, target: np.ndarray, rendered: np.ndarray) -> list[tuple[str, RgbImage]]:
    difference = np.where(view.compared & (view.rendered_mask > 0.5), np.abs(target - rendered).mean(-1), np.nan)
    return [
        ("capture, outline of the rendering", _with_outline(_downscaled(_to_uint8(target)), view.rendered_mask)),
        ("rendering", _downscaled(_over_background(_to_uint8(rendered), view.rendered_mask))),
        (f"difference, 0 to {COLOUR_LIMIT:g}", _downscaled(_scale_image(difference / COLOUR_LIMIT))),
    ]


def _normal_row(view: ReportView, target: np.ndarray) -> list[tuple[str, RgbImage]]:
    angle = _normal_angle(view, target)
    return [
        ("capture", _downscaled(_over_background(_to_uint8((target + 1) / 2), np.asarray(target.any(-1), np.float32)))),
        ("rendering", _downscaled(_over_background(_to_uint8((view.rendered_normals + 1) / 2), view.rendered_mask))),
        (f"angle, 0 to {ANGLE_LIMIT:g}°", _downscaled(_scale_image(angle / ANGLE_LIMIT))),
    ]


def _class_row(view: ReportView, target: np.ndarray, srgb: np.ndarray, wrong: np.ndarray) -> list[tuple[str, RgbImage]]:
    faded = np.repeat(255 * (1 - 0.45 * (1 - srgb.mean(-1, keepdims=True))), 3, -1)
    masks = [view.rendered_mask] if view.target_mask is None else [view.rendered_mask, view.target_mask]
    disagreement = _over_background(faded.astype(np.uint8), np.maximum.reduce(masks))
    disagreement[wrong] = COLOUR_SCALE[-2]
    return [
        ("capture", _downscaled(_class_image(target))),
        ("rendering", _downscaled(_class_image(view.rendered_classes))),
        ("disagreement", _downscaled(disagreement)),
    ]


def _normal_angle(view: ReportView, target: np.ndarray) -> np.ndarray:
    """Return the angle between the normals, degrees; NaN where either is missing."""
    both = target.any(-1) & view.rendered_normals.any(-1)
    lengths = np.linalg.norm(target, axis=-1) * np.linalg.norm(view.rendered_normals, axis=-1)
    cosine = (target * view.rendered_normals).sum(-1) / np.where(both, lengths, 1)
    return np.where(both, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def _class_image(classes: Int[np.ndarray, "H W"]) -> RgbImage:
    palette = np.array([*CLASS_COLOURS, BACKGROUND], np.uint8)
    return palette[np.where(classes < 0, len(CLASS_COLOURS), classes % len(CLASS_COLOURS))]


def _scale_image(value: Float[np.ndarray, "H W"]) -> RgbImage:
    """Return the colours of values in [0, 1], and the background where they are NaN."""
    return np.where(np.isfinite(value)[..., None], scale_colours(value), BACKGROUND).astype(np.uint8)


def _to_uint8(srgb: Float[np.ndarray, "H W 3"]) -> RgbImage:
    return (np.clip(srgb, 0, 1) * 255 + 0.5).astype(np.uint8)


def _over_background(image: RgbImage, coverage: Float[np.ndarray, "H W"]) -> RgbImage:
    alpha = np.clip(coverage, 0, 1)[..., None]
    return (image * alpha + np.array(BACKGROUND) * (1 - alpha) + 0.5).astype(np.uint8)


def _downscaled(image: RgbImage) -> UInt8[np.ndarray, "h w 3"]:
    height, width = image.shape[:2]
    if height <= MAX_IMAGE_HEIGHT:
        return image
    size = (round(width * MAX_IMAGE_HEIGHT / height), MAX_IMAGE_HEIGHT)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _with_outline(image: RgbImage, mask: Float[np.ndarray, "h w"]) -> RgbImage:
    """Draw the mask's outline on an image, which may have another size."""
    size = (image.shape[1], image.shape[0])
    filled = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
    contours, _ = cv2.findContours(filled, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    outlined = image.copy()
    cv2.drawContours(outlined, contours, -1, OUTLINE, 1 + image.shape[0] // 600, cv2.LINE_8)
    return outlined
