"""Losses between rendered and captured images.

P are the pixels of the views of a step. Every loss is a sum over pixels divided by one common denominator, the number
of pixels that the subject covers, so that the ratio of the losses does not depend on how many pixels each compares.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.losses.similarity import dissimilarity
from registration.types import Rendered, Targets

_ENCODING_FLOOR = 1e-4
_LEAST_DIFFERENCE = 1e-3  # of a class that is compared: interpolation leaves 1e-7
_HUBER_DELTA = 0.25  # of a mask or class, which the renderer draws as 0 or 1: the gradient fades close to the target


def subject_pixels(targets: Targets) -> Float[Tensor, ""]:
    """Return the area of the subject in pixels, at least 1: the denominator of every image loss."""
    return targets.mask.sum().clamp_min(1.0)


def srgb_encoded(linear: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Return linear light on a perceptual scale: sqrt(max(x, 1e-4)), close to sRGB and cheap to differentiate."""
    return linear.clamp_min(_ENCODING_FLOOR).sqrt()


def pixel_agreement(rendered: Rendered, targets: Targets, surfaces: list[int]) -> Bool[Tensor, "P"]:
    """Return where rendering and target show the same kind of surface.

    Without this test eyelids creep over the eyeballs to match the eyeballs' normals.

    Args:
        rendered: the mesh.
        targets: at the same pixels.
        surfaces: the classes that are surfaces of their own (eyes, mouth interior); their coverages must differ by less
            than 0.5 in total.
    """
    ours, theirs = rendered.classes.detach(), targets.classes
    difference = torch.zeros_like(rendered.mask)
    for surface in surfaces:  # column by column: a selection of columns would be copied
        difference += (ours[:, surface] - theirs[:, surface]).abs()
    return (rendered.mask > 0.5) & (difference < 0.5)


def rgb_l1(rendered: Rendered, targets: Targets, agree: Bool[Tensor, "P"]) -> Float[Tensor, ""]:
    """Return the smoothed L1 difference of encoded colours.

    Sum over pixels and channels of w sqrt((e(r) - e(t))^2 + 1e-4), over the subject's pixels.

    Args:
        rendered: the mesh; colours r exposed as the cameras'.
        targets: colours t, weights w.
        agree: the pixels that are compared.
    """
    difference = srgb_encoded(rendered.rgb) - srgb_encoded(targets.rgb)
    return ((difference.square() + 1e-4).sqrt().sum(-1) * targets.rgb_weight * agree).sum() / subject_pixels(targets)


def rgb_ssim(rendered: Rendered, targets: Targets, agree: Bool[Tensor, "P"]) -> Float[Tensor, ""]:
    """Return the structural dissimilarity of encoded colours [Wang 2004].

    Sum over pixels of w (1 - SSIM), over the subject's pixels; windows of 11 px with a standard deviation of 1.5 px,
    SSIM as the mean over channels.

    Args:
        rendered: the mesh; colours exposed as the cameras'.
        targets: colours, weights w.
        agree: the pixels that are compared.
    """
    # Pixels that are not compared must not affect the windows' statistics: there both images show the target.
    compared = agree & (targets.rgb_weight > 0)
    theirs = srgb_encoded(targets.rgb)
    ours = torch.where(compared[:, None], srgb_encoded(rendered.rgb), theirs)
    return dissimilarity(ours, theirs, targets.rgb_weight * agree, targets.pixels) / subject_pixels(targets)


def normals(
    rendered: Rendered, targets: Targets, agree: Bool[Tensor, "P"], truncation: float | Float[Tensor, "P"]
) -> Float[Tensor, ""]:
    """Return the truncated difference of unit normals.

    Sum over pixels of w d, d = sqrt(|n_r - n_t|^2 + 1e-6) where d < truncation, over the subject's pixels. The weights
    of the targets contain the incidence.

    Args:
        rendered: the mesh; normals in the world.
        targets: normals in the world, weights w.
        agree: the pixels that are compared.
        truncation: larger differences are outliers and do not count; 2 is the largest one. For all pixels or for each.
    """
    difference = ((rendered.normals - targets.normals).square().sum(-1) + 1e-6).sqrt()
    weight = targets.normal_weight * agree * (difference.detach() < truncation)
    return (difference * weight).sum() / subject_pixels(targets)


def mask(rendered: Rendered, targets: Targets) -> Float[Tensor, ""]:
    """Return the difference of the silhouettes: the sum over pixels of w huber(m_r - m_t), over the subject's pixels.

    Args:
        rendered: the mesh; coverage m_r in [0, 1].
        targets: coverage m_t in [0, 1], weights w; inside and outside of the subject.
    """
    return (_huber(rendered.mask - targets.mask) * targets.mask_weight).sum() / subject_pixels(targets)


def classes(rendered: Rendered, targets: Targets, class_weights: Float[Tensor, "K"]) -> Float[Tensor, ""]:
    """Return the difference of the classes' coverages, where the mesh covers the pixel.

    Sum over pixels and classes of w v_k huber(c_r - c_t), over the subject's pixels.

    Args:
        rendered: the mesh; coverage c_r of each class in [0, 1].
        targets: coverage c_t of each class in [0, 1], weights w.
        class_weights: v, of each class.
    """
    counted = (targets.class_weight > 0) & (rendered.mask.detach() > 0.5)
    differing = (rendered.classes.detach() - targets.classes).abs().amax(-1) > _LEAST_DIFFERENCE
    rows = (counted & differing).nonzero()[:, 0]  # most pixels show the class that they should
    ours, theirs, weight = (v.index_select(0, rows) for v in (rendered.classes, targets.classes, targets.class_weight))
    difference = (_huber(ours - theirs) * class_weights).sum(-1)
    return (difference * weight).sum() / subject_pixels(targets)


def _huber(difference: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """x^2 / (2 d) where |x| < d, else |x| - d / 2, with d = `_HUBER_DELTA`."""
    size = difference.abs()
    return torch.where(size < _HUBER_DELTA, size.square() / (2 * _HUBER_DELTA), size - _HUBER_DELTA / 2)
