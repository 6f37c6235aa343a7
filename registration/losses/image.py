"""What rendered images are compared by. Every term is a mean over the subject's pixels of the views of a step."""

import torch
from jaxtyping import Bool, Float
from kornia.metrics import ssim
from torch import Tensor

from registration.types import Rendered, Targets

_ENCODING_FLOOR = 1e-4
# A rendered mask or class jumps from 0 to 1; near its target the pull fades instead of flipping its sign.
_RAMP = 0.25


def subject_pixels(targets: Targets) -> Tensor:
    """How many pixels the subject covers: the common denominator, so that terms keep their ratio."""
    return targets.mask.sum().clamp_min(1.0)


def encoded(linear: Tensor) -> Tensor:
    """Linear light to a perceptual scale: its square root, close to sRGB and cheap to differentiate."""
    return linear.clamp_min(_ENCODING_FLOOR).sqrt()


def agreement(rendered: Rendered, targets: Targets, surfaces: list[int]) -> Bool[Tensor, "P"]:
    """1 where rendered and target pixel lie on the same kind of surface, else 0.

    `surfaces` are the classes that are surfaces of their own (eyes, mouth interior). Without this test lids creep over
    the eyeballs to match the eyeballs' normals.
    """
    difference = (rendered.classes[..., surfaces] - targets.classes[..., surfaces]).detach().abs().sum(-1)
    return (rendered.mask > 0.5) & (difference < 0.5)


def rgb_l1(rendered: Rendered, targets: Targets, agree: Tensor) -> Tensor:
    """Smoothed L1 on perceptually encoded colour."""
    difference = encoded(rendered.rgb) - encoded(targets.rgb)
    return ((difference.square() + 1e-4).sqrt().sum(-1) * targets.rgb_weight * agree).sum() / subject_pixels(targets)


def rgb_ssim(rendered: Rendered, targets: Targets, agree: Tensor) -> Tensor:
    """1 - SSIM on perceptually encoded colour, window 11, sigma 1.5 px."""
    # What is not compared must not enter the windows' statistics: there both images show the target.
    compared = agree & (targets.rgb_weight > 0)
    shown = torch.where(compared[:, None], encoded(rendered.rgb), encoded(targets.rgb))
    ours, theirs = (targets.pixels.image(c).permute(0, 3, 1, 2) for c in (shown, encoded(targets.rgb)))
    dissimilarity = 1 - ssim(ours, theirs, 11).mean(1)
    weight = targets.pixels.image((targets.rgb_weight * agree)[:, None])[..., 0]
    return (dissimilarity * weight).sum() / subject_pixels(targets)


def normals(rendered: Rendered, targets: Targets, agree: Tensor, truncation: float) -> Tensor:
    """Length of the normals' difference, weighted by incidence; differences beyond `truncation` are outliers."""
    difference = ((rendered.normals - targets.normals).square().sum(-1) + 1e-6).sqrt()
    weight = targets.normal_weight * agree * (difference.detach() < truncation)
    return (difference * weight).sum() / subject_pixels(targets)


def mask(rendered: Rendered, targets: Targets) -> Tensor:
    """Rendered against seen silhouette, outside and inside."""
    return (_ramp(rendered.mask - targets.mask) * targets.mask_weight).sum() / subject_pixels(targets)


def classes(rendered: Rendered, targets: Targets, class_weights: Float[Tensor, "K"]) -> Tensor:
    """Soft class shares against the labels' shares, where both see the subject."""
    difference = (_ramp(rendered.classes - targets.classes) * class_weights).sum(-1)
    return (difference * targets.class_weight * (rendered.mask.detach() > 0.5)).sum() / subject_pixels(targets)


def _ramp(difference: Tensor) -> Tensor:
    """|x|, rounded off within `_RAMP` of zero (Huber)."""
    size = difference.abs()
    return torch.where(size < _RAMP, size.square() / (2 * _RAMP), size - _RAMP / 2)
