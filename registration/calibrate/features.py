"""Features of photographs, their matches between views, and tracks through several views.

SIFT [Lowe 2004] with square-rooted descriptors [Arandjelovic 2012]; matches are mutual, pass the ratio
test, and obey one epipolar geometry [Barath 2020].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

MAX_FEATURES = 3000  # of a photograph, the strongest
MIN_MATCHES = 12  # that obey the epipolar geometry of a pair
_CONTRAST = 0.015  # of SIFT, whose default of 0.04 finds few features on skin
_RATIO = 0.8
_EPIPOLAR_PX = 1.5  # of the reduced images
_MIN_SHARE = 0.4  # of the matches of a pair, that obey its epipolar geometry
_SIGMA_PX = 0.35  # of a feature of the finest scale
_SIGMA_BY_SIZE = 0.07  # px for each px of a feature's diameter

Matches = Mapping[tuple[int, int], Int[np.ndarray, "_ 2"]]  # views (i, j), i < j -> features of i and j


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """The K features of a photograph."""

    xy_px: Float[np.ndarray, "K 2"]  # of the file; the centre of pixel (0, 0) is at (0.5, 0.5)
    sigma_px: Float[np.ndarray, "K"]  # of their positions, px of the file
    descriptors: Float[np.ndarray, "K 128"]  # unit
    factor: float  # px of the file per px of the image that they were found in


def find_features(pixels: UInt8[np.ndarray, "H W 3"], factor: float = 1.0) -> Features:
    """Return the features of an image; `factor`: px of the file per px of the image."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    # Without `enable_precise_upscale` all positions are a quarter of a pixel too far right and down.
    detector = cv2.SIFT.create(MAX_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    keys, descriptors = detector.detectAndCompute(grey, None)
    if not keys:
        return Features(
            xy_px=np.zeros((0, 2)), sigma_px=np.zeros(0), descriptors=np.zeros((0, 128), np.float32), factor=factor
        )
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    size = np.array([key.size for key in keys])
    return Features(
        xy_px=(np.array([key.pt for key in keys]) + 0.5) * factor,  # OpenCV's first pixel has its centre at 0
        sigma_px=(_SIGMA_PX + _SIGMA_BY_SIZE * size) * factor,
        descriptors=root.astype(np.float32),
        factor=factor,
    )


def joined(a: Features, b: Features) -> Features:
    """Return the features of both, of one photograph; those of `b` follow."""
    return Features(
        xy_px=np.concatenate([a.xy_px, b.xy_px]),
        sigma_px=np.concatenate([a.sigma_px, b.sigma_px]),
        descriptors=np.concatenate([a.descriptors, b.descriptors]),
        factor=a.factor,
    )


def mirrored(features: Features) -> Features:
    """Return the features as they would be found in the mirrored image, at the same positions.

    A reflection across the feature's own axis reverses the rows of the descriptor's cells, and its directions.
    """
    cells = features.descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    descriptors = cells[..., -np.arange(8) % 8].reshape(features.descriptors.shape)
    return replace(features, descriptors=np.ascontiguousarray(descriptors))


def match(a: Features, b: Features) -> Int[np.ndarray, "M 2"]:
    """Return the matches of two views that obey one epipolar geometry; none if they are too few."""
    pairs = _mutual(a.descriptors, b.descriptors)
    if len(pairs) < MIN_MATCHES:
        return pairs[:0]
    return pairs[epipolar(a.xy_px[pairs[:, 0]], b.xy_px[pairs[:, 1]], max(a.factor, b.factor))]


def epipolar(first: Float[np.ndarray, "M 2"], second: Float[np.ndarray, "M 2"], factor: float) -> Bool[np.ndarray, "M"]:
    """Return which matches obey one epipolar geometry; none if these are too few.

    Args:
        first: positions in one view, px of the file.
        second: in the other.
        factor: px of the file per px of the image that the features were found in.
    """
    none = np.zeros(len(first), bool)
    if len(first) < MIN_MATCHES:
        return none
    inlier = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, _EPIPOLAR_PX * factor, 0.999, 5000)[1]
    obeys = none if np.ndim(inlier) == 0 else inlier.ravel() > 0  # None where there is no such geometry
    return obeys if obeys.sum() >= max(MIN_MATCHES, _MIN_SHARE * len(first)) else none


def _mutual(a: Float[np.ndarray, "K 128"], b: Float[np.ndarray, "L 128"]) -> Int[np.ndarray, "M 2"]:
    """Mutual nearest neighbours that are much nearer than the second nearest."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = a @ b.T
    best = likeness.argmax(1)
    rows = np.arange(len(a))
    first = likeness[rows, best]
    mutual = likeness.argmax(0)[best] == rows
    likeness[rows, best] = -1
    second = likeness.max(1)
    near, next_ = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (first, second))
    chosen = np.flatnonzero(mutual & (near < _RATIO * next_))
    return np.column_stack([chosen, best[chosen]]).astype(np.int64)


def tracks(
    features: Sequence[Features], matches: Matches
) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Join matches to tracks, the images of one point in several views.

    A track with two features in one view has lost its point somewhere: its features in that view are left out.

    Returns:
        View, feature and track of each observation; tracks are numbered from 0, each has two views at least.
    """
    first = np.concatenate([[0], np.cumsum([len(one.xy_px) for one in features])])
    pairs = [np.asarray(pair) + [first[i], first[j]] for (i, j), pair in matches.items() if len(pair)]
    empty = np.zeros(0, np.int64)
    if not pairs:
        return empty, empty, empty
    edges = np.concatenate(pairs)
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(first[-1], first[-1]))
    label = connected_components(graph, directed=False)[1]
    used = np.unique(edges)
    track = label[used]
    view = np.searchsorted(first, used, side="right") - 1
    _, inverse, count = np.unique(np.stack([track, view]), axis=1, return_inverse=True, return_counts=True)
    single = count[inverse.ravel()] == 1
    used, track, view = used[single], track[single], view[single]
    _, track, count = np.unique(track, return_inverse=True, return_counts=True)
    long = count[track] >= 2
    used, view, track = used[long], view[long], np.unique(track[long], return_inverse=True)[1]
    return view.astype(np.int64), (used - first[view]).astype(np.int64), track.astype(np.int64)
