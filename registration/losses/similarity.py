"""Structural similarity of images that are given at a list of pixels [Wang 2004], with its gradient.

Windows are Gaussian, 11 px wide with a standard deviation of 1.5 px. Pixels that are not listed, and those outside the
image, are black in both images. Means over such windows are their own transpose, so that the gradient is the sum of
three more of them; statistics of the target alone need none. Views are treated one after the other, because their
images then stay in the processor's cache.
"""

from typing import Any

import cv2
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from registration.types import Pixels

_RADIUS, _SIGMA = 5, 1.5  # px
_MEANS_FLOOR, _VARIANCES_FLOOR = 0.01**2, 0.03**2  # for values in [0, 1]


def dissimilarity(
    ours: Float[Tensor, "P 3"], theirs: Float[Tensor, "P 3"], weight: Float[Tensor, "P"], pixels: Pixels
) -> Float[Tensor, ""]:
    """Return the sum over pixels of w (1 - SSIM), with SSIM as the mean over channels.

    Args:
        ours: values in [0, 1]; differentiable.
        theirs: the target's; not differentiable, as the next.
        weight: w.
        pixels: the list.
    """
    total: Tensor = _Dissimilarity.apply(ours, theirs, weight, pixels)
    return total


class _Dissimilarity(torch.autograd.Function):
    """The gradient is computed with the value: both need the same windows."""

    @staticmethod
    def forward(ctx: Any, ours: Tensor, theirs: Tensor, weight: Tensor, pixels: Pixels) -> Tensor:
        window = torch.arange(-_RADIUS, _RADIUS + 1, dtype=ours.dtype, device=ours.device)
        window = torch.softmax(-0.5 * (window / _SIGMA).square(), 0)
        total, gradient = ours.new_zeros(()), torch.empty_like(ours)
        shape = pixels.index.shape[1:]
        for view, rows in enumerate(pixels.rows_by_view):
            position = pixels.position[rows] - view * shape.numel()
            images = ours.new_zeros(shape.numel(), 7)
            values = torch.cat([ours[rows], theirs[rows], weight[rows, None]], 1)
            images = images.index_copy_(0, position, values).view(*shape, 7).permute(2, 0, 1).contiguous()
            part, image_gradient = _of_view(images[:3], images[3:6], images[6:] / 3, window)
            total += part
            gradient[rows] = image_gradient.flatten(1).index_select(1, position).T
        ctx.save_for_backward(gradient)
        return total

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return gradients[0] * ctx.saved_tensors[0], None, None, None


def _of_view(
    x: Float[Tensor, "C H W"], t: Float[Tensor, "C H W"], weight: Float[Tensor, "1 H W"], window: Float[Tensor, "S"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "C H W"]]:
    """The weighted sum over pixels and channels of 1 - SSIM, and its gradient in x.

    With means m of x and n of t, SSIM = A B / (C D), A = 2 m n + c, B = 2 (E[x t] - m n) + c', C = m^2 + n^2 + c,
    D = E[x^2] - m^2 + E[t^2] - n^2 + c'.
    """
    m, n, xx, tt, xt = means(torch.cat([x, t, x * x, t * t, x * t]), window).chunk(5)
    mn, squares = m * n, m * m + n * n
    a = (2 * mn).add_(_MEANS_FLOOR)
    b = xt.sub(mn).mul_(2).add_(_VARIANCES_FLOOR)
    c, d = squares + _MEANS_FLOOR, xx.add(tt).sub_(squares).add_(_VARIANCES_FLOOR)
    scale = weight / (c * d)
    ssim = a * b * scale  # weighted
    by_mean = ((b - a) * n * scale).add_(m * ssim * (1 / d - 1 / c)).mul_(-2)
    by_square, by_product = ssim / d, (a * scale).mul_(-2)
    back_mean, back_square, back_product = means(torch.cat([by_mean, by_square, by_product]), window).chunk(3)
    gradient = back_mean.add(x * back_square, alpha=2).add_(t * back_product)
    return len(x) * weight.sum() - ssim.sum(), gradient


def means(images: Float[Tensor, "D H W"], window: Float[Tensor, "S"]) -> Float[Tensor, "D H W"]:
    """Return a symmetric filter across, then down, of some images; on the CPU OpenCV's, in a third of the time.

    Args:
        images: one by one; black outside.
        window: an odd number of weights.
    """
    if images.device.type == "cpu":
        filtered, kernel = torch.empty_like(images), window.numpy()
        for image, mean in zip(images.numpy(), filtered.numpy(), strict=True):
            cv2.sepFilter2D(image, -1, kernel, kernel, dst=mean, borderType=cv2.BORDER_CONSTANT)
        return filtered
    return means_by_convolution(images, window)


def means_by_convolution(images: Float[Tensor, "D H W"], window: Float[Tensor, "S"]) -> Float[Tensor, "D H W"]:
    """Return what `means` does, on any device."""
    radius = len(window) // 2
    across, down = window.view(1, 1, 1, -1), window.view(1, 1, -1, 1)
    return conv2d(conv2d(images[:, None], across, padding=(0, radius)), down, padding=(radius, 0))[:, 0]
