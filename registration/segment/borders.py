"""The borders of eyes, lips and the open mouth: landmarks where they are sure, the fitted model, and the image's edges.

Both say roughly where a region is; between what both hold for it and what neither does, the colours on its two sides
decide, as at the silhouette. Where these do not differ, the border is not known, and a band there has no label.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from registration.detect import face478_points as points
from registration.segment.fitted import INDEX, UNLABELLED
from registration.segment.mattes import connected, refine, refine_between
from registration.segment.views import ellipse

SURE = 0.5  # confidence of an outline's landmarks above which they are used
_EYE_WINDOW_M, _LIP_WINDOW_M = 7e-3, 9e-3  # squares whose colours describe the two sides
_MARGIN_M = 8e-3  # around a region: what is looked at
_POLYGON_M, _STEP_M = 8e-4, 1.2e-3  # errors of outlines; how far each further round may move a border
_GRAIN_M = 8e-4  # half the size of notches that are smoothed away
_ROUNDS = 2
_CLOSED = 0.10  # aperture of closed lids, relative to their width
_SHUT = 0.04  # aperture of a closed mouth, relative to its width
_FINE, _SHIFT = 8, 4  # samples per pixel along each axis, and fractional bits, of drawn polygons
_LEAST_PX = 12  # smaller regions have no border that could be refined
_LIPS = ("upper_lip", "lower_lip")
_MOUTH = "mouth_interior"
_OPENINGS = {  # the upper and the lower rim, between the same corners
    "left_eye": (points.LEFT_LID_UPPER, points.LEFT_LID_LOWER),
    "right_eye": (points.RIGHT_LID_UPPER, points.RIGHT_LID_LOWER),
    _MOUTH: (points.LIPS_INNER_UPPER, points.LIPS_INNER_LOWER),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Face:
    """One view, in the grid in which borders are refined."""

    image: UInt8[np.ndarray, "H W 3"]
    landmarks: Float[np.ndarray, "L 3"] | None  # x_px y_px confidence in this grid
    px_per_m: float  # at the face
    error_m: float  # typical distance of the model's borders from the true ones
    closed: frozenset[str] = frozenset()  # eyes and mouth, as `closed` tells from all views


def refine_borders(face: Face, labels: Int[np.ndarray, "H W"]) -> Int[np.ndarray, "H W"]:
    """Return the labels of a view with the borders of eyes, lips and mouth where the image shows them.

    Args:
        face: the view.
        labels: index into `fitted.CLASSES`, as the fitted model has them.
    """
    result = labels.copy()
    for name in ("left_eye", "right_eye"):
        _refine_eye(face, result, name)
    _refine_mouth(face, result)
    return result


def closed(landmarks: Sequence[Float[np.ndarray, "L 3"] | None]) -> frozenset[str]:
    """Return which of left_eye, right_eye and mouth_interior are closed in most of the views that surely show them.

    Args:
        landmarks: of scheme "face478" in each view: x_px y_px confidence.
    """
    found = set()
    for name, (upper, lower) in _OPENINGS.items():
        rims = [(above, below) for points_ in landmarks for above, below in _rims(points_, upper, lower)]
        limit = _SHUT if name == _MOUTH else _CLOSED
        if rims and np.median([aperture(above, below) for above, below in rims]) < limit:
            found.add(name)
    return frozenset(found)


def _rims(
    landmarks: Float[np.ndarray, "L 3"] | None, upper: tuple[int, ...], lower: tuple[int, ...]
) -> list[tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2"]]]:
    """The upper and the lower rim of an opening, once if all of it is surely seen; else nothing."""
    both = _sure(landmarks, (*upper, *lower))
    return [] if both is None else [(both[: len(upper)], both[len(upper) :])]


def aperture(upper: Float[np.ndarray, "P 2"], lower: Float[np.ndarray, "P 2"]) -> float:
    """The largest distance between two lids, relative to the distance of their common corners.

    Args:
        upper: from one corner to the other, px.
        lower: as many points, with the same corners.
    """
    width = float(np.linalg.norm(upper[-1] - upper[0]))
    across = np.array([upper[0, 1] - upper[-1, 1], upper[-1, 0] - upper[0, 0]]) / max(width, 1e-9)
    return float(np.abs((lower - upper) @ across).max() / max(width, 1e-9))


def drawn(outline: Float[np.ndarray, "P 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose centres lie in a closed polygon, px."""
    result = np.zeros(shape, bool)
    low = np.floor(outline.min(0)).astype(int).clip(0, None) - 1
    size = np.ceil(outline.max(0)).astype(int) + 2 - low
    if (size <= 0).any() or (size > 2 * max(shape)).any():
        return result
    # OpenCV draws the pixels of the rim, too: at a finer resolution they are narrow.
    fine = np.zeros((size[1] * _FINE, size[0] * _FINE), np.uint8)
    fixed = np.round(((outline - low) * _FINE - 0.5) * 2**_SHIFT).astype(np.int32)
    cv2.fillPoly(fine, [fixed], (1,), shift=_SHIFT)
    share = fine.reshape(size[1], _FINE, size[0], _FINE).mean((1, 3))
    top, left = max(low[1], 0), max(low[0], 0)
    part = share[top - low[1] :, left - low[0] :] > 0.5
    target = result[top : top + part.shape[0], left : left + part.shape[1]]
    target |= part[: target.shape[0], : target.shape[1]]
    return result


def _refine_eye(face: Face, labels: Int[np.ndarray, "H W"], name: str) -> None:
    model = labels == INDEX[name]
    if not model.any():  # turned away
        return
    if name in face.closed:
        labels[model] = INDEX["skin"]
        return
    given = [model]
    for above, below in _rims(face.landmarks, *_OPENINGS[name]):
        given.append(drawn(np.concatenate([above, below[-2:0:-1]]), labels.shape))
    box = _box(np.any(given, axis=0), face)
    found, unseen = _between(face, box, [one[box] for one in given], _EYE_WINDOW_M)
    _replace(labels[box], found, unseen, name)


def _refine_mouth(face: Face, labels: Int[np.ndarray, "H W"]) -> None:
    interior = labels == INDEX[_MOUTH]
    lips = np.isin(labels, [INDEX[name] for name in _LIPS])
    if lips.sum() < _LEAST_PX:
        return
    box = _box(lips | interior, face)
    part, lips, interior = labels[box], lips[box], interior[box]
    outer, inner = [lips | interior], [interior]
    sure = [
        (ring, rims)
        for ring in [_sure(face.landmarks, points.LIPS_OUTER)]
        if ring is not None
        for rims in _rims(face.landmarks, *_OPENINGS[_MOUTH])
    ]
    for ring, (above, below) in sure:
        outer.append(drawn(ring, labels.shape)[box])
        inner.append(drawn(np.concatenate([above, below[-2:0:-1]]), labels.shape)[box] & outer[-1])
    if _MOUTH in face.closed:
        inner = [np.zeros_like(interior)]
    whole, vague = _between(face, box, outer, _LIP_WINDOW_M)
    nearest = _nearer_lip(part)
    part[lips | interior | whole] = INDEX["skin"]
    part[whole] = nearest[whole]
    part[vague] = INDEX[UNLABELLED]
    if max(one.sum() for one in inner) < _LEAST_PX:
        part[interior & whole] = INDEX[_MOUTH]
        return
    gap, unseen = _between(face, box, inner, _LIP_WINDOW_M)
    part[gap & whole] = INDEX[_MOUTH]
    part[unseen & whole] = INDEX[UNLABELLED]


def _between(
    face: Face, box: tuple[slice, slice], given: list[Bool[np.ndarray, "h w"]], window_m: float
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The region that several rough ones describe, and where its border is not seen."""
    image, window = face.image[box], window_m * face.px_per_m
    given = [one for one in given if one.sum() >= _LEAST_PX] or given
    rough = given[-1]
    error = (_POLYGON_M if len(given) > 1 else face.error_m) * face.px_per_m
    common, union = np.all(given, axis=0), np.any(given, axis=0)
    inside = cv2.erode(common.astype(np.uint8), ellipse(error)).astype(bool)
    if inside.sum() < _LEAST_PX:
        inside = cv2.erode(rough.astype(np.uint8), ellipse(1)).astype(bool)
    outside = cv2.dilate(union.astype(np.uint8), ellipse(error)) == 0
    matte = refine_between(image, rough, inside, outside, window)
    # The model alone is near the truth: what lies farther away is another edge.
    for _ in range(_ROUNDS if len(given) > 1 else 0):
        matte = refine(image, matte.coverage > 0.5, max(1.0, _STEP_M * face.px_per_m), window)
    return _smooth(matte.coverage > 0.5, _GRAIN_M * face.px_per_m), ~matte.seen


def _smooth(region: Bool[np.ndarray, "h w"], grain_px: float) -> Bool[np.ndarray, "h w"]:
    """The region's largest part, without hairs and notches of this size."""
    smooth = cv2.medianBlur(region.astype(np.uint8), 2 * max(1, round(grain_px)) + 1).astype(bool)
    if not smooth.any():
        return region
    _, parts, statistics, _ = cv2.connectedComponentsWithStats(smooth.astype(np.uint8), connectivity=8)
    largest = 1 + int(statistics[1:, cv2.CC_STAT_AREA].argmax())
    return np.asarray(~connected(parts != largest, _rim(parts.shape)))


def _rim(shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    rim = np.ones(shape, bool)
    rim[1:-1, 1:-1] = False
    return rim


def _replace(
    labels: Int[np.ndarray, "h w"], found: Bool[np.ndarray, "h w"], unseen: Bool[np.ndarray, "h w"], name: str
) -> None:
    """Put a region in the place of the model's; `labels` are changed."""
    before = labels == INDEX[name]
    labels[before & ~found] = INDEX["skin"]
    labels[found & ((labels == INDEX["skin"]) | before)] = INDEX[name]
    labels[unseen] = INDEX[UNLABELLED]


def _nearer_lip(labels: Int[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """At each pixel the index of the lip that is nearer."""
    distances = [
        cv2.distanceTransform((labels != INDEX[name]).astype(np.uint8), cv2.DIST_L2, 5)
        if (labels == INDEX[name]).any()
        else np.full(labels.shape, np.inf)
        for name in _LIPS
    ]
    return np.where(distances[0] <= distances[1], INDEX[_LIPS[0]], INDEX[_LIPS[1]])


def _sure(landmarks: Float[np.ndarray, "L 3"] | None, outline: tuple[int, ...]) -> Float[np.ndarray, "P 2"] | None:
    """The landmarks of an outline, if all are sure."""
    if landmarks is None or len(landmarks) != points.COUNT:
        return None
    chosen = landmarks[list(outline)]
    return chosen[:, :2] if (chosen[:, 2] > SURE).all() else None


def _box(region: Bool[np.ndarray, "H W"], face: Face) -> tuple[slice, slice]:
    """The rows and columns around a region."""
    margin = int(np.ceil(_MARGIN_M * face.px_per_m)) + 2
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    return (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )
