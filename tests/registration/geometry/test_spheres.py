import numpy as np
import pytest
import torch

from registration.geometry.spheres import fit_sphere, on_main_sphere


def cap(half_angle: float, radius: float, centre: tuple[float, ...], count: int = 60) -> torch.Tensor:
    """Points spread over a cap around +Z, float64."""
    k = torch.arange(count, dtype=torch.float64)
    z = 1 - (1 - np.cos(half_angle)) * (k + 0.5) / count
    turn = k * np.pi * (3 - 5**0.5)
    side = (1 - z * z).sqrt()
    return radius * torch.stack([side * turn.cos(), side * turn.sin(), z], 1) + torch.tensor(
        centre, dtype=torch.float64
    )


@pytest.mark.parametrize("half_angle", [0.5, 1.5, np.pi])
def test_a_cap_gives_its_sphere(half_angle):
    centre, radius = fit_sphere(cap(half_angle, 8.5, (31.0, 303.0, 106.0)))
    torch.testing.assert_close(centre, torch.tensor([31.0, 303.0, 106.0], dtype=torch.float64), atol=1e-8, rtol=0)
    assert float(radius) == pytest.approx(8.5, abs=1e-8)


def test_float32_comes_back_as_float32_and_is_exact_to_its_rounding():
    centre, radius = fit_sphere(cap(0.7, 7.6, (31.0, 303.0, 106.0)).float())
    assert centre.dtype == radius.dtype == torch.float32
    np.testing.assert_allclose([*centre.tolist(), float(radius)], [31, 303, 106, 7.6], atol=1e-3)


def test_gradients_of_centre_and_radius():
    noise = 0.05 * torch.randn(60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points = (cap(1.2, 8.5, (1.0, -2.0, 3.0)) + noise).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p: torch.cat([fit_sphere(p)[0], fit_sphere(p)[1][None]]), points)


def test_a_bulge_is_not_on_the_main_sphere():
    ball, cornea = cap(np.pi, 14.6, (0.0, 0.0, 0.0), 300), cap(0.7, 7.6, (0.0, 0.0, 8.5), 60)
    covered = ball[:, 2] > 13.3
    points = torch.cat([ball[~covered], cornea]).numpy()
    found = on_main_sphere(points)
    away = np.linalg.norm(points, axis=1) / 14.6 - 1
    np.testing.assert_array_equal(found, np.abs(away) < 0.01)
    assert found[: (~covered).sum()].all() and (~found).sum() > 40
