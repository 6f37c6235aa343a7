"""Penalties that need no mesh; those of smoothness are tested beside the large steps (tests/geometry)."""

import pytest
import torch

from registration.losses.geometry import l2, laplacian, prior


def test_l2_is_a_mean_over_vertices():
    assert l2(torch.tensor([[3.0, 4, 0], [0, 0, 0]])).item() == pytest.approx(12.5)


def test_laplacian_of_a_chain():
    operator = torch.tensor([[1.0, -1, 0], [-0.5, 1, -0.5], [0, -1, 1]])
    assert laplacian(torch.tensor([[0.0, 0, 0], [0, 2, 0], [0, 4, 0]]), operator).item() == pytest.approx(8 / 3)


def test_prior():
    coefficients = torch.tensor([1.0, -2.0, 0.0], requires_grad=True)
    value = prior(coefficients)
    assert value.item() == pytest.approx(5 / 3)
    value.backward()
    torch.testing.assert_close(coefficients.grad, torch.tensor([2 / 3, -4 / 3, 0.0]))
    assert prior(torch.zeros(0)).item() == 0
