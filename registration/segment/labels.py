"""Labels of a capture without a parser: the fitted model's own classes, what covers it, and the mask that they need."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.capture.class_names import BACKGROUND, NECK
from registration.model.regions import head_skin
from registration.segment.borders import Face, closed, refine_borders
from registration.segment.fitted import CLASSES, INDEX, UNLABELLED, FittedHead
from registration.segment.foreign import Foreign, foreign_pixels, foreign_vertices
from registration.segment.masks import THREADS, UNCERTAIN
from registration.segment.views import HeadSphere, SegmentView, Window, ellipse
from registration.stereo.depth_map import DepthMap

__all__ = ["CLASSES", "Labelled", "fitted_labels"]

_TOLERANCE_M = 2e-3  # beside the fit's error: by how much skin may lie outside of the fitted silhouette
_KNOWN = 0.02  # coverages this close to `UNCERTAIN` are not known
_RADIUS = 1.05  # of the sphere, relative to half of the head's height


@dataclass(frozen=True, kw_only=True, eq=False)
class Labelled:
    """The mask and the label map of one view, of its image's size."""

    name: str
    mask: Float[np.ndarray, "H W"]  # coverage in [0, 1]; `masks.UNCERTAIN` where it is not known
    labels: UInt8[np.ndarray, "H W"]  # index into `CLASSES`


def fitted_labels(
    views: Sequence[SegmentView],
    masks: Sequence[Float[np.ndarray, "H W"]],
    head: FittedHead,
    *,
    depths: Sequence[DepthMap | None] | None = None,
    accuracy_m: float = 1.5e-3,
) -> list[Labelled]:
    """Return masks and label maps of all views, from a fitted head.

    Args:
        views: without distortion.
        masks: of `masks.first_masks`.
        head: fitted to within `accuracy_m`.
        depths: of stereo, for the same views; optional.
        accuracy_m: typical distance of the fitted surface from the true one: 4e-3 after landmarks alone, 1.5e-3 after
            a fit of the model's parameters.

    Returns:
        One result per view, in order. What hair, beard, clothes or glasses cover, and what nothing tells, has a class
        that is excluded from every comparison.
    """
    sphere = head_sphere(head)
    windows = [Window.around(view.camera, sphere) for view in views]
    shown = [
        SegmentView(name=view.name, image=window.cut(view.image), camera=window.camera(view.camera))
        for view, window in zip(views, windows, strict=True)
        if window is not None
    ]
    given = [depth for depth, window in zip(depths or [None] * len(views), windows, strict=True) if window is not None]
    subjects = [
        _surely(window.cut(mask), 3e-3 * float(window.camera(view.camera).intrinsics[0, 0]) / _distance(view, sphere))
        for view, mask, window in zip(views, masks, windows, strict=True)
        if window is not None
    ]
    foreign = foreign_vertices(head, shown, subjects, given, accuracy_m)
    shut = closed([view.landmarks for view in views])
    label = partial(_label, head=head, foreign=foreign, accuracy_m=accuracy_m, shut=shut)
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(label, views, masks, windows))


def _surely(coverage: Float[np.ndarray, "h w"], margin_px: float) -> Bool[np.ndarray, "h w"]:
    """The subject, away from its border and from what is not known."""
    return cv2.erode((coverage > 1 - _KNOWN).astype(np.uint8), ellipse(margin_px)) > 0


def _distance(view: SegmentView, sphere: HeadSphere) -> float:
    """Of the head from the camera, metres."""
    return float(view.camera.project(sphere.centre[None])[1][0])


def head_sphere(head: FittedHead) -> HeadSphere:
    """The sphere around a fitted head's skull and face, for `masks.first_masks` and windows."""
    points = head.vertices[head_skin(head.data)]
    centre = (points.min(0) + points.max(0)) / 2
    return HeadSphere(centre=centre, radius_m=_RADIUS * float(np.ptp(points, axis=0).max()) / 2)


def _label(
    view: SegmentView,
    mask: Float[np.ndarray, "H W"],
    window: Window | None,
    head: FittedHead,
    foreign: Foreign,
    accuracy_m: float,
    shut: frozenset[str],
) -> Labelled:
    shape = view.image.shape[:2]
    if window is None:
        labels = np.full(shape, INDEX[UNLABELLED], np.uint8)
        return Labelled(name=view.name, mask=np.full(shape, UNCERTAIN, np.float32), labels=labels)
    fitted = head.view(window.camera(view.camera))
    coverage = window.cut(mask)
    px_per_m = float(fitted.camera.intrinsics[0, 0]) / _distance(view, head_sphere(head))
    # A bust ends elsewhere than the model's: below the chin the fitted silhouette says nothing.
    head_alone = fitted.inside & (fitted.labels != INDEX[NECK])
    core = cv2.erode(head_alone.astype(np.uint8), ellipse((2 * accuracy_m + 1e-3) * px_per_m)) > 0
    coverage = np.where(core, 1, coverage)
    unknown = np.abs(coverage - UNCERTAIN) < _KNOWN
    image, tolerance = window.cut(view.image), (2 * accuracy_m + _TOLERANCE_M) * px_per_m
    face = Face(image=image, landmarks=_landmarks(view, window), px_per_m=px_per_m, error_m=accuracy_m, closed=shut)
    fitted = replace(fitted, labels=refine_borders(face, fitted.labels))
    labels = foreign_pixels(image, head, fitted, foreign, coverage > 0.5, tolerance)
    wide = _wide(unknown)
    labels[wide] = INDEX[UNLABELLED]
    full = window.paste(labels.astype(np.uint8), shape, smooth=False)
    filled = window.paste(core.astype(np.uint8), shape, smooth=False).astype(bool)
    improved = np.where(filled & ~_outside(shape, window), 1, mask).astype(np.float32)
    full[(improved < 0.5 - _KNOWN) & (full != INDEX[BACKGROUND])] = INDEX[BACKGROUND]
    return Labelled(name=view.name, mask=improved, labels=full)


def _landmarks(view: SegmentView, window: Window) -> Float[np.ndarray, "L 3"] | None:
    """The view's landmarks in the window's pixels."""
    if view.landmarks is None:
        return None
    return np.column_stack([window.points(view.landmarks[:, :2]), view.landmarks[:, 2]])


def _wide(unknown: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Unknown regions without single pixels, whose coverage is a half by chance."""
    return cv2.morphologyEx(unknown.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)).astype(bool)


def _outside(shape: tuple[int, int], window: Window) -> Bool[np.ndarray, "H W"]:
    outside = np.ones(shape, bool)
    outside[window.top : window.top + window.height, window.left : window.left + window.width] = False
    return outside
