"""The subject against its background before any fit: seeds from the head's place, the background's colours, a matte.

Sure of the subject are the landmarks' hull or the middle of the head's sphere, and what stereo sees inside the sphere;
sure of the background is what lies beside and above the sphere, what stereo sees far behind, and what looks as in a
plate. Where subject and background have the same colours, as dark hair in a dark room, the border cannot be seen: a
band there is uncertain, and no wrong silhouette is claimed.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.segment.background import background_model
from registration.segment.mattes import connected, refine
from registration.segment.views import HeadSphere, SegmentView, Window, depth_in, disc, ellipse, points_at
from registration.stereo.depth_map import DepthMap
from registration.types import Camera

UNCERTAIN = 0.5  # coverage where it is not known
THREADS = 2
_ROUGH_PX = 160  # height of the head where the rough mask is found
_ROUNDS = 4  # of GrabCut
_CORE = 0.3  # radii: within it all is head, from any side
_AROUND = 1.3  # radii: beyond it, beside and above the head, all is background
_BODY = 0.6  # radii below the centre: from there on there may be shoulders at the sides
_DEPTH_CONFIDENCE = 0.5
_FAR = 3.0  # radii behind the head's centre: background
_PLATE_NOISE, _PLATE_SURE = 6.0, 14.0  # grey levels of 255: below it is background, above it the subject
_LEAST_BACKGROUND = 100  # pixels of the rough mask, below which nothing is known of the background
_BAND = 0.08  # radii: width of the uncertain band beyond what is vague
_HOLE = 0.01  # of the subject's area: holes below it are filled
_FILLED, _LEAST = 0.75, 0.6  # radii around the centre that a head fills to this share at least, from any side


@dataclass(frozen=True, kw_only=True, eq=False)
class _Evidence:
    """What is known of one view besides its image."""

    depth: DepthMap | None
    plate: UInt8[np.ndarray, "H W 3"] | None


def first_masks(
    views: Sequence[SegmentView],
    centre: Float[np.ndarray, "3"],
    radius_m: float,
    depths: Sequence[DepthMap | None] | None = None,
    plates: Sequence[UInt8[np.ndarray, "H W 3"] | None] | None = None,
) -> list[Float[np.ndarray, "H W"]]:
    """Return the subject's coverage in each view: head, neck, hair and clothes against the background.

    Args:
        views: without distortion.
        centre: of the head, metres, world: between the ears, halfway from chin to crown.
        radius_m: of a sphere around skull and face, about 0.125 for an adult; hair may reach beyond it.
        depths: of stereo, at any size of the same view; optional.
        plates: images of the same size without the subject; optional.

    Returns:
        Coverage in [0, 1], of the images' sizes; `UNCERTAIN` in bands where the border cannot be seen, and everywhere
        in a view whose image does not hold the head.
    """
    sphere = HeadSphere(centre=np.asarray(centre, np.float64), radius_m=radius_m)
    none = [None] * len(views)
    evidence = [
        _Evidence(depth=depth, plate=plate) for depth, plate in zip(depths or none, plates or none, strict=True)
    ]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(partial(_first_mask, sphere=sphere), views, evidence))


def _first_mask(view: SegmentView, evidence: _Evidence, sphere: HeadSphere) -> Float[np.ndarray, "H W"]:
    shape = view.image.shape[:2]
    window, small = Window.around(view.camera, sphere), Window.around(view.camera, sphere, _ROUGH_PX)
    if window is None or small is None:
        return np.full(shape, UNCERTAIN, np.float32)
    rough, unknown = _rough_mask(view, evidence, sphere, small)
    return finish(view.image, window, rough, unknown)


def finish(
    image: UInt8[np.ndarray, "H W 3"], window: Window, rough: Bool[np.ndarray, "h w"], unknown: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "H W"]:
    """Return the coverage in an image from a rough mask of its window.

    Args:
        image: of the view.
        window: in which the border is refined.
        rough: the subject, at any resolution of that window.
        unknown: what is not known, as `rough`.
    """
    size = (window.columns, window.rows)
    factor = window.columns / rough.shape[1]
    enlarged = cv2.resize(rough.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    matte = refine(window.cut(image), enlarged, band_px=1.5 * factor + 1, window_px=14 * factor)
    unseen = ~matte.seen | cv2.resize(unknown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    coverage = np.where(unseen, UNCERTAIN, matte.coverage)
    return window.paste(coverage.astype(np.float32), image.shape[:2], smooth=True)


def _rough_mask(
    view: SegmentView, evidence: _Evidence, sphere: HeadSphere, window: Window
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The subject in a small window, and where it is not known."""
    image = window.cut(view.image)
    centre, radius = sphere.in_view(window.camera(view.camera))
    subject, background = _seeds(view, evidence, sphere, window)
    if background.sum() < _LEAST_BACKGROUND:  # a close-up
        return subject, ~subject
    model = background_model(image, background, ~disc(background.shape, centre, radius) & ~subject)
    if model.smooth:
        opened = cv2.morphologyEx((model.strange | subject).astype(np.uint8), cv2.MORPH_OPEN, ellipse(1))
        rough = (opened.astype(bool) | subject) & ~background
    else:
        labels = np.where(model.strange, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        labels[subject], labels[background] = cv2.GC_FGD, cv2.GC_BGD
        labels = grab(image, labels)
        rough = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    rough = _one_piece(rough, subject, disc(rough.shape, centre, radius))
    return rough, _unknown(rough, ~model.clear & ~subject & model.smooth, background, centre, radius)


def _unknown(
    rough: Bool[np.ndarray, "h w"],
    vague: Bool[np.ndarray, "h w"],
    background: Bool[np.ndarray, "h w"],
    centre: Float[np.ndarray, "2"],
    radius: float,
) -> Bool[np.ndarray, "h w"]:
    """Where the subject is not clearly different up to its border; and all around a head that is hardly seen.

    Args:
        rough: the subject.
        vague: what is neither clearly different from the background nor surely the subject.
        background: what is surely so.
        centre: of the head, px.
        radius: of its sphere, px.
    """
    kernel = ellipse(_BAND * radius / 2)
    opened = cv2.morphologyEx((vague & rough).astype(np.uint8), cv2.MORPH_OPEN, ellipse(2)).astype(bool)
    unknown = cv2.dilate((connected(opened | ~rough, ~rough) & opened).astype(np.uint8), kernel) > 0
    middle = disc(rough.shape, centre, _FILLED * radius)
    if (rough & middle).sum() < _LEAST * middle.sum():
        unknown |= ~rough & ~background
    return np.asarray(unknown)


def _seeds(
    view: SegmentView, evidence: _Evidence, sphere: HeadSphere, window: Window
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """What is surely the subject, and what is surely not."""
    camera = window.camera(view.camera)
    shape = (window.rows, window.columns)
    centre, radius = sphere.in_view(camera)
    subject = disc(shape, centre, _CORE * radius) | _hull(view, window, shape)
    below = np.arange(window.rows)[:, None] + 0.5 > centre[1] + _BODY * radius
    background = ~disc(shape, centre, _AROUND * radius) & ~below
    if evidence.depth is not None:
        near, far = _by_depth(evidence.depth, sphere, camera)
        background = (background | far) & ~near
        subject |= near & ~background
    if evidence.plate is not None:
        seen, same = _by_plate(window.cut(view.image), window.cut(evidence.plate), background)
        background |= same & ~subject
        subject |= seen & ~background
    return subject, background & ~subject


def _hull(view: SegmentView, window: Window, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """The convex hull of the landmarks that are seen, a little smaller."""
    hull = np.zeros(shape, np.uint8)
    if view.landmarks is None or (view.landmarks[:, 2] > 0.5).sum() < 5:
        return hull.astype(bool)
    points = window.points(view.landmarks[view.landmarks[:, 2] > 0.5, :2])
    middle = np.median(points, axis=0)
    outline = cv2.convexHull((middle + 0.85 * (points - middle)).round().astype(np.int32))
    return cv2.fillConvexPoly(hull, outline, (1,)).astype(bool)


def _by_depth(
    depth: DepthMap, sphere: HeadSphere, camera: Camera
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """What lies in the head's sphere, and what lies far behind."""
    seen = depth_in(depth, camera, _DEPTH_CONFIDENCE)
    distance = np.linalg.norm(points_at(seen, camera) - sphere.centre, axis=-1)
    middle = camera.project(sphere.centre[None])[1][0]
    return (seen > 0) & (distance < sphere.radius_m), seen > middle + _FAR * sphere.radius_m


def _by_plate(
    image: UInt8[np.ndarray, "h w 3"], plate: UInt8[np.ndarray, "h w 3"], background: Bool[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """What differs clearly from the plate, and what does not at all, at the exposure of the known background."""
    ours, theirs = (cv2.GaussianBlur(p.astype(np.float32), (0, 0), 1.0) for p in (image, plate))
    if background.any():
        theirs = theirs * np.median((ours[background] + 1) / (theirs[background] + 1), axis=0)
    difference = np.abs(ours - theirs).max(-1)
    same, seen = (difference < _PLATE_NOISE).astype(np.uint8), (difference > _PLATE_SURE).astype(np.uint8)
    seen, same = (cv2.morphologyEx(region, cv2.MORPH_OPEN, ellipse(1)) for region in (seen, same))
    return seen.astype(bool), same.astype(bool)


def grab(image: UInt8[np.ndarray, "h w 3"], labels: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Run GrabCut from given labels (cv2.GC_*); unchanged if one of the two sides is empty."""
    subject = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if subject.sum() < 20 or (~subject).sum() < 20:
        return labels
    cv2.setRNGSeed(1)
    ours, theirs = np.zeros((1, 65)), np.zeros((1, 65))
    picture, result, unused = np.ascontiguousarray(image), labels.copy(), (0, 0, 1, 1)
    cv2.grabCut(picture, result, unused, theirs, ours, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return result


def _one_piece(
    region: Bool[np.ndarray, "h w"], seeds: Bool[np.ndarray, "h w"], head: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The parts that hang together with the seeds; holes are filled if they are small or inside the head's disc."""
    parts = connected(region, seeds)
    _, numbers, statistics, _ = cv2.connectedComponentsWithStats((~parts).astype(np.uint8), connectivity=4)
    filled = statistics[:, cv2.CC_STAT_AREA] < _HOLE * parts.sum()
    filled[np.setdiff1d(numbers[~parts & head], numbers[~parts & ~head])] = True
    filled[0] = False
    return np.asarray(parts | filled[numbers])
