"""Matches of skin between faces seen from very different sides, guided by their landmarks.

Skin looks too different from sides 40 degrees apart for features to match. The landmarks of both faces tell how one
has to be warped to look like the other: each triangle of landmarks by an affine map. Features of the warped face are
then matched near their own places only, and taken back to the photograph.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import Delaunay, QhullError

from registration.calibrate.features import Features, epipolar, find_features

_RADIUS = 0.03  # of the search, as a fraction of the face's size
_RATIO = 0.9  # of the nearest descriptor's distance to the second nearest's, among those in the search radius
_MAX_STRETCH = 3.0  # of a triangle's area: more is seen too obliquely
_MARGIN = 0.1  # around the face that is warped, as a fraction of its size
_PRECISION = 1.5  # sigma of positions in a warped image, relative to those found in a photograph


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceImage:
    """A photograph with the landmarks of its face, both at the size that features are searched at."""

    pixels: UInt8[np.ndarray, "H W 3"]
    points: Float[np.ndarray, "L 2"]  # px of `pixels`
    seen: Bool[np.ndarray, "L"]  # landmarks that the camera sees
    factor: float  # px of the file per px of `pixels`


def guided_match(a: FaceImage, b: FaceImage, features_b: Features) -> tuple[Features, Int[np.ndarray, "_ 2"]]:
    """Match the face in `a`, warped to look like the one in `b`, with the features of `b`.

    Args:
        a: one photograph.
        b: the other one.
        features_b: of the other one.

    Returns:
        Features of `a` that match, px of its file, and pairs of these and of the features of `b`; none if the matches
        obey no common epipolar geometry.
    """
    warp = _warp(a, b)
    if warp is None:
        return _none(a.factor), np.zeros((0, 2), np.int64)
    image, back, inside, corner, size = warp
    found = find_features(image)
    xy = found.xy_px + corner
    column, row = (np.clip(np.round(found.xy_px - 0.5).astype(int), 0, np.array(inside.shape[::-1]) - 1)).T
    kept = np.flatnonzero(inside[row, column])
    target = features_b.xy_px / features_b.factor
    near = _nearest(found.descriptors[kept], xy[kept], features_b.descriptors, target, _RADIUS * size)
    pairs = np.column_stack([kept[near[:, 0]], near[:, 1]])
    origin = _bilinear(back, found.xy_px[pairs[:, 0]])
    usable = np.isfinite(origin).all(1)
    pairs, origin = pairs[usable], origin[usable]
    obeys = epipolar(origin * a.factor, features_b.xy_px[pairs[:, 1]], max(a.factor, b.factor))
    pairs, origin = pairs[obeys], origin[obeys]
    features = Features(
        xy_px=origin * a.factor,
        sigma_px=_PRECISION * found.sigma_px[pairs[:, 0]] * a.factor,
        descriptors=found.descriptors[pairs[:, 0]],
        factor=a.factor,
    )
    return features, np.column_stack([np.arange(len(pairs)), pairs[:, 1]]).astype(np.int64)


def _none(factor: float) -> Features:
    return Features(
        xy_px=np.zeros((0, 2)), sigma_px=np.zeros(0), descriptors=np.zeros((0, 128), np.float32), factor=factor
    )


def _warp(a: FaceImage, b: FaceImage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float] | None:
    """The face of `a` as `b` shows it, where its pixels come from in `a`, which are valid, its corner in `b`, size."""
    used = np.flatnonzero(a.seen & b.seen)
    if len(used) < 20:
        return None
    source, target = a.points[used], b.points[used]
    size = float(np.sqrt(np.prod(np.ptp(target, axis=0))))
    low = np.floor(np.maximum(target.min(0) - _MARGIN * size, 0)).astype(int)
    high = np.ceil(np.minimum(target.max(0) + _MARGIN * size, b.pixels.shape[1::-1])).astype(int)
    try:
        mesh = Delaunay(target)
    except QhullError:
        return None
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    grid = np.stack([x, y], -1).reshape(-1, 2)
    triangle = mesh.find_simplex(grid)
    affine = mesh.transform[triangle]
    first = np.einsum("pij,pj->pi", affine[:, :2], grid - affine[:, 2])
    weights = np.column_stack([first, 1 - first.sum(1)])
    back = np.einsum("pk,pkc->pc", weights, source[mesh.simplices[triangle]])
    stretch = _areas(source[mesh.simplices]) / _areas(target[mesh.simplices])
    valid = (triangle >= 0) & (stretch[triangle] > 1 / _MAX_STRETCH) & (stretch[triangle] < _MAX_STRETCH)
    back[~valid] = np.nan
    shape = x.shape
    back, valid = back.reshape(*shape, 2), valid.reshape(shape)
    filled = np.nan_to_num(back, nan=-10.0).astype(np.float32) - np.float32(0.5)
    image = cv2.remap(a.pixels, filled[..., 0], filled[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    image[~valid] = 0
    inside = cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0) > 0
    return image, back, inside, low.astype(np.float64), size


def _areas(triangles: np.ndarray) -> np.ndarray:
    """Signed areas: a triangle that is turned over is seen from behind."""
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return np.where(np.abs(area) > 1e-9, area, 1e-9)


def _nearest(a: np.ndarray, xy_a: np.ndarray, b: np.ndarray, xy_b: np.ndarray, radius: float) -> Int[np.ndarray, "_ 2"]:
    """Mutual nearest descriptors among features within the radius."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = a @ b.T
    likeness[((xy_a[:, None] - xy_b[None]) ** 2).sum(-1) > radius**2] = -1
    best = likeness.argmax(1)
    rows = np.arange(len(a))
    first = likeness[rows, best]
    mutual = (likeness.argmax(0)[best] == rows) & (first > 0)
    likeness[rows, best] = -1
    second = np.maximum(likeness.max(1), 0)
    near, next_ = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (first, second))
    chosen = np.flatnonzero(mutual & (near < _RATIO * next_))
    return np.column_stack([chosen, best[chosen]]).astype(np.int64)


def _bilinear(field: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """A field's values at positions whose first pixel's centre is at 0.5; NaN at and beside pixels without one."""
    if not len(xy):
        return np.zeros((0, 2))
    height, width = field.shape[:2]
    x, y = (np.clip(xy[:, k] - 0.5, 0, n - 1.001) for k, n in ((0, width), (1, height)))
    i, j = x.astype(int), y.astype(int)
    u, v = (x - i)[:, None], (y - j)[:, None]
    top = (1 - u) * field[j, i] + u * field[j, i + 1]
    bottom = (1 - u) * field[j + 1, i] + u * field[j + 1, i + 1]
    return (1 - v) * top + v * bottom
