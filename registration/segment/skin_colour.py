"""The person's own skin, learnt from the face, and how different the rest of the head looks, per vertex.

In each view the logarithm of the brightness of skin is a smooth function of the surface's normal: the lighting. Fitted
robustly where a face is bare skin, it predicts how bright skin would be anywhere; hair and clothes are darker,
brighter, of another colour, or of a coarser grain. The differences are medians over the views that see a vertex.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from registration.frames import srgb_to_linear
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.segment.fitted import FittedHead
from registration.segment.views import SegmentView

_BARE = ("nose_region", "forehead_region")
_BARE_SIDES = ("infraorbital", "zygomatic")
_LEAST_COSINE = 0.35
_GRAIN_M = 2.5e-3  # size of the windows whose contrast is the grain
_BLUR_M = 1.0e-3
_DARKEST = 2e-3  # linear light: below it there is no colour
_FLOORS = (0.18, 0.05, 0.05, 0.30)  # least standard deviations of brightness, two colours and grain, natural logarithms
_RIDGE = 30.0  # of the lighting's quadratic terms, in samples
_EXTRAPOLATED = 0.8  # standard deviation of the predicted brightness per radian from the nearest normal of the sample
_CLIP = 4.0  # of each difference, standard deviations: no view decides alone


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinDifference:
    """How each vertex differs from the face's skin, in its standard deviations; 0 where it is not seen."""

    brightness: Float[np.ndarray, "V"]  # signed: below 0 it is darker
    colour: Float[np.ndarray, "V"]
    grain: Float[np.ndarray, "V"]  # signed: above 0 it is coarser
    seen: Float[np.ndarray, "V"]  # how many views see it


def bare_skin(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The parts of a face that are bare skin as a rule: forehead, nose, the cheeks' upper part."""
    names = [*_BARE, *(f"{side}_{name}_region" for side in ("left", "right") for name in _BARE_SIDES)]
    return np.asarray(np.max([group(data, name) for name in names], axis=0) > 0.7)


def skin_difference(
    head: FittedHead, views: Sequence[SegmentView], subjects: Sequence[Bool[np.ndarray, "_ _"]]
) -> SkinDifference:
    """Compare the whole head with its face's skin.

    Args:
        head: fitted to within some millimetres.
        views: windows of the photographs, at a working resolution.
        subjects: what surely shows the subject in each; of their sizes.
    """
    bare = bare_skin(head.data)
    pairs = zip(views, subjects, strict=True)
    found = [one for view, subject in pairs if (one := _in_view(head, view, subject, bare)) is not None]
    count = len(head.vertices)
    if not found:
        zero = np.zeros(count)
        return SkinDifference(brightness=zero, colour=zero, grain=zero, seen=zero)
    stacked = np.full((len(found), count, 3), np.nan)
    for number, (rows, values) in enumerate(found):
        stacked[number, rows] = values
    seen = np.isfinite(stacked[..., 0]).sum(0)
    middle = np.zeros((count, 3))
    middle[seen > 0] = np.nanmedian(stacked[:, seen > 0], axis=0)
    return SkinDifference(
        brightness=middle[:, 0], colour=middle[:, 1], grain=middle[:, 2], seen=seen.astype(np.float64)
    )


def _in_view(
    head: FittedHead, view: SegmentView, subject: Bool[np.ndarray, "H W"], bare: Bool[np.ndarray, "V"]
) -> tuple[np.ndarray, Float[np.ndarray, "S 3"]] | None:
    """The vertices that a view sees, and their differences in it; None if it shows too little bare skin."""
    rows = head.seen(view.camera, _LEAST_COSINE)
    column, row = np.floor(view.camera.project(head.vertices[rows])[0]).astype(int).T
    rows = rows[subject[row.clip(0, subject.shape[0] - 1), column.clip(0, subject.shape[1] - 1)]]
    if bare[rows].sum() < 100:
        return None
    features = _features(head, view, rows)
    normals = head.normals[rows]
    sample = bare[rows]
    features[:, 0] -= _lighting(normals, features[:, 0], sample)
    middle = np.median(features[sample], axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(features[sample] - middle), axis=0), _FLOORS)
    spread = np.repeat(spread[None], len(rows), 0)
    turned = cKDTree(normals[sample]).query(normals)[0]
    spread[:, 0] = np.hypot(spread[:, 0], _EXTRAPOLATED * turned)
    scaled = np.clip((features - middle) / spread, -_CLIP, _CLIP)
    return rows, np.stack([scaled[:, 0], np.hypot(scaled[:, 1], scaled[:, 2]), scaled[:, 3]], 1)


def _features(head: FittedHead, view: SegmentView, rows: np.ndarray) -> Float[np.ndarray, "S 4"]:
    """Logarithms: brightness, red over green, blue over green, and grain, at some vertices."""
    xy, depth = view.camera.project(head.vertices[rows])
    px_per_m = float(view.camera.intrinsics[0, 0] / np.median(depth))
    linear = srgb_to_linear(view.image.astype(np.float32) / 255) + _DARKEST
    light = np.log(linear.mean(-1))
    window = max(3, round(2 * _GRAIN_M * px_per_m)) | 1
    mean, square = (cv2.boxFilter(value, -1, (window, window)) for value in (light, light * light))
    grain = 0.5 * np.log(np.maximum(square - mean * mean, 0) + 1e-4)
    smooth = cv2.GaussianBlur(linear, (0, 0), max(0.5, _BLUR_M * px_per_m))
    logs = np.log(smooth)
    channels = np.stack([logs.mean(-1), logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1], grain], -1)
    x, y = (xy - 0.5).astype(np.float32).T
    sampled = cv2.remap(channels.astype(np.float32), x[:, None], y[:, None], cv2.INTER_LINEAR)
    return np.asarray(sampled[:, 0], np.float64)


def _lighting(
    normals: Float[np.ndarray, "S 3"], brightness: Float[np.ndarray, "S"], sample: Bool[np.ndarray, "S"]
) -> Float[np.ndarray, "S"]:
    """The brightness of skin at all normals, from that of a sample."""
    x, y, z = normals.T
    basis = np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], 1)
    design, values = basis[sample], brightness[sample]
    stiff = np.diag([0.0] + 3 * [1.0] + 5 * [_RIDGE]) * 1e-1
    weight = np.ones(len(values))
    for _ in range(8):
        solution = np.linalg.solve(design.T @ (design * weight[:, None]) + stiff, design.T @ (weight * values))
        residual = np.abs(design @ solution - values)
        weight = 1 / (residual + 0.5 * np.median(residual) + 1e-3)
        weight /= weight.mean()
    low, high = np.quantile(design @ solution, (0.01, 0.99))
    return (basis @ solution).clip(low - 0.5, high + 0.5)
