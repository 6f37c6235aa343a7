"""From a capture to what the losses compare with: windows around the head, at several resolutions.

Each view is decoded once, at the finest resolution a recipe asks for; coarser levels are block means of that one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from registration.capture.pixels import read_labels, read_mask, read_view, undistort_landmarks
from registration.targets.classes import BACKGROUND, ClassMap
from registration.types import Camera, Capture, Pixels, Targets, View, ViewPixels

_MARGIN = 0.08  # of the head's height: how far around the head pixels are kept and silhouettes pull
_NECK = 0.3  # of the head's height: how much of what is below the head is kept
_PURE = 0.99  # coverage from which a pixel counts as wholly inside the subject
_LEAST_NORMAL = 0.85  # mean length of a block's normals below which they disagree too much


@dataclass(frozen=True, kw_only=True)
class _Window:
    """The pixels around the head of one view; channels can be averaged in blocks."""

    name: str
    camera: Camera
    rgb: Float[np.ndarray, "H W 3"]
    normals: Float[np.ndarray, "H W 3"]  # world frame; 0 where none
    mask: Float[np.ndarray, "H W"]
    classes: Float[np.ndarray, "H W K"]
    neck: Float[np.ndarray, "H W"]
    excluded: Float[np.ndarray, "H W"]
    valid: Float[np.ndarray, "H W"]
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]]
    has_mask: bool
    has_classes: bool
    has_normals: bool
    head_px: float


def build_pyramid(
    capture: Capture,
    mapping: ClassMap,
    *,
    finest_head_px: int,
    levels: int,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Targets, ...]:
    """Targets from fine to coarse; each level halves the one before.

    Args:
        capture: its views are decoded one at a time.
        mapping: the classes to keep.
        finest_head_px: resolution at level 0: views are reduced by the whole factor that brings the subject's height
            closest to this from above; never enlarged.
        levels: how many.

    Raises:
        InputError: an image cannot be decoded.
    """
    downsample = max(1, int(_subject_height(capture) / finest_head_px))
    windows = []
    for done, view in enumerate(capture.views):
        progress(done)
        windows.append(_window(view, capture, mapping, min(downsample, view.camera.width_px, view.camera.height_px)))
    block = 2 ** (levels - 1)
    height, width = (
        -(-max(w.mask.shape[axis] for w in windows) // block) * block for axis in (0, 1)
    )  # rounded up to whole blocks of the coarsest level
    windows = [_padded(w, height, width) for w in windows]
    out = []
    for level in range(levels):
        if level:
            windows = [_halved(w) for w in windows]
        out.append(_targets(windows, mapping))
    return tuple(out)


def _subject_height(capture: Capture) -> float:
    """Median height of the subject in full-size pixels, from masks or labels, else from the images."""
    heights: list[int] = []
    for view in capture.views:
        rows = np.arange(view.camera.height_px)
        if view.segmentation is not None:
            labels = read_labels(view.segmentation, view.camera, capture.classes)
            # The head alone: shoulders would make a close-up of one view as small as a bust of another.
            away = [i for i, name in enumerate(capture.classes) if name in (BACKGROUND, "neck_other")]
            rows = np.flatnonzero(~np.isin(labels, away).all(1))
        elif view.mask is not None:
            rows = np.flatnonzero((read_mask(view.mask, view.camera) > 127).any(1))
        heights.append(int(np.ptp(rows)) + 1 if len(rows) else view.camera.height_px)
    return float(np.median(heights))


def _window(view: View, capture: Capture, mapping: ClassMap, downsample: int) -> _Window:
    pixels = read_view(view, capture, downsample=downsample)
    shape = pixels.rgb.shape[:2]
    none = np.zeros(shape, np.float32)
    classes = np.zeros((*shape, len(mapping.names)), np.float32)
    neck = excluded = none
    if pixels.label_shares is not None:
        classes = pixels.label_shares @ mapping.from_capture
        neck, excluded = pixels.label_shares @ mapping.neck, pixels.label_shares @ mapping.excluded
    mask = _coverage(pixels, capture)
    normals = np.zeros((*shape, 3), np.float32)
    if pixels.normals is not None:
        normals = (pixels.normals @ pixels.camera.T_cam_world[:3, :3]).astype(np.float32)
    landmarks = {}
    for scheme in view.landmarks:
        points = undistort_landmarks(view, scheme).copy()
        points[:, :2] /= downsample
        landmarks[scheme] = points
    whole = _Window(
        name=view.name,
        camera=pixels.camera,
        rgb=pixels.rgb.astype(np.float32),
        normals=normals,
        mask=none + 1 if mask is None else mask,
        classes=classes,
        neck=neck,
        excluded=excluded,
        valid=pixels.valid,
        landmarks=landmarks,
        has_mask=mask is not None,
        has_classes=pixels.label_shares is not None,
        has_normals=pixels.normals is not None,
        head_px=float(shape[0]),
    )
    return _cut_to_head(whole)


def _coverage(pixels: ViewPixels, capture: Capture) -> Float[np.ndarray, "H W"] | None:
    if pixels.mask is not None:
        return pixels.mask
    if pixels.label_shares is not None and BACKGROUND in capture.classes:
        return 1 - pixels.label_shares[..., capture.classes.index(BACKGROUND)]
    return None


def _cut_to_head(whole: _Window) -> _Window:
    head, _ = _head_and_other(whole)
    if not whole.has_mask or not head.any():
        return whole
    rows, columns = np.flatnonzero(head.any(1)), np.flatnonzero(head.any(0))
    head_px = float(np.ptp(rows) + 1)
    margin = int(np.ceil(_MARGIN * head_px)) + 8
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom, right = rows[-1] + 1 + margin, columns[-1] + 1 + margin
    bottom += int(_NECK * head_px)
    cut = _each(whole, lambda value: value[top:bottom, left:right])
    height, width = cut["mask"].shape
    landmarks = {scheme: points - [left, top, 0] for scheme, points in whole.landmarks.items()}
    camera = whole.camera.cropped(int(left), int(top), width, height)
    return replace(whole, camera=camera, landmarks=landmarks, head_px=head_px, **cut)


def _each(window: _Window, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """Every channel of a window, changed alike."""
    return {name: change(value) for name, value in vars(window).items() if isinstance(value, np.ndarray)}


def _padded(window: _Window, height: int, width: int) -> _Window:
    """The window grown at its right and bottom by pixels that no term compares."""
    rows, columns = height - window.mask.shape[0], width - window.mask.shape[1]

    def pad(value: np.ndarray) -> np.ndarray:
        return np.pad(value, [(0, rows), (0, columns)] + [(0, 0)] * (value.ndim - 2))

    grown = _each(window, pad)
    return replace(window, camera=window.camera.cropped(0, 0, width, height), **grown)


def _halved(window: _Window) -> _Window:
    def mean(value: np.ndarray) -> np.ndarray:
        h, w = value.shape[0] // 2, value.shape[1] // 2
        return value.reshape(h, 2, w, 2, *value.shape[2:]).mean((1, 3))

    means = _each(window, mean)
    height, width = means["mask"].shape
    return replace(
        window,
        camera=window.camera.scaled(width, height),
        landmarks={scheme: points * [0.5, 0.5, 1] for scheme, points in window.landmarks.items()},
        head_px=window.head_px / 2,
        **means,
    )


def _targets(windows: list[_Window], mapping: ClassMap) -> Targets:
    weighed = [_weigh(w) for w in windows]
    taking_part = np.stack([np.any([w[name] > 0 for name in w if name.endswith("weight")], axis=0) for w in weighed])
    pixels = Pixels.of([w.camera for w in windows], torch.as_tensor(taking_part))
    place = tuple(axis.numpy() for axis in (pixels.view, pixels.y, pixels.x))

    def listed(values: list[np.ndarray]) -> torch.Tensor:
        return torch.as_tensor(np.stack([value.astype(np.float16) for value in values])[place])

    schemes = sorted({scheme for w in windows for scheme in w.landmarks})
    return Targets(
        names=tuple(w.name for w in windows),
        class_names=mapping.names,
        pixels=pixels,
        rgb=listed([w.rgb for w in windows]),
        mask=listed([w.mask for w in windows]),
        classes=listed([w.classes for w in windows]),
        landmarks={scheme: _stack_landmarks(windows, scheme) for scheme in schemes},
        px_per_head=float(np.median([w.head_px for w in windows])),
        **{name: listed([w[name] for w in weighed]) for name in weighed[0]},
    )


def _stack_landmarks(windows: list[_Window], scheme: str) -> torch.Tensor:
    """(N, L, 3) in float32; a view without the scheme has confidence 0."""
    count = max(len(w.landmarks[scheme]) for w in windows if scheme in w.landmarks)
    absent = np.zeros((count, 3))
    return torch.as_tensor(np.stack([w.landmarks.get(scheme, absent) for w in windows]).astype(np.float32))


def _weigh(window: _Window) -> dict[str, np.ndarray]:
    """Unit normals, and where each term compares."""
    known = window.valid * (window.excluded < 0.01)
    inside = (window.mask > _PURE) * known
    length = np.linalg.norm(window.normals, axis=-1)
    sound = inside * (length > _LEAST_NORMAL)
    normals = window.normals / np.maximum(length, 1e-6)[..., None] * sound[..., None]
    facing = np.clip(-(_directions(window.camera) * normals).sum(-1), 0, 1)
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    return {
        "normals": normals,
        "normal_weight": facing,
        "rgb_weight": core * (facing if window.has_normals else 1.0),
        "mask_weight": _silhouette_weight(window) * known if window.has_mask else 0 * known,
        "class_weight": inside * (window.classes.sum(-1) > 0.5),
    }


def _directions(camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Unit world directions through the pixels."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.T_cam_world[:3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _silhouette_weight(window: _Window) -> Float[np.ndarray, "H W"]:
    """1 where the silhouette is the head's: on the head, and on the background that is nearest to it, not far away.

    A model ends elsewhere on the chest than a scan, and hair is not in it.
    """
    subject = window.mask > 0.5
    head, other = _head_and_other(window)

    def distance_to(region: np.ndarray) -> np.ndarray:
        return (
            cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
            if region.any()
            else np.full(region.shape, 1e9)
        )

    to_head = distance_to(head)
    near = to_head < np.where(subject, np.inf, _MARGIN * window.head_px + 2)
    return (near & (to_head < distance_to(other))).astype(np.float32)


def _head_and_other(window: _Window) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The subject's head, and its neck, hair and clothes; of neither are pixels that the mask has and no label."""
    subject = window.mask > 0.5
    other = subject & (window.neck + window.excluded > 0.5)
    head = subject & ~other
    if window.has_classes:
        head &= window.classes.sum(-1) + window.excluded > 0.5
    return head, other
