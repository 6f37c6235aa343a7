"""Weights of the views: one that disagrees with all others weighs less, and the result names it.

A camera that was moved, a label map of another frame, a black or an overexposed image: the view's outline, landmarks or
brightness deviate from the other views'. Deviations are relative to the median of the views, so that no view is
suspected while the fit is bad everywhere.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.types import Rendered, Targets

HEAD_PX = 512  # height of the head to which errors in pixels are scaled
MIN_ERROR_PX = 6.0  # at that height; below it no view is suspected
_MAX_MEDIAN_RATIO = 3.0
_MIN_LOG_BRIGHTNESS = 0.6  # difference of the logarithm: 1.8 times
_MAX_MAD_RATIO = 6.0


@dataclass(frozen=True, kw_only=True)
class ViewErrors:
    """How far each view is from a mesh and from the other views, px at 512 px of head height (NaN: unknown), and how
    bright it is."""

    names: tuple[str, ...]
    outline_px: Float[Tensor, "N"]
    landmark_px: Float[Tensor, "N"]
    brightness: Float[Tensor, "N"]  # logarithm of the mean colour

    def disagreement(self, limit_px: float) -> str | None:
        """Return a phrase that names the views whose errors exceed a limit (px), or None."""
        parts = []
        for name, errors in (("landmarks", self.landmark_px), ("silhouette", self.outline_px)):
            off = errors.nan_to_num(0.0) > limit_px
            if off.any():
                views = ", ".join(self.names[i] for i in off.nonzero()[:, 0].tolist())
                parts.append(f"{name} off by {errors[off].median().item():.0f} px in views {views}")
        return "; ".join(parts) or None


@dataclass(frozen=True, kw_only=True)
class ViewWeights:
    """Weights of the views in [0, 1], and why some are below one."""

    geometry: Float[Tensor, "N"]  # of masks, labels, normals, landmarks
    colour: Float[Tensor, "N"]
    notes: Mapping[str, str]  # view -> what is wrong with it

    @classmethod
    def uniform(cls, views: int) -> "ViewWeights":
        """Return weights of one for all views."""
        return cls(geometry=torch.ones(views), colour=torch.ones(views), notes={})

    @classmethod
    def from_errors(cls, errors: ViewErrors) -> "ViewWeights":
        """Return lower weights for views that deviate from the others: (limit / error)^4 beyond the limit."""
        geometry = torch.ones(len(errors.names))
        notes: dict[str, str] = {}
        for what, values in (("silhouette", errors.outline_px), ("landmarks", errors.landmark_px)):
            limit = max(MIN_ERROR_PX, _MAX_MEDIAN_RATIO * values.nanmedian().nan_to_num(0.0).item())
            for view in (values.nan_to_num(0.0) > limit).nonzero()[:, 0].tolist():
                geometry[view] = min(geometry[view].item(), (limit / values[view].item()) ** 4)
                notes.setdefault(errors.names[view], f"{what} {values[view].item():.0f} px off the other views")
        colour = geometry.clone()
        deviation = errors.brightness - errors.brightness.median()
        limit = max(_MIN_LOG_BRIGHTNESS, _MAX_MAD_RATIO * deviation.abs().median().item())
        for view in (deviation.abs() > limit).nonzero()[:, 0].tolist():
            colour[view] = 0.0
            notes.setdefault(
                errors.names[view], f"{deviation[view].exp().item():.2g} times as bright as the other views"
            )
        return cls(geometry=geometry, colour=colour, notes=notes)

    def apply(self, batch: Targets, views: Sequence[int]) -> Targets:
        """Return the targets of some views, multiplied by the weights of these views."""
        if not self.notes:
            return batch
        view = batch.pixels.view.long()
        geometry, colour = (w.to(view.device)[list(views)] for w in (self.geometry, self.colour))
        geometry_weight, colour_weight = geometry.index_select(0, view), colour.index_select(0, view)
        landmarks = {
            scheme: torch.cat([points[..., :2], points[..., 2:] * (geometry > 0.5)[:, None, None]], -1)
            for scheme, points in batch.landmarks.items()
        }
        return replace(
            batch,
            rgb_weight=batch.rgb_weight * colour_weight,
            normal_weight=batch.normal_weight * geometry_weight,
            mask_weight=batch.mask_weight * geometry_weight,
            class_weight=batch.class_weight * geometry_weight,
            landmarks=landmarks,
        )


def view_errors(rendered: Rendered, targets: Targets, landmark_px: Float[Tensor, "N"]) -> ViewErrors:
    """Return the errors of all views.

    Args:
        rendered: the mesh at the pixels of the targets.
        targets: of all views.
        landmark_px: median deviation of each view, px at 512 px of head height; NaN without landmarks.

    Returns:
        The outline's error is the area where the masks differ over the length of the target's outline.
    """
    count, view = len(targets.names), targets.pixels.view.long()

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(count).index_add(0, view, values)

    compared = (targets.mask_weight > 0).float()
    difference = total((rendered.mask - targets.mask).abs() * compared)
    outline = total(_outline(targets, (targets.mask > 0.5) & (compared > 0)).float())
    scale = HEAD_PX / targets.px_per_head
    weight = total(targets.rgb_weight)
    mean = total(targets.rgb.mean(-1) * targets.rgb_weight) / weight.clamp_min(1e-6)
    typical = mean[weight > 0].median() if (weight > 0).any() else mean.new_ones(())
    return ViewErrors(
        names=targets.names,
        outline_px=torch.where(outline > 0, difference / outline.clamp_min(1) * scale, torch.nan),
        landmark_px=landmark_px,
        brightness=torch.where(weight > 0, mean, typical).clamp_min(1e-4).log(),
    )


def _outline(targets: Targets, subject: Bool[Tensor, "P"]) -> Bool[Tensor, "P"]:
    """The subject's pixels next to pixels that are compared and are not the subject."""
    image = targets.pixels.image(torch.stack([subject, ~subject & (targets.mask_weight > 0)], -1).float())
    near = torch.nn.functional.max_pool2d(image[..., 1][:, None], 3, stride=1, padding=1)[:, 0]
    return subject & (targets.pixels.of_image(near) > 0)
