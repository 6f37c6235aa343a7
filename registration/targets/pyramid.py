"""From a capture to the targets of the losses: image crops around the head, at several resolutions.

Each view is decoded once, at the finest resolution a recipe asks for; coarser levels are block means of that one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from registration.capture.dense_maps import block_depth
from registration.capture.pixels import read_view, undistort_landmarks, undistorted_spread
from registration.capture.samples import sample_views
from registration.geometry.surface_views import SurfaceViews
from registration.targets.classes import BACKGROUND, ClassMap
from registration.types import Camera, Capture, Pixels, Targets, View, ViewPixels

_MARGIN = 0.08  # times the head's height: distance around the head of the pixels and silhouettes that are compared
_NECK = 0.3  # times the head's height: part below the head that a crop contains
_MIN_COVERAGE = 0.99  # of a pixel inside the subject
_MIN_NORMAL_LENGTH = 0.85  # of the mean of a block's unit normals; below it they differ too much


@dataclass(frozen=True, kw_only=True)
class _ViewCrop:
    """The pixels around the head of one view; channels can be averaged in blocks."""

    name: str
    camera: Camera
    rgb: Float[np.ndarray, "H W 3"]
    normals: Float[np.ndarray, "H W 3"]  # world frame; 0 where none
    mask: Float[np.ndarray, "H W"]
    classes: Float[np.ndarray, "H W K"]
    neck: Float[np.ndarray, "H W"]  # coverage, as the next
    excluded: Float[np.ndarray, "H W"]
    valid: Float[np.ndarray, "H W"]
    incidence: Float[np.ndarray, "H W"]  # cosine, where it is known without normals; else 1
    confidence: Float[np.ndarray, "H W"] | None  # of normals and depth; None: 1
    depth: Float[np.ndarray, "H W"] | None  # along the optical axis, metres; 0 where none
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]]
    landmark_spread_px: Mapping[str, Float[np.ndarray, "L"]]
    has_mask: bool
    has_classes: bool
    has_colours: bool
    has_normals: bool  # from a file
    has_holes: bool  # in the normals, as stereo leaves them: colours count beside them too
    head_px: float


def build_pyramid(
    capture: Capture,
    mapping: ClassMap,
    *,
    finest_head_px: int,
    levels: int,
    head_rows: Mapping[str, int] | None = None,
    surface: SurfaceViews | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Targets, ...]:
    """Return the targets of all views from fine to coarse; each level has half the resolution of the one before.

    Args:
        capture: its views are decoded one at a time.
        mapping: the classes to compare.
        finest_head_px: resolution at level 0. Views are downsampled by the integer factor that brings the subject's
            height closest to this from above, never enlarged.
        levels: how many.
        head_rows: height of the head in each view, px of the stored image, by the view's name, as the ledger of a
            validated capture has it; None: masks and labels are decoded once more to measure it.
        surface: of the subject, in the cameras' world: its normals stand in for normal maps where a view has none.
        progress: called with the number of views that are decoded.

    Raises:
        InputError: an image cannot be decoded.
    """
    if head_rows is None:
        head_rows = {sample.name: sample.head_rows for sample in sample_views(capture)}
    height_px = float(np.median([head_rows[view.name] for view in capture.views]))
    downsample = max(1, int(height_px / finest_head_px))
    crops = []
    for done, view in enumerate(capture.views):
        progress(done)
        crop = _view_crop(view, capture, mapping, min(downsample, view.camera.width_px, view.camera.height_px))
        crops.append(crop if crop.has_normals or surface is None else _with_surface(crop, surface))
    block = 2 ** (levels - 1)
    height, width = (
        -(-max(crop.mask.shape[axis] for crop in crops) // block) * block for axis in (0, 1)
    )  # rounded up to whole blocks of the coarsest level
    crops = [_padded(crop, height, width) for crop in crops]
    pyramid = []
    for level in range(levels):
        if level:
            crops = [_halved(crop) for crop in crops]
        pyramid.append(_targets(crops, mapping))
    return tuple(pyramid)


def _view_crop(view: View, capture: Capture, mapping: ClassMap, downsample: int) -> _ViewCrop:
    pixels = read_view(view, capture, downsample=downsample)
    shape = pixels.rgb.shape[:2]
    zeros = np.zeros(shape, np.float32)
    classes = np.zeros((*shape, len(mapping.names)), np.float32)
    neck = excluded = zeros
    if pixels.label_coverage is not None:
        classes = pixels.label_coverage @ mapping.from_capture
        neck, excluded = pixels.label_coverage @ mapping.neck, pixels.label_coverage @ mapping.excluded
    mask = _coverage(pixels, capture)
    normals = np.zeros((*shape, 3), np.float32)
    if pixels.normals is not None:
        normals = (pixels.normals @ pixels.camera.T_cam_world[:3, :3]).astype(np.float32)
    landmarks = {}
    for scheme in view.landmarks:
        points = undistort_landmarks(view, scheme).copy()
        points[:, :2] /= downsample
        landmarks[scheme] = points
    spreads = {scheme: undistorted_spread(view, scheme) / downsample for scheme in view.landmark_spread_px}
    full = _ViewCrop(
        name=view.name,
        camera=pixels.camera,
        rgb=pixels.rgb.astype(np.float32),
        normals=normals,
        mask=zeros + 1 if mask is None else mask,
        classes=classes,
        neck=neck,
        excluded=excluded,
        valid=pixels.valid,
        incidence=zeros + 1,
        confidence=pixels.confidence,
        depth=pixels.depth,
        landmarks=landmarks,
        landmark_spread_px=spreads,
        has_mask=mask is not None,
        has_classes=pixels.label_coverage is not None,
        has_colours=capture.photographs,
        has_normals=pixels.normals is not None,
        has_holes=pixels.depth is not None or pixels.confidence is not None,
        head_px=float(shape[0]),
    )
    return _crop_to_head(full)


def _with_surface(crop: _ViewCrop, surface: SurfaceViews) -> _ViewCrop:
    """A crop with the normals of a surface; colours count beside it too, where it has holes."""
    view = surface.view(crop.camera)
    normals = (view.normals * (view.weight > 0)[..., None]).astype(np.float32)
    towards = -(_directions(crop.camera) * view.normals).sum(-1)  # below 0 behind a hole
    incidence = np.where(towards > 0, towards, 1).astype(np.float32)
    return replace(crop, normals=normals, incidence=incidence)


def _coverage(pixels: ViewPixels, capture: Capture) -> Float[np.ndarray, "H W"] | None:
    if pixels.mask is not None:
        return pixels.mask
    if pixels.label_coverage is not None and BACKGROUND in capture.classes:
        return 1 - pixels.label_coverage[..., capture.classes.index(BACKGROUND)]
    return None


def _crop_to_head(full: _ViewCrop) -> _ViewCrop:
    head, _ = _head_and_other(full)
    if not full.has_mask or not head.any():
        return full
    rows, columns = np.flatnonzero(head.any(1)), np.flatnonzero(head.any(0))
    head_px = float(np.ptp(rows) + 1)
    margin = int(np.ceil(_MARGIN * head_px)) + 8
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom, right = rows[-1] + 1 + margin, columns[-1] + 1 + margin
    bottom += int(_NECK * head_px)
    channels = _each(full, lambda value: value[top:bottom, left:right])
    height, width = channels["mask"].shape
    landmarks = {scheme: points - [left, top, 0] for scheme, points in full.landmarks.items()}
    camera = full.camera.cropped(int(left), int(top), width, height)
    return replace(full, camera=camera, landmarks=landmarks, head_px=head_px, **channels)


def _each(crop: _ViewCrop, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """Apply a function to every channel of a crop."""
    return {name: change(value) for name, value in vars(crop).items() if isinstance(value, np.ndarray)}


def _padded(crop: _ViewCrop, height: int, width: int) -> _ViewCrop:
    """Extend a crop at its right and bottom by pixels that no loss compares."""
    rows, columns = height - crop.mask.shape[0], width - crop.mask.shape[1]

    def pad(value: np.ndarray) -> np.ndarray:
        return np.pad(value, [(0, rows), (0, columns)] + [(0, 0)] * (value.ndim - 2))

    channels = _each(crop, pad)
    return replace(crop, camera=crop.camera.cropped(0, 0, width, height), **channels)


def _halved(crop: _ViewCrop) -> _ViewCrop:
    """A crop at half the resolution: means over blocks of 2 x 2 pixels."""

    def mean(value: np.ndarray) -> np.ndarray:
        h, w = value.shape[0] // 2, value.shape[1] // 2
        return value.reshape(h, 2, w, 2, *value.shape[2:]).mean((1, 3))

    means = _each(crop, mean)
    if (depth := crop.depth) is not None:
        means["depth"] = block_depth(mean((depth > 0).astype(np.float32)), means["depth"], mean(depth**2))
    height, width = means["mask"].shape
    return replace(
        crop,
        camera=crop.camera.scaled(width, height),
        landmarks={scheme: points * [0.5, 0.5, 1] for scheme, points in crop.landmarks.items()},
        landmark_spread_px={scheme: spread_px / 2 for scheme, spread_px in crop.landmark_spread_px.items()},
        head_px=crop.head_px / 2,
        **means,
    )


def _targets(crops: list[_ViewCrop], mapping: ClassMap) -> Targets:
    weighted = [_apply_weights(crop) for crop in crops]
    compared = np.stack([np.any([w[name] > 0 for name in w if name.endswith("weight")], axis=0) for w in weighted])
    pixels = Pixels.from_mask([crop.camera for crop in crops], torch.as_tensor(compared))
    indices = tuple(axis.numpy() for axis in (pixels.view, pixels.y, pixels.x))

    def listed(values: list[np.ndarray]) -> torch.Tensor:
        return torch.as_tensor(np.stack([value.astype(np.float16) for value in values])[indices])

    depth = None
    if any(crop.depth is not None for crop in crops):  # float16 has steps of half a millimetre at a metre
        known = [np.zeros_like(crop.mask) if crop.depth is None else crop.depth for crop in crops]
        depth = torch.as_tensor(np.stack(known).astype(np.float32)[indices])
    schemes = sorted({scheme for crop in crops for scheme in crop.landmarks})
    return Targets(
        names=tuple(crop.name for crop in crops),
        class_names=mapping.names,
        pixels=pixels,
        rgb=listed([crop.rgb for crop in crops]),
        mask=listed([crop.mask for crop in crops]),
        classes=listed([crop.classes for crop in crops]),
        depth=depth,
        landmarks={scheme: _stack_landmarks(crops, scheme) for scheme in schemes},
        landmark_spread_px={
            scheme: _stack_spreads(crops, scheme)
            for scheme in schemes
            if any(scheme in crop.landmark_spread_px for crop in crops)
        },
        px_per_head=float(np.median([crop.head_px for crop in crops])),
        **{name: listed([w[name] for w in weighted]) for name in weighted[0]},
    )


def _stack_landmarks(crops: list[_ViewCrop], scheme: str) -> torch.Tensor:
    """(N, L, 3) in float32; a view without the scheme has confidence 0."""
    count = max(len(crop.landmarks[scheme]) for crop in crops if scheme in crop.landmarks)
    absent = np.zeros((count, 3))
    return torch.as_tensor(np.stack([crop.landmarks.get(scheme, absent) for crop in crops]).astype(np.float32))


def _stack_spreads(crops: list[_ViewCrop], scheme: str) -> torch.Tensor:
    """(N, L) in float32; NaN in a view that does not state it."""
    count = max(len(crop.landmarks[scheme]) for crop in crops if scheme in crop.landmarks)
    unknown = np.full(count, np.nan)
    return torch.as_tensor(
        np.stack([crop.landmark_spread_px.get(scheme, unknown) for crop in crops]).astype(np.float32)
    )


def _apply_weights(crop: _ViewCrop) -> dict[str, np.ndarray]:
    """Unit normals, and the weight of each pixel in each loss."""
    valid = crop.valid * (crop.excluded < 0.01)
    inside = (crop.mask > _MIN_COVERAGE) * valid
    length = np.linalg.norm(crop.normals, axis=-1)
    has_normal = inside * (length > _MIN_NORMAL_LENGTH)
    normals = crop.normals / np.maximum(length, 1e-6)[..., None] * has_normal[..., None]
    facing = np.clip(-(_directions(crop.camera) * normals).sum(-1), 0, 1)
    incidence = facing if crop.has_normals else crop.incidence
    if crop.has_holes:
        incidence = np.where(has_normal > 0, facing, crop.incidence)
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    return {
        "normals": normals,
        "normal_weight": facing if crop.confidence is None else facing * crop.confidence,
        "rgb_weight": core * incidence * float(crop.has_colours),
        "mask_weight": _silhouette_weight(crop) * valid if crop.has_mask else 0 * valid,
        "class_weight": inside * (crop.classes.sum(-1) > 0.5),
    }


def _directions(camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Unit world directions through the pixels."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.T_cam_world[:3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _silhouette_weight(crop: _ViewCrop) -> Float[np.ndarray, "H W"]:
    """1 on the head, and on the background close to it that is closer to the head than to neck, hair or clothes.

    The model ends elsewhere on the chest than the subject, and has no hair.
    """
    subject = crop.mask > 0.5
    head, other = _head_and_other(crop)

    def distance_to(region: np.ndarray) -> np.ndarray:
        return (
            cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
            if region.any()
            else np.full(region.shape, 1e9)
        )

    to_head = distance_to(head)
    near = to_head < np.where(subject, np.inf, _MARGIN * crop.head_px + 2)
    return (near & (to_head < distance_to(other))).astype(np.float32)


def _head_and_other(crop: _ViewCrop) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The subject's head, and its neck, hair and clothes; pixels in the mask without a label are neither."""
    subject = crop.mask > 0.5
    other = subject & (crop.neck + crop.excluded > 0.5)
    head = subject & ~other
    if crop.has_classes:
        head &= crop.classes.sum(-1) + crop.excluded > 0.5
    return head, other
