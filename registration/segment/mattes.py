"""Silhouettes to a fraction of a pixel: near a rough border, colours of its two sides tell each pixel's coverage.

On both sides the colours' mean and covariance are those of the pixels nearby that are surely on that side. A pixel's
coverage is its position between both means along Fisher's direction; the distance of the means in standard deviations
along it says whether the border can be seen at all.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.segment.views import ellipse

_NOISE = 1.5  # grey levels of 255: standard deviation that every side has at least
_MIN_SHARE = 0.02  # of a window's pixels that are surely on a side
_SEEN = 2.5  # standard deviations between the sides, below which the border cannot be seen


@dataclass(frozen=True, kw_only=True, eq=False)
class Matte:
    """A silhouette and how well it is seen."""

    coverage: Float[np.ndarray, "H W"]  # in [0, 1]
    seen: Bool[np.ndarray, "H W"]  # whether both sides' colours differ here; true away from the border


def refine(
    image: UInt8[np.ndarray, "H W 3"], rough: Bool[np.ndarray, "H W"], band_px: float, window_px: float
) -> Matte:
    """Return the coverage of a subject whose border is known roughly.

    Args:
        image: any colours.
        rough: the subject.
        band_px: how far the rough border may be from the true one.
        window_px: side of the square whose colours describe the two sides of the border.
    """
    kernel = ellipse(band_px)
    inside = cv2.erode(rough.astype(np.uint8), kernel) > 0
    outside = cv2.dilate(rough.astype(np.uint8), kernel) == 0
    return refine_between(image, rough, inside, outside, window_px)


def refine_between(
    image: UInt8[np.ndarray, "H W 3"],
    rough: Bool[np.ndarray, "H W"],
    inside: Bool[np.ndarray, "H W"],
    outside: Bool[np.ndarray, "H W"],
    window_px: float,
) -> Matte:
    """Return the coverage of a subject whose border lies somewhere between two regions.

    Args:
        image: any colours.
        rough: the subject where its border is not seen.
        inside: what is surely the subject.
        outside: what is surely not.
        window_px: side of the square whose colours describe the two sides of the border.
    """
    band = ~inside & ~outside
    seen = np.ones(rough.shape, bool)
    if not band.any() or not inside.any() or not outside.any():
        return Matte(coverage=rough.astype(np.float32), seen=seen)
    colours = image.astype(np.float32)
    side = max(3, int(window_px)) | 1
    ours, theirs = _statistics(colours, inside, side), _statistics(colours, outside, side)
    rows, columns = np.nonzero(band)
    mean_f, covariance_f = ours[0][rows, columns], ours[1][rows, columns]
    mean_b, covariance_b = theirs[0][rows, columns], theirs[1][rows, columns]
    spread = covariance_f + covariance_b + np.eye(3, dtype=np.float32) * (2 * _NOISE**2)
    difference = mean_f - mean_b
    direction = np.linalg.solve(spread, difference[..., None])[..., 0]
    separation = np.einsum("pc,pc->p", direction, difference)  # squared, in standard deviations
    along = np.einsum("pc,pc->p", direction, colours[rows, columns] - mean_b) / np.maximum(separation, 1e-6)
    known = (ours[2][rows, columns] > _MIN_SHARE) & (theirs[2][rows, columns] > _MIN_SHARE)
    clear = known & (separation > _SEEN**2)
    value = np.zeros(rough.shape, np.float32)
    value[band] = np.where(clear, along.clip(0, 1), rough[band])
    value[inside] = 1
    seen[band] = clear
    return Matte(coverage=_with_one_border(value, inside, outside), seen=seen)


def _statistics(
    colours: Float[np.ndarray, "H W 3"], members: Bool[np.ndarray, "H W"], side: int
) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 3 3"], Float[np.ndarray, "H W"]]:
    """Mean and covariance of the members' colours around each pixel, and the share of members there."""
    weight = members.astype(np.float32)
    size = (side, side)
    share = cv2.boxFilter(weight, -1, size)
    total = np.maximum(share, 1e-6)[..., None]
    mean = cv2.boxFilter(colours * weight[..., None], -1, size) / total
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    centred = (colours - colours[members].mean(0)) * weight[..., None]
    offset = mean - colours[members].mean(0)
    covariance = np.empty((*members.shape, 3, 3), np.float32)
    for i, j in pairs:
        moment = cv2.boxFilter(centred[..., i] * centred[..., j], -1, size) / total[..., 0]
        covariance[..., i, j] = covariance[..., j, i] = moment - offset[..., i] * offset[..., j]
    for i in range(3):
        covariance[..., i, i] = np.maximum(covariance[..., i, i], 0)
    return mean, covariance, share


def _with_one_border(
    value: Float[np.ndarray, "H W"], inside: Bool[np.ndarray, "H W"], outside: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    """Drop islands and holes of the band, and fractions away from the border between both sides."""
    subject = connected(value > 0.5, inside)
    subject = ~connected(~subject, outside)
    byte = subject.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    edge = (cv2.dilate(byte, kernel) > 0) & (cv2.erode(byte, kernel) == 0)
    result = np.where(edge, value, subject)
    # A fraction on the wrong side of one half is a stain of the skin or of the background.
    result = np.where(edge & subject, np.maximum(result, 0.5), result)
    result = np.where(edge & ~subject, np.minimum(result, 0.5), result)
    return result.astype(np.float32)


def connected(region: Bool[np.ndarray, "H W"], seeds: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the connected parts of a region that hold a seed."""
    count, parts = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    kept = np.zeros(count, bool)
    kept[np.unique(parts[seeds & region])] = True
    kept[0] = False
    return kept[parts]
