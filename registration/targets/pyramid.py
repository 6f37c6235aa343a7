"""From a capture to the targets of the losses: image crops around the head, at several resolutions.

Each view is decoded once, at the finest resolution a recipe asks for; coarser levels are block means of that one.
Views are decoded and listed one after the other: only the pixels that are compared stay in memory.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.capture.samples import sample_views
from registration.geometry.surface_views import SurfaceViews
from registration.targets.classes import ClassMap
from registration.targets.view_crop import MARGIN, ViewCrop, directions, read_crop
from registration.types import Capture, Pixels, Targets

_MIN_COVERAGE = 0.99  # of a pixel inside the subject
_MIN_NORMAL_LENGTH = 0.85  # of the mean of a block's unit normals; below it they differ too much
_LEAST_REDUCTION = 1.1  # of a resampling by a fraction: by less it blurs more than it saves


def build_pyramid(
    capture: Capture,
    mapping: ClassMap,
    *,
    finest_head_px: int,
    levels: int,
    coarsest_head_px: int = 0,
    head_rows: Mapping[str, int] | None = None,
    surface: SurfaceViews | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Targets, ...]:
    """Return the targets of all views from fine to coarse; each level has half the resolution of the one before.

    Small images are not reduced to nothing: a level has `coarsest_head_px` at least, or is that of the images.

    Args:
        capture: its views are decoded one at a time.
        mapping: the classes to compare.
        finest_head_px: resolution at level 0, as the subject's height: larger images are reduced to it (those up to a
            tenth larger stay as they are), none is enlarged.
        levels: how many.
        coarsest_head_px: resolution below which no level is reduced, as the subject's height.
        head_rows: height of the head in each view, px of the stored image, by the view's name, as the ledger of a
            validated capture has it; None: masks and labels are decoded once more to measure it.
        surface: of the subject, in the cameras' world: its normals stand in for normal maps where a view has none.
        progress: called with the number of views that are decoded.

    Raises:
        InputError: an image cannot be decoded.
    """
    if head_rows is None:
        head_rows = {sample.name: sample.head_rows for sample in sample_views(capture)}
    stored_px = float(np.median([head_rows[view.name] for view in capture.views]))
    reduction, head_px = stored_px / finest_head_px, min(stored_px, finest_head_px)
    whole = max(1, int(reduction))  # by blocks while decoding, the rest by areas of the crop
    heights = [max(head_px / 2**level, min(head_px, coarsest_head_px)) for level in range(levels)]
    listed: list[list[_ListedView]] = [[] for _ in range(levels)]
    for done, view in enumerate(capture.views):
        progress(done)
        crop = read_crop(view, capture, mapping, min(whole, view.camera.width_px, view.camera.height_px))
        if reduction / whole > _LEAST_REDUCTION:
            size = (round(side * whole / reduction) for side in (crop.camera.width_px, crop.camera.height_px))
            crop = crop.reduced(*size)
        if surface is not None and not crop.has_normals:
            crop = crop.with_surface(surface)
        crop = crop.padded(2 ** (levels - 1))  # whole blocks of the coarsest level
        for level, height in enumerate(heights):
            if level and height == heights[level - 1]:
                continue
            if level:
                share = height / heights[level - 1]
                crop = crop.reduced(round(crop.camera.width_px * share), round(crop.camera.height_px * share))
            listed[level].append(_ListedView.from_crop(crop))
    pyramid: list[Targets] = []
    for views in listed:
        pyramid.append(_targets(views, mapping) if views else pyramid[-1])
    return tuple(pyramid)


@dataclass(frozen=True, kw_only=True)
class _ListedView:
    """The pixels of one view that are compared."""

    crop: ViewCrop  # its channels are empty
    pixels: Pixels
    values: Mapping[str, Float[Tensor, "P *D"]]  # fields of `Targets`; float16, depths float32

    @classmethod
    def from_crop(cls, crop: ViewCrop) -> "_ListedView":
        weighted = _apply_weights(crop)
        compared = np.any([value > 0 for name, value in weighted.items() if name.endswith("weight")], axis=0)
        pixels = Pixels.from_mask([crop.camera], torch.as_tensor(compared)[None])
        rows = pixels.y.numpy(), pixels.x.numpy()
        images = {"rgb": crop.rgb, "mask": crop.mask, "classes": crop.classes, **weighted}
        values = {name: torch.as_tensor(image[rows].astype(np.float16)) for name, image in images.items()}
        if crop.depth is not None:  # float16 has steps of half a millimetre at a metre
            values["depth"] = torch.as_tensor(crop.depth[rows].astype(np.float32))
        return cls(crop=crop.without_channels(), pixels=pixels, values=values)


def _targets(views: list[_ListedView], mapping: ClassMap) -> Targets:
    """One level; all images get the size of the largest."""
    height, width = (max(view.pixels.index.shape[axis] for view in views) for axis in (1, 2))
    sizes = [len(view.pixels.view) for view in views]
    index = torch.full((len(views), height, width), -1, dtype=torch.int32)
    for number, view in enumerate(views):
        own = view.pixels.index[0]
        index[number, : own.shape[0], : own.shape[1]] = torch.where(own < 0, own, own + sum(sizes[:number]))
    pixels = Pixels(
        cameras=tuple(view.crop.camera.cropped(0, 0, width, height) for view in views),
        view=torch.repeat_interleave(torch.arange(len(views), dtype=torch.int32), torch.tensor(sizes)),
        x=torch.cat([view.pixels.x for view in views]),
        y=torch.cat([view.pixels.y for view in views]),
        index=index,
    )

    def all_views(name: str) -> Tensor:  # zeros: of a view without depths
        return torch.cat([view.values.get(name, torch.zeros(len(view.pixels.view))) for view in views])

    crops = [view.crop for view in views]
    schemes = sorted({scheme for crop in crops for scheme in crop.landmarks})
    return Targets(
        names=tuple(crop.name for crop in crops),
        class_names=mapping.names,
        pixels=pixels,
        landmarks={scheme: _stack_landmarks(crops, scheme) for scheme in schemes},
        landmark_spread_px={
            scheme: _stack_spreads(crops, scheme)
            for scheme in schemes
            if any(scheme in crop.landmark_spread_px for crop in crops)
        },
        px_per_head=float(np.median([crop.head_px for crop in crops])),
        **{name: all_views(name) for name in {name for view in views for name in view.values}},
    )


def _stack_landmarks(crops: list[ViewCrop], scheme: str) -> torch.Tensor:
    """(N, L, 3) in float32; a view without the scheme has confidence 0."""
    count = max(len(crop.landmarks[scheme]) for crop in crops if scheme in crop.landmarks)
    absent = np.zeros((count, 3))
    return torch.as_tensor(np.stack([crop.landmarks.get(scheme, absent) for crop in crops]).astype(np.float32))


def _stack_spreads(crops: list[ViewCrop], scheme: str) -> torch.Tensor:
    """(N, L) in float32; NaN in a view that does not state it."""
    count = max(len(crop.landmarks[scheme]) for crop in crops if scheme in crop.landmarks)
    unknown = np.full(count, np.nan)
    return torch.as_tensor(
        np.stack([crop.landmark_spread_px.get(scheme, unknown) for crop in crops]).astype(np.float32)
    )


def _apply_weights(crop: ViewCrop) -> dict[str, np.ndarray]:
    """Unit normals, and the weight of each pixel in each loss."""
    valid = crop.valid * (crop.excluded < 0.01)
    inside = (crop.mask > _MIN_COVERAGE) * valid
    length = np.linalg.norm(crop.normals, axis=-1)
    has_normal = inside * (length > _MIN_NORMAL_LENGTH)
    normals = crop.normals / np.maximum(length, 1e-6)[..., None] * has_normal[..., None]
    facing = np.clip(-(directions(crop.camera) * normals).sum(-1), 0, 1)
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


def _silhouette_weight(crop: ViewCrop) -> Float[np.ndarray, "H W"]:
    """1 on the head, and on the background close to it that is closer to the head than to neck, hair or clothes.

    The model ends elsewhere on the chest than the subject, and has no hair.
    """
    subject = crop.mask > 0.5
    head, other = crop.head_and_other()

    def distance_to(region: np.ndarray) -> np.ndarray:
        return (
            cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
            if region.any()
            else np.full(region.shape, 1e9)
        )

    to_head = distance_to(head)
    near = to_head < np.where(subject, np.inf, MARGIN * crop.head_px + 2)
    return (near & (to_head < distance_to(other))).astype(np.float32)
