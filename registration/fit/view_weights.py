"""Which views can be trusted: one that disagrees with all others weighs less, and is named.

A camera that was bumped, a label map of another frame, a black or overexposed image: whatever it is, the view's
outline, landmarks or brightness stand apart from the other views'. They are judged against the median of the views, so
that a fit that is still bad everywhere blames none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.types import Rendered, Targets

HEAD_PX = 512  # height of the head that pixel figures refer to
_LEAST_OFF_PX = 6.0  # at that height; below it no view is suspected
_TIMES_MEDIAN = 3.0
_LEAST_STOPS = 0.6  # of brightness, as a logarithm: 1.8 times
_TIMES_SPREAD = 6.0


@dataclass(frozen=True, kw_only=True)
class ViewErrors:
    """How far each view is from a mesh, px at 512 px of head height (NaN: cannot be told), and how bright it is."""

    names: tuple[str, ...]
    outline_px: Float[Tensor, "N"]
    landmark_px: Float[Tensor, "N"]
    brightness: Float[Tensor, "N"]  # logarithm of the mean colour

    def disagreement(self, limit_px: float) -> str | None:
        """One sentence on the views that are off by more than a limit."""
        parts = []
        for name, errors in (("landmarks", self.landmark_px), ("silhouette", self.outline_px)):
            off = errors.nan_to_num(0.0) > limit_px
            if off.any():
                views = ", ".join(self.names[i] for i in off.nonzero()[:, 0].tolist())
                parts.append(f"{name} off by {errors[off].median().item():.0f} px in views {views}")
        return "; ".join(parts) or None


@dataclass(frozen=True, kw_only=True)
class Trust:
    """Weights of the views, and why some are below one."""

    geometry: Float[Tensor, "N"]  # of masks, labels, normals, landmarks
    colour: Float[Tensor, "N"]
    notes: Mapping[str, str]  # view -> what is wrong with it

    @classmethod
    def full(cls, views: int) -> "Trust":
        return cls(geometry=torch.ones(views), colour=torch.ones(views), notes={})

    @classmethod
    def of(cls, errors: ViewErrors) -> "Trust":
        """Views that stand apart from the others, down to almost nothing for those that are far off."""
        geometry = torch.ones(len(errors.names))
        notes: dict[str, str] = {}
        for what, values in (("silhouette", errors.outline_px), ("landmarks", errors.landmark_px)):
            limit = max(_LEAST_OFF_PX, _TIMES_MEDIAN * values.nanmedian().nan_to_num(0.0).item())
            for view in (values.nan_to_num(0.0) > limit).nonzero()[:, 0].tolist():
                geometry[view] = min(geometry[view].item(), (limit / values[view].item()) ** 4)
                notes.setdefault(errors.names[view], f"{what} {values[view].item():.0f} px off the other views")
        colour = geometry.clone()
        away = errors.brightness - errors.brightness.median()
        limit = max(_LEAST_STOPS, _TIMES_SPREAD * away.abs().median().item())
        for view in (away.abs() > limit).nonzero()[:, 0].tolist():
            colour[view] = 0.0
            notes.setdefault(errors.names[view], f"{away[view].exp().item():.2g} times as bright as the other views")
        return cls(geometry=geometry, colour=colour, notes=notes)

    def applied(self, batch: Targets, views: Sequence[int]) -> Targets:
        """The targets of some views, weighed."""
        if not self.notes:
            return batch
        view = batch.pixels.view.long()
        geometry, colour = (w.to(view.device)[list(views)] for w in (self.geometry, self.colour))
        geometry_at, colour_at = geometry.index_select(0, view), colour.index_select(0, view)
        landmarks = {
            scheme: torch.cat([seen[..., :2], seen[..., 2:] * (geometry > 0.5)[:, None, None]], -1)
            for scheme, seen in batch.landmarks.items()
        }
        return replace(
            batch,
            rgb_weight=batch.rgb_weight * colour_at,
            normal_weight=batch.normal_weight * geometry_at,
            mask_weight=batch.mask_weight * geometry_at,
            class_weight=batch.class_weight * geometry_at,
            landmarks=landmarks,
        )


def view_errors(rendered: Rendered, targets: Targets, landmark_px: Float[Tensor, "N"]) -> ViewErrors:
    """Of one rendering of all views."""
    count, view = len(targets.names), targets.pixels.view.long()

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(count).index_add(0, view, values)

    known = (targets.mask_weight > 0).float()
    wrong = total((rendered.mask - targets.mask).abs() * known)
    outline = total(_rim(targets, (targets.mask > 0.5) & (known > 0)).float())
    scale = HEAD_PX / targets.px_per_head
    weight = total(targets.rgb_weight)
    mean = total(targets.rgb.mean(-1) * targets.rgb_weight) / weight.clamp_min(1e-6)
    typical = mean[weight > 0].median() if (weight > 0).any() else mean.new_ones(())
    return ViewErrors(
        names=targets.names,
        outline_px=torch.where(outline > 0, wrong / outline.clamp_min(1) * scale, torch.nan),
        landmark_px=landmark_px,
        brightness=torch.where(weight > 0, mean, typical).clamp_min(1e-4).log(),
    )


def _rim(targets: Targets, subject: Bool[Tensor, "P"]) -> Bool[Tensor, "P"]:
    """The subject's pixels next to pixels that are compared and are not the subject."""
    image = targets.pixels.image(torch.stack([subject, ~subject & (targets.mask_weight > 0)], -1).float())
    near = torch.nn.functional.max_pool2d(image[..., 1][:, None], 3, stride=1, padding=1)[:, 0]
    return subject & (targets.pixels.of_image(near) > 0)
