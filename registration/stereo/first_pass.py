"""Depths from photographs alone: semi-global matching of rectified pairs, kept where pairs agree.

Hirschmueller 2008 (OpenCV's StereoSGBM, all paths) inside a sphere around the head. Depths of several partners of a
view must agree, and depths of other views must not contradict them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.stereo.depth_map import DepthMap
from registration.stereo.local_planes import fit_planes
from registration.stereo.pairs import choose_partners
from registration.stereo.rectify import RectifiedPair, homography, rectify, turn_image
from registration.stereo.views import MOST_PX, HeadImage, StereoView, head_image, rays, relative_pose
from registration.types import Camera

_BLOCK = 5  # pixels
_BEHIND = 0.7  # of the sphere's radius, behind its centre, down to which a visible surface is looked for
_CHUNK = 16  # disparities are searched in multiples of it
_AGREE_PX = 1.5  # widths of a pixel on the head that depths of two partners may differ by
_ALONE = 0.3  # confidence of depths that only one pair has: nothing contradicts wrong ones
_LEAST_CONTRAST = 1.0  # grey levels, standard deviation in the window
_WINDOW_PX = 9  # of contrast


@dataclass(frozen=True, kw_only=True)
class FirstPassOptions:
    """Settings of the first pass."""

    partners: int = 4  # of each view
    size_px: int = 480  # of the head's sphere in rectified images
    most_px: int = MOST_PX  # larger side of the windows: larger photographs are reduced
    agree_m: float = 1.5e-3  # between depths of two partners, and of another view; more where pixels are larger
    smoothing_px: float = 3.0  # standard deviation of the window in which normals are fitted
    workers: int = 2


def first_depths(
    views: Sequence[StereoView],
    centre: Float[np.ndarray, "3"],
    radius_m: float,
    options: FirstPassOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[DepthMap | None, ...]:
    """Estimate depths and normals of a head.

    Args:
        views: photographs without distortion.
        centre: of the head, world, metres.
        radius_m: of a sphere around the head that contains all that is looked for.
        options: settings.
        progress: called with the fraction done.

    Returns:
        One map per view, on the window of its photograph around the sphere; None where a view does not show it.
        Confidence grows with the number of partners and views that agree.

    Raises:
        InputError: fewer than two views show the head, or none overlap.
    """
    chosen = options or FirstPassOptions()
    images = [head_image(view, centre, radius_m, chosen.most_px) for view in views]
    shown = [k for k, image in enumerate(images) if image is not None]
    kept = [image for image in images if image is not None]
    partners = choose_partners([image.camera for image in kept], centre, chosen.partners)
    pairs = sorted({(min(a, b), max(a, b)) for a, found in enumerate(partners) for b in found})
    candidates: list[list[np.ndarray]] = [[] for _ in kept]
    with ThreadPoolExecutor(chosen.workers) as pool:
        jobs = pool.map(lambda pair: _match(kept[pair[0]], kept[pair[1]], centre, radius_m, chosen), pairs)
        for done, ((a, b), (depth_a, depth_b)) in enumerate(zip(pairs, jobs, strict=True)):
            candidates[a].append(depth_a)
            candidates[b].append(depth_b)
            if progress is not None:
                progress((done + 1) / len(pairs))
        chosen = replace(chosen, agree_m=max(chosen.agree_m, *(_AGREE_PX * _pixel_m(k, centre) for k in kept)))
        merged = list(pool.map(lambda k: _merged(candidates[k], kept[k], chosen), range(len(kept))))
        near = _near(pairs, len(kept))
        confirmed = list(pool.map(lambda k: _confirmed(k, near[k], merged, kept, chosen), range(len(kept))))
    result: list[DepthMap | None] = [None] * len(images)
    for k, depth_map in zip(shown, confirmed, strict=True):
        result[k] = depth_map
    return tuple(result)


def _pixel_m(image: HeadImage, centre: Float[np.ndarray, "3"]) -> float:
    """Width of a pixel at the head's centre."""
    return float(np.linalg.norm(image.camera.centre - centre) / image.camera.intrinsics[0, 0])


def _near(pairs: Sequence[tuple[int, int]], count: int) -> list[list[int]]:
    near: list[list[int]] = [[] for _ in range(count)]
    for a, b in pairs:
        near[a].append(b)
        near[b].append(a)
    return near


def _match(
    first: HeadImage, second: HeadImage, centre: Float[np.ndarray, "3"], radius: float, options: FirstPassOptions
) -> tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]]:
    """Depths of one pair in the windows of both; 0 where there are none."""
    pair, forward = rectify(first.camera, second.camera, centre, radius, options.size_px)
    left, right = (first, second) if forward else (second, first)
    (grey_l, mask_l), (grey_r, mask_r) = turn_image(left, pair.left), turn_image(right, pair.right)
    nearest, farthest = pair.disparity_of(pair.depth_m + np.array([-radius, _BEHIND * radius])).tolist()
    least = int(np.floor(farthest))
    count = _CHUNK * int(np.ceil((nearest - least) / _CHUNK))
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.StereoSGBM_MODE_HH,
    )
    raw = matcher.compute(_eight_bit(grey_l), _eight_bit(grey_r))
    disparity = raw.astype(np.float32) / 16
    known = (raw >= 16 * least) & (mask_l > 0.5) & (_contrast(grey_l) > _LEAST_CONTRAST)
    of_right, known_right = _seen_from_right(disparity, known)
    known_right &= mask_r > 0.5
    depths = (
        _in_window(disparity, known, pair, left, right_one=False),
        _in_window(of_right, known_right, pair, right, right_one=True),
    )
    return depths if forward else depths[::-1]


def _eight_bit(grey: Float[np.ndarray, "H W"]) -> np.ndarray:
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def _contrast(grey: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    mean = cv2.blur(grey, (_WINDOW_PX, _WINDOW_PX))
    return np.sqrt(np.maximum(cv2.blur(grey * grey, (_WINDOW_PX, _WINDOW_PX)) - mean * mean, 0))


def _seen_from_right(
    disparity: Float[np.ndarray, "H W"], known: Bool[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The right image's disparities: the nearest of those that fall into a pixel, gaps of one pixel filled."""
    height, width = disparity.shape
    row, column = np.nonzero(known)
    value = disparity[row, column]
    target = np.round(column - value).astype(int)
    inside = (target >= 0) & (target < width)
    right = np.full((height, width), -np.inf, np.float32)
    np.maximum.at(right, (row[inside], target[inside]), value[inside])
    found = np.isfinite(right)
    beside = np.zeros_like(found)
    beside[:, 1:-1] = found[:, :-2] & found[:, 2:] & ~found[:, 1:-1]
    beside[:, 1:-1] &= (
        np.abs(np.where(beside[:, 1:-1], right[:, :-2], 0) - np.where(beside[:, 1:-1], right[:, 2:], 0)) < 2
    )
    row, column = np.nonzero(beside)
    right[row, column] = (right[row, column - 1] + right[row, column + 1]) / 2
    found |= beside
    return np.where(found, right, 0), found


def _in_window(
    disparity: Float[np.ndarray, "H W"],
    known: Bool[np.ndarray, "H W"],
    pair: RectifiedPair,
    image: HeadImage,
    *,
    right_one: bool,
) -> Float[np.ndarray, "h w"]:
    """Depths of a rectified image in the window that it was made from."""
    camera = pair.right if right_one else pair.left
    matrix = homography(image.camera, camera)
    size = (image.camera.width_px, image.camera.height_px)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # Inverse depth is linear in disparity, and depth along the other axis is in proportion to it.
    share = cv2.warpPerspective(known.astype(np.float32), matrix, size, flags=flags)
    mean = cv2.warpPerspective(np.where(known, disparity, 0).astype(np.float32), matrix, size, flags=flags)
    nearest = cv2.warpPerspective(
        np.where(known, disparity, 0).astype(np.float32), matrix, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    good = share > 0.99
    mean = mean / np.maximum(share, 0.5)
    good &= np.abs(mean - nearest) < 2  # no mean over a step
    axis = (camera.T_cam_world[2, :3] @ image.camera.T_cam_world[:3, :3].T).astype(np.float32)
    along = rays(image.camera) @ axis
    depth = pair.depth_of(mean) / np.where(np.abs(along) > 1e-6, along, 1)
    return np.where(good & image.mask & (along > 0), depth, 0).astype(np.float32)


def _merged(
    candidates: Sequence[Float[np.ndarray, "h w"]], image: HeadImage, options: FirstPassOptions
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The mean of the largest group of partners that agree, and their number; depths of one partner count as one."""
    shape = image.grey.shape
    if not candidates:
        return np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    depths = np.stack(candidates)
    known = depths > 0
    best, votes = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for one, there in zip(depths, known, strict=True):
        agree = known & there & (np.abs(depths - one) < options.agree_m)
        count = agree.sum(0).astype(np.float32)
        mean = np.where(agree, depths, 0).sum(0) / np.maximum(count, 1)
        better = count > votes
        best[better], votes[better] = mean[better], count[better]
    return best, votes


def _confirmed(
    view: int,
    near: Sequence[int],
    merged: Sequence[tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]]],
    images: Sequence[HeadImage],
    options: FirstPassOptions,
) -> DepthMap:
    """Keep what two partners agree on, or one partner and the depths of other views; smooth; compute normals."""
    depth, votes = merged[view]
    camera, ray = images[view].camera, rays(images[view].camera)
    agree, against = np.zeros_like(votes), np.zeros_like(votes)
    rows = np.nonzero(depth > 0)
    for other in near:
        same, hidden = _compared(depth[rows], ray[rows], camera, images[other].camera, merged[other], options.agree_m)
        agree[rows] += same
        against[rows] += hidden
    alone = len(near) < 2
    least = 1 if alone else 2
    support = votes + agree
    kept = (depth > 0) & (votes >= 1) & ((votes >= least) | (agree >= least)) & (agree > against if not alone else True)
    depth = np.where(kept, depth, 0).astype(np.float32)
    certain = np.full_like(support, _ALONE) if alone else np.clip((support - against) / 6, 0.05, 1)
    confidence = np.where(kept, certain, 0).astype(np.float32)
    smooth, normals = fit_planes(depth, confidence, ray, options.smoothing_px)
    facing = (normals * ray).sum(-1) < -0.2 * np.linalg.norm(ray, axis=-1)
    kept &= (smooth > 0) & facing & (np.abs(smooth - depth) < 3 * options.agree_m)
    depth_map = DepthMap(camera=camera, depth=depth, normals=normals, confidence=confidence)
    return replace(
        depth_map,
        depth=np.where(kept, depth, 0),
        normals=np.where(kept[..., None], normals, 0),
        confidence=np.where(kept, confidence, 0),
    )


def _compared(
    depth: Float[np.ndarray, "P"],
    ray: Float[np.ndarray, "P 3"],
    camera: Camera,
    other: Camera,
    merged: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]],
    tolerance: float,
) -> tuple[Bool[np.ndarray, "P"], Bool[np.ndarray, "P"]]:
    """Which points another view's depths agree with, and which stand in front of what it sees."""
    rotation, shift = relative_pose(camera, other)
    points = (ray * depth[:, None]) @ rotation.T.astype(np.float32) + shift.astype(np.float32)
    z = points[:, 2]
    pixels = points @ other.intrinsics.T.astype(np.float32)
    column = np.floor(pixels[:, 0] / np.maximum(z, 1e-6)).astype(int)
    row = np.floor(pixels[:, 1] / np.maximum(z, 1e-6)).astype(int)
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < other.width_px) & (row < other.height_px)
    seen = np.zeros(len(depth), np.float32)
    seen[inside] = np.where(merged[1] >= 1, merged[0], 0)[row[inside], column[inside]]
    known = seen > 0
    return known & (np.abs(seen - z) < tolerance), known & (z < seen - 3 * tolerance)
