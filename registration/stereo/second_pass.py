"""Depths around a known surface, such as a fitted head: finer than without one, and what is hidden is known.

For each pixel the depth within a few millimetres of the surface is sought at which other photographs look alike
(`search`), coarse to fine; depths of all views are then averaged where they agree (`agreement`). Where there is no
clear peak, as on hair that stands off the surface or on skin without texture, there is no depth.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from registration.geometry.surface_views import SurfaceViews
from registration.stereo.agreement import Joined, Measured, join
from registration.stereo.depth_map import DepthMap
from registration.stereo.local_planes import fit_planes
from registration.stereo.pairs import MOST_DEG, choose_partners, view_angles
from registration.stereo.search import Found, Partner, Surface, search
from registration.stereo.views import MOST_PX, HeadImage, StereoView, camera_image, rays, surface_image

_STEP_PX = 0.4  # of the widest partner's image, between two offsets
_MOST_OFFSETS = 24  # of a search; wider ranges begin at smaller images
_ROUND = 5  # offsets to each side in the rounds after the first
_LEAST_COSINE = 0.2  # of incidence, below which a view says nothing about a surface
_HIDDEN = 1.5  # times the reach: depth by which the surface in front of a point may be wrong
_FILL_PX, _FILL_SHARE = 8.0, 0.05  # wider window that counts a little where offsets are smoothed
_SURFACE_WEIGHT = 1e-2  # per mm^2, of the surface itself there
_OWN_SURFACE_PX = 3.0  # window in which the first pass's depths are smoothed
_CONFIDENT_M = 2e-4  # standard deviation of a depth that has half of the confidence


@dataclass(frozen=True, kw_only=True)
class SecondPassOptions:
    """Settings of the second pass."""

    reach_m: float = 4e-3  # along the rays to both sides of the surface
    partners: int = 5  # of each view
    window_px: int = 5
    smoothing_px: float = 2.0  # standard deviation of the window in which correlations are averaged
    most_px: int = MOST_PX  # larger side of the windows: larger photographs are reduced
    least_score: float = 0.5  # correlation below which there is no depth
    most_sigma_m: float = 5e-4  # standard deviation above which there is no depth
    normal_px: float = 1.5  # standard deviation of the window in which normals are fitted
    workers: int = 2


def refined_depths(
    views: Sequence[StereoView],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    options: SecondPassOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[DepthMap | None, ...]:
    """Estimate depths and normals around a surface.

    Args:
        views: photographs without distortion.
        vertices: of the surface, world, metres; what lies outside the photographs does not matter.
        triangles: of the surface.
        options: settings.
        progress: called with the fraction done.

    Returns:
        One map per view, on the window of its photograph around the surface; None where a view does not show it.

    Raises:
        InputError: fewer than two views show the surface, or none overlap.
    """
    chosen = options or SecondPassOptions()
    centre = (np.min(vertices, 0) + np.max(vertices, 0)) / 2
    windows = [surface_image(view, vertices, chosen.most_px) for view in views]
    cameras = [window.camera for window in windows if window is not None]
    choose_partners(cameras, centre)  # refuses before the surface is prepared
    surfaces = SurfaceViews(vertices, triangles, cameras, smoothing_m=0)

    def surface_in(image: HeadImage, _: int) -> Surface:
        seen = surfaces.view(image.camera)
        depth = np.where(np.isfinite(seen.depth), seen.depth, 0).astype(np.float32)
        return Surface(depth=depth, trusted=seen.weight > _LEAST_COSINE)

    return _refined(windows, surface_in, centre, chosen, progress)


def sharpened_depths(
    views: Sequence[StereoView],
    maps: Sequence[DepthMap | None],
    centre: Float[np.ndarray, "3"],
    options: SecondPassOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[DepthMap | None, ...]:
    """Search around the first pass's own depths, smoothed, where there is no fitted surface yet.

    Args:
        views: photographs without distortion.
        maps: of the first pass.
        centre: of the head, world, metres.
        options: settings.
        progress: called with the fraction done.

    Returns:
        As `refined_depths`, on the windows of `maps`.
    """
    chosen = options or SecondPassOptions(reach_m=2e-3)
    windows = [None if one is None else camera_image(view, one.camera) for view, one in zip(views, maps, strict=True)]
    shown = [one for one in maps if one is not None]
    smooth = [fit_planes(one.depth, one.confidence, rays(one.camera), _OWN_SURFACE_PX)[0] for one in shown]

    def surface_in(image: HeadImage, view: int) -> Surface:
        height, width = image.grey.shape
        depth = cv2.resize(smooth[view], (width, height), interpolation=cv2.INTER_NEAREST)
        return Surface(depth=np.asarray(depth, np.float32), trusted=np.asarray(depth > 0))

    return _refined(windows, surface_in, centre, chosen, progress)


def _refined(
    windows: Sequence[HeadImage | None],
    surface_in: Callable[[HeadImage, int], Surface],
    centre: Float[np.ndarray, "3"],
    options: SecondPassOptions,
    progress: Callable[[float], None] | None,
) -> tuple[DepthMap | None, ...]:
    """Measure in all views, then join them; `surface_in`: what a view (its index among those shown) sees."""
    shown = [k for k, window in enumerate(windows) if window is not None]
    images = [window for window in windows if window is not None]
    partners = choose_partners([image.camera for image in images], centre, options.partners)
    job = _Job(images, partners, surface_in, centre, options)
    measured: list[Measured] = []
    with ThreadPoolExecutor(options.workers) as pool:
        for done, one in enumerate(pool.map(job.measure, range(len(images)))):
            measured.append(one)
            if progress is not None:
                progress((done + 1) / len(images))
    result: list[DepthMap | None] = [None] * len(windows)
    for k, depth_map in zip(shown, joined_maps(partners, measured, options), strict=True):
        result[k] = depth_map
    return tuple(result)


def joined_maps(
    partners: Sequence[Sequence[int]], measured: Sequence[Measured], options: SecondPassOptions
) -> list[DepthMap]:
    """Average depths of all views where they agree; compute normals and confidences.

    Args:
        partners: of each view.
        measured: what each view found.
        options: settings.
    """
    with ThreadPoolExecutor(options.workers) as pool:
        return list(pool.map(lambda k: _joined_map(k, partners, measured, options), range(len(measured))))


class _Job:
    """The photographs and the surface in them, at all sizes that the searches need."""

    def __init__(
        self,
        images: Sequence[HeadImage],
        partners: Sequence[Sequence[int]],
        surface_in: Callable[[HeadImage, int], Surface],
        centre: Float[np.ndarray, "3"],
        options: SecondPassOptions,
    ):
        self._partners, self._options = partners, options
        angles = view_angles([image.camera for image in images], centre)
        widest = [max((angles[k, other] for other in near), default=MOST_DEG) for k, near in enumerate(partners)]
        self._steps = [_step(image, centre, angle) for image, angle in zip(images, widest, strict=True)]
        offsets = 2 * options.reach_m / min(self._steps)
        self._levels = max(0, int(np.ceil(np.log2(offsets / _MOST_OFFSETS))))
        self._images = [images]
        for _ in range(self._levels):
            self._images.append([_halved(image) for image in self._images[-1]])
        self._surfaces = [[surface_in(image, k) for k, image in enumerate(level)] for level in self._images]

    def measure(self, view: int) -> Measured:
        """Search coarse to fine, then once more around the smoothed result."""
        image, surface = self._images[0][view], self._surfaces[0][view]
        if not self._partners[view]:
            nothing = np.zeros_like(surface.depth)
            return Measured(camera=image.camera, depth=nothing, sigma=nothing)
        offset: np.ndarray | None = None
        for level in range(self._levels, -1, -1):
            step = self._steps[view] * 2**level
            count = int(np.ceil(self._options.reach_m / step)) if offset is None else _ROUND
            offset, found = self._search(view, level, offset, step * np.arange(-count, count + 1))
        assert offset is not None
        around = surface.depth + offset
        step = self._steps[view] / 2
        _, found = self._search(view, 0, offset, step * np.arange(-_ROUND, _ROUND + 1))
        depth = around + found.offset
        moved = np.abs(depth - surface.depth) < self._options.reach_m + step
        good = self._good(found) & moved & surface.trusted
        return Measured(
            camera=image.camera,
            depth=np.where(good, depth, 0).astype(np.float32),
            sigma=np.where(good, found.sigma, 0).astype(np.float32),
        )

    def _search(
        self, view: int, level: int, offset: np.ndarray | None, offsets: Float[np.ndarray, "D"]
    ) -> tuple[Float[np.ndarray, "h w"], Found]:
        """Search around an offset from the surface; returns the smoothed new offset, and what was found."""
        image, surface = self._images[level][view], self._surfaces[level][view]
        height, width = surface.depth.shape
        start: np.ndarray = np.zeros((height, width), np.float32)
        if offset is not None:
            start = cv2.resize(offset, (width, height), interpolation=cv2.INTER_LINEAR)
        depth = np.where(surface.depth > 0, surface.depth + start, 0).astype(np.float32)
        hidden = _HIDDEN * self._options.reach_m
        partners = [
            Partner(image, depth, self._images[level][k], self._surfaces[level][k], hidden)
            for k in self._partners[view]
        ]
        found = search(image, depth, partners, offsets, self._options.window_px, self._options.smoothing_px)
        good = self._good(found)
        weight = np.where(good, 1 / np.maximum(found.sigma * 1e3, 0.02) ** 2, 0).astype(np.float32)
        return _smoothed(start + found.offset, weight, self._options.smoothing_px), found

    def _good(self, found: Found) -> np.ndarray:
        enough = (found.score > self._options.least_score) & (found.sigma < self._options.most_sigma_m)
        return np.asarray(found.inside & enough)


def _step(image: HeadImage, centre: Float[np.ndarray, "3"], angle_deg: float) -> float:
    """Change of depth (m) that moves a point by `_STEP_PX` in the image of a partner so far away."""
    pixel = float(np.linalg.norm(image.camera.centre - centre) / image.camera.intrinsics[0, 0])
    return _STEP_PX * pixel / float(np.tan(np.radians(min(angle_deg, 60.0))))


def _halved(image: HeadImage) -> HeadImage:
    height, width = (max(8, side // 2) for side in image.grey.shape)
    grey = cv2.resize(image.grey, (width, height), interpolation=cv2.INTER_AREA)
    mask = cv2.resize(image.mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    return HeadImage(grey=grey, camera=image.camera.scaled(width, height), mask=mask)


def _smoothed(
    offset: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"], sigma: float
) -> Float[np.ndarray, "h w"]:
    """Weighted means in a window; where it has nothing, of a wide one, and farther away 0."""
    near, wide = (
        (cv2.GaussianBlur(weight * offset, (0, 0), s), cv2.GaussianBlur(weight, (0, 0), s)) for s in (sigma, _FILL_PX)
    )
    total, weights = near[0] + _FILL_SHARE * wide[0], near[1] + _FILL_SHARE * wide[1]
    return np.asarray(total / (weights + _SURFACE_WEIGHT), np.float32)


def _joined_map(
    view: int, partners: Sequence[Sequence[int]], measured: Sequence[Measured], options: SecondPassOptions
) -> DepthMap:
    near = sorted({*partners[view], *(k for k, found in enumerate(partners) if view in found)})
    joined = join(view, near, measured)
    camera = measured[view].camera
    ray = rays(camera)
    confidence = _confidence(joined)
    _, normals = fit_planes(joined.depth, confidence, ray, options.normal_px)
    facing = -(normals * ray).sum(-1) > _LEAST_COSINE * np.linalg.norm(ray, axis=-1)
    known = (joined.depth > 0) & (confidence > 0) & facing
    return DepthMap(
        camera=camera,
        depth=np.where(known, joined.depth, 0).astype(np.float32),
        normals=np.where(known[..., None], normals, 0).astype(np.float32),
        confidence=np.where(known, confidence, 0).astype(np.float32),
    )


def _confidence(joined: Joined) -> Float[np.ndarray, "h w"]:
    """How far depths can be trusted: by their deviation, and by how many of the others that could tell agree."""
    sharp = 1 / (1 + (joined.sigma / _CONFIDENT_M) ** 2)
    shared = (joined.agreeing + 0.5) / (joined.compared + 1)
    return np.where(joined.depth > 0, sharp * shared, 0).astype(np.float32)
