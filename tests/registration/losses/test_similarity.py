"""Structural similarity at listed pixels, and its gradient, against the formula written out."""

import numpy as np
import pytest
import torch

from registration.losses import similarity
from registration.types import Camera, Pixels

HEIGHT, WIDTH = 23, 19


def camera() -> Camera:
    return Camera(width_px=WIDTH, height_px=HEIGHT, intrinsics=np.eye(3), T_cam_world=np.eye(4))


def smoothed(images: torch.Tensor) -> torch.Tensor:
    """Windows written out as a matrix for each axis; images (N, H, W, C)."""
    distances = (torch.arange(n).double()[:, None] - torch.arange(n) for n in (HEIGHT, WIDTH))
    rows, columns = (torch.exp(-0.5 * (d / 1.5).square()) * (d.abs() <= 5) for d in distances)
    total = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2).sum()
    return torch.einsum("ij,njkc,kl->nilc", rows / total, images, columns / total)


def written_out(ours: torch.Tensor, theirs: torch.Tensor, weight: torch.Tensor, pixels: Pixels) -> torch.Tensor:
    x, t = pixels.image(ours), pixels.image(theirs)
    m, n = smoothed(x), smoothed(t)
    xx, tt, xt = smoothed(x * x) - m * m, smoothed(t * t) - n * n, smoothed(x * t) - m * n
    ssim = (2 * m * n + 1e-4) * (2 * xt + 9e-4) / ((m * m + n * n + 1e-4) * (xx + tt + 9e-4))
    return ((1 - pixels.of_image(ssim).mean(-1)) * weight).sum()


@pytest.mark.parametrize("listed", ("all", "a disc", "none in the second view"))
def test_value_and_gradient_are_those_of_the_formula(listed: str) -> None:
    random = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mask = np.ones((3, HEIGHT, WIDTH), bool)
    if listed == "a disc":
        mask &= (y - 10) ** 2 + (x - 9) ** 2 < 70
    if listed == "none in the second view":
        mask[1] = False
    pixels = Pixels.from_mask([camera()] * 3, torch.from_numpy(mask))
    count = len(pixels.view)
    ours, theirs, weight = (torch.from_numpy(random.random((count, *shape))) for shape in ((3,), (3,), ()))
    weight[::3] = 0
    ours = (0.6 * ours + 0.4 * theirs).requires_grad_()
    value = similarity.dissimilarity(ours, theirs, weight, pixels)
    (gradient,) = torch.autograd.grad(2 * value, ours)
    expected = written_out(ours, theirs, weight, pixels)
    (expected_gradient,) = torch.autograd.grad(2 * expected, ours)
    assert value.item() == pytest.approx(expected.item(), rel=1e-10)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-8, atol=1e-10)


def test_filters_of_both_devices_agree() -> None:
    """On the CPU windows are OpenCV's, elsewhere convolutions."""
    images = torch.from_numpy(np.random.default_rng(0).random((4, HEIGHT, WIDTH), np.float32))
    window = torch.tensor([0.1, 0.2, 0.4, 0.2, 0.1])
    torch.testing.assert_close(similarity.means(images, window), similarity.means_by_convolution(images, window))
