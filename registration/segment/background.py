"""What the background of one picture looks like, and which pixels look different.

A studio's background is smooth: it is predicted behind the head from what is seen around it. A quadratic in x and y,
fitted robustly, grows into what continues it; what it leaves over is interpolated.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.segment.mattes import connected

_STRANGE, _CLEAR = 9.0, 40.0  # squared standard deviations from the background
_SMOOTH = 6.0  # grey levels of 255: median deviation from the quadratic, of a smooth background
_GROWTHS = 4
_FLOOR = 2.0  # grey levels: least standard deviation of the background's colours
_NEAR, _FAR = 0.03, 0.12  # of the picture's diagonal: widths over which leftovers are interpolated
_CLUSTERS = 3  # of the colours of a background that is not smooth


@dataclass(frozen=True, kw_only=True, eq=False)
class BackgroundModel:
    """Which pixels differ from the background."""

    strange: Bool[np.ndarray, "H W"]
    clear: Bool[np.ndarray, "H W"]  # those that differ so much that an error of the model cannot be the reason
    smooth: bool  # whether the background is predicted everywhere, or its colours alone are known


def background_model(
    image: UInt8[np.ndarray, "H W 3"], background: Bool[np.ndarray, "H W"], beside: Bool[np.ndarray, "H W"]
) -> BackgroundModel:
    """Return the model of a picture's background.

    Args:
        image: the picture.
        background: what is surely so.
        beside: where it may continue.
    """
    if background.sum() < 100:
        everywhere = np.ones(image.shape[:2], bool)
        return BackgroundModel(strange=everywhere, clear=~everywhere, smooth=False)
    blurred = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float64)
    trend = _trend(blurred, background, beside)
    if trend is None:
        distance = _from_clusters(image, background)
        return BackgroundModel(strange=distance > _STRANGE, clear=distance > _CLEAR, smooth=False)
    predicted, grown = trend
    offset = image - predicted
    spread = _covariance(offset[grown])
    unlike = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(spread), offset)
    # Clipped at twice the threshold, a blurred edge crosses it where the edge is.
    strange, clear = (cv2.GaussianBlur(np.minimum(unlike, 2 * top), (0, 0), 1.0) > top for top in (_STRANGE, _CLEAR))
    return BackgroundModel(strange=strange, clear=clear, smooth=True)


def _trend(
    blurred: Float[np.ndarray, "H W 3"], background: Bool[np.ndarray, "H W"], beside: Bool[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]] | None:
    """The background behind everything, and what was taken for it; None if it is not smooth."""
    height, width = background.shape
    y, x = np.mgrid[-1 : 1 : 1j * height, -1 : 1 : 1j * width]
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    grown, trend = background, blurred
    for _ in range(_GROWTHS):
        rows = np.flatnonzero(grown.ravel())
        rows = rows[:: max(1, len(rows) // 3000)]
        solution, typical = _robust_fit(basis.reshape(-1, 6)[rows], blurred.reshape(-1, 3)[rows])
        if typical > _SMOOTH:
            return None
        trend = basis @ solution
        left = blurred - trend
        weight = (grown & (np.abs(left).max(-1) < 4 * (typical + 1.5))).astype(np.float64)
        trend = np.clip(trend + _interpolated(left, weight), 0, 255)
        like = np.abs(blurred - trend).max(-1) < 2.5 * (typical + 1)
        grown = background | connected((like & beside) | background, background)
    return trend, grown


def _robust_fit(
    design: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n c"]
) -> tuple[Float[np.ndarray, "k c"], float]:
    """Least absolute deviations by reweighting: the coefficients, and the median deviation."""
    weight = np.ones((len(design), 1))
    for _ in range(5):
        solution = np.linalg.lstsq(design * weight, values * weight, rcond=None)[0]
        residual = np.abs(design @ solution - values).max(1, keepdims=True)
        weight = 1 / np.sqrt(residual + np.median(residual) + 0.5)
    return solution, float(np.median(residual))


def _interpolated(values: Float[np.ndarray, "H W 3"], weight: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 3"]:
    """Weighted means over the neighbourhood, a wide one where there is little near; towards 0 far from everything."""
    diagonal = float(np.hypot(*weight.shape))
    total, mean = 1e-3 * np.ones((*weight.shape, 1)), np.zeros_like(values)
    for width, share in ((_NEAR, 1.0), (_FAR, 0.1)):
        sigma = width * diagonal
        mean += share * cv2.GaussianBlur(values * weight[..., None], (0, 0), sigma)
        total += share * cv2.GaussianBlur(weight, (0, 0), sigma)[..., None]
    return mean / total


def _covariance(offsets: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Of the offsets without outliers, with a floor."""
    size = np.abs(offsets).max(1)
    return np.cov(offsets[size <= np.quantile(size, 0.95)].T) * 1.3 + np.eye(3) * _FLOOR**2


def _from_clusters(image: UInt8[np.ndarray, "H W 3"], background: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Squared standard deviations from the nearest of a few clusters of the background's colours."""
    samples = image[background].astype(np.float32)
    samples = samples[:: max(1, len(samples) // 3000)]
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, 10, 1.0)
    cv2.setRNGSeed(1)
    _, member, _ = cv2.kmeans(samples, _CLUSTERS, np.empty(0), criteria, 1, cv2.KMEANS_PP_CENTERS)
    distances = [np.full(image.shape[:2], np.inf)]
    for number in range(_CLUSTERS):
        part = samples[member[:, 0] == number].astype(np.float64)
        if len(part) >= 0.05 * len(samples):
            offset = image - part.mean(0)
            spread = np.cov(part.T) + np.eye(3) * _FLOOR**2
            distances.append(np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(spread), offset))
    return np.asarray(np.min(distances, axis=0))
