"""Search along a view's rays around a known surface: how alike photographs are where the surface is moved there.

Windows follow the surface: each of their pixels is moved along its own ray by the same depth and looked up in the
partner's photograph at the place where it projects. This is the sweep of Gallup et al. 2007 ("Real-time plane-sweeping
stereo with multiple sweeping directions"), by surfaces instead of planes. Likeness is zero-mean normalized
cross-correlation: gains and offsets of exposure cancel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from registration.stereo.views import HeadImage, rays, relative_pose

_LEAST_SHARE = 0.4  # of a window that must lie on the surface and be seen by the partner
_NOISE = 1.0  # variance of grey levels (of 255) that is taken for noise: in flat windows the likeness is small
_NO_SCORE = -1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A surface as one view's window shows it."""

    depth: Float[np.ndarray, "h w"]  # metres, 0 where there is none
    trusted: Bool[np.ndarray, "h w"]  # neither grazing nor at a step


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """The best offsets of a search."""

    offset: Float[np.ndarray, "h w"]  # metres along the optical axis, from the depth that the search began at
    score: Float[np.ndarray, "h w"]  # mean correlation there; -1 where nothing was compared
    sigma: Float[np.ndarray, "h w"]  # metres, standard deviation that sharpness and height of the peak let expect
    inside: Bool[np.ndarray, "h w"]  # whether the peak lies within the range


class Partner:
    """Another photograph, looked up along a reference view's rays."""

    def __init__(
        self, reference: HeadImage, depth: Float[np.ndarray, "h w"], other: HeadImage, surface: Surface, hidden_m: float
    ):
        """Prepare the look-up.

        Args:
            reference: the view whose depths are searched.
            depth: of the surface in it, metres; 0 where there is none.
            other: the partner.
            surface: the surface as the partner sees it.
            hidden_m: depth by which a visible point may lie behind what the partner sees.
        """
        rotation, shift = relative_pose(reference.camera, other.camera)
        intrinsics = np.array(other.camera.intrinsics)
        intrinsics[:2, 2] -= 0.5  # OpenCV counts from the centre of the first pixel
        self._direction = rays(reference.camera) @ (intrinsics @ rotation).T.astype(np.float32)
        self._start = (intrinsics @ shift).astype(np.float32)
        self._image = other.grey - np.float32(other.grey.mean())
        x, y, z = self._project(depth)
        seen = cv2.remap(surface.depth, x, y, cv2.INTER_NEAREST)
        trusted = cv2.remap((surface.trusted & other.mask).astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
        self.visible: Bool[np.ndarray, "h w"] = (depth > 0) & trusted & (seen > 0) & (z < seen + hidden_m)

    def image_at(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Return the partner's grey values where points at these depths (m) project."""
        x, y, _ = self._project(depth)
        return cv2.remap(self._image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def _project(self, depth: Float[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        z = self._direction[..., 2] * depth + self._start[2]
        inverse = 1 / np.maximum(z, np.float32(1e-6))
        x = (self._direction[..., 0] * depth + self._start[0]) * inverse
        y = (self._direction[..., 1] * depth + self._start[1]) * inverse
        return x, y, z


class _Correlation:
    """Correlation of windows of one photograph with another, over the pixels that both show."""

    def __init__(self, image: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], window_px: int):
        self._size = (window_px, window_px)
        self._mask, self._image = mask.astype(np.float32), image
        share = self._mean(self._mask)
        self.usable: Bool[np.ndarray, "h w"] = mask & (share > _LEAST_SHARE)
        self._per_share = 1 / np.maximum(share, np.float32(1e-3))
        self._mean_of_image = self._mean(self._mask * image) * self._per_share
        square = self._mean(self._mask * image * image) * self._per_share
        self._variance = np.maximum(square - self._mean_of_image**2, 0) + _NOISE

    def with_image(self, other: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        masked = self._mask * other
        mean = self._mean(masked) * self._per_share
        variance = np.maximum(self._mean(masked * other) * self._per_share - mean * mean, 0) + _NOISE
        product = self._mean(masked * self._image) * self._per_share - mean * self._mean_of_image
        return product / np.sqrt(variance * self._variance)

    def _mean(self, values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.boxFilter(values, cv2.CV_32F, self._size, borderType=cv2.BORDER_CONSTANT)


def search(
    reference: HeadImage,
    depth: Float[np.ndarray, "h w"],
    partners: Sequence[Partner],
    offsets: Float[np.ndarray, "D"],
    window_px: int,
    smoothing_px: float,
) -> Found:
    """Find the offset at which partners are most alike.

    Args:
        reference: the view.
        depth: around which is searched, metres; 0 where nothing is.
        partners: of the same reference.
        offsets: evenly spaced and increasing, at least three, metres.
        window_px: size of the windows.
        smoothing_px: standard deviation of the window in which the correlations of neighbours are averaged; 0: none.
    """
    image = reference.grey - np.float32(reference.grey.mean())
    on = (depth > 0) & reference.mask
    correlations = [_Correlation(image, on & partner.visible, window_px) for partner in partners]
    count = np.sum([one.usable for one in correlations], axis=0)
    compared = count > 0
    volume = np.empty((len(offsets), *depth.shape), np.float32)
    weight = _blurred(compared.astype(np.float32), smoothing_px)
    for slice_, offset in zip(volume, offsets, strict=True):
        moved = depth + np.float32(offset)
        scores = [
            np.where(one.usable, one.with_image(partner.image_at(moved)), _NO_SCORE)
            for one, partner in zip(correlations, partners, strict=True)
        ]
        best = np.where(compared, _mean_of_best(np.stack(scores), count), 0)
        slice_[:] = _blurred(best, smoothing_px) / np.maximum(weight, 1e-3)
    found = _peaks(volume, offsets, np.maximum((count + 1) // 2, 1) * window_px**2)
    found.score[~compared] = _NO_SCORE
    found.inside[~compared] = False
    return found


def _mean_of_best(scores: Float[np.ndarray, "K h w"], count: Int[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Mean of the better half of the partners that show a pixel, at least of two where there are two."""
    ordered = np.sort(scores, 0)[::-1]
    taken = np.clip(np.maximum((count + 1) // 2, 2), 1, np.maximum(count, 1))
    total = np.cumsum(ordered, 0)
    return np.take_along_axis(total, (taken - 1)[None], 0)[0] / taken


def _peaks(volume: Float[np.ndarray, "D h w"], offsets: Float[np.ndarray, "D"], samples: np.ndarray) -> Found:
    best = volume.argmax(0)
    inside = (best > 0) & (best < len(offsets) - 1)
    middle = best.clip(1, len(offsets) - 2)
    before, at, after = (np.take_along_axis(volume, (middle + k)[None], 0)[0] for k in (-1, 0, 1))
    curvature = np.minimum(before - 2 * at + after, -1e-6)
    shift = np.clip(0.5 * (before - after) / curvature, -1, 1)
    step = float(offsets[1] - offsets[0])
    # Of least squares: the variance of the minimum is that of the residuals over curvature and number of samples.
    residual = np.maximum(1 - at, 0.01)
    sigma = step * np.sqrt(residual / (-curvature * samples))
    return Found(
        offset=(offsets[0] + (middle + shift) * step).astype(np.float32),
        score=at,
        sigma=sigma.astype(np.float32),
        inside=inside,
    )


def _blurred(values: Float[np.ndarray, "h w"], sigma: float) -> Float[np.ndarray, "h w"]:
    return cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) if sigma > 0 else values
