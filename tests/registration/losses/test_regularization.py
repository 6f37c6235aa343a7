"""Penalties on offsets do what their lengths say, measured on waves and on a pinned line."""

import numpy as np
import pytest
import torch

from registration.losses.regularization import OffsetRegularizer, gaussian_prior, regularization_weights
from tests.registration.geometry.test_large_steps import lattice, wave

EDGE_M = 0.0005


def elasticity(columns: int, rows: int, half_gain_m: float, decay_m: float = 0.025) -> OffsetRegularizer:
    points, triangles = lattice(columns, rows)
    # The lattice closes on itself, so its positions do not give its edge lengths: unfold one cell of it.
    count = columns * rows
    flat = OffsetRegularizer(
        triangles,
        np.concatenate([points, np.zeros((count, 1))], 1) * EDGE_M,
        half_gain_m=np.full(count, half_gain_m),
        decay_m=np.full(count, decay_m),
        device=torch.device("cpu"),
    )
    # Those of vertices whose edges do not wrap around, each of which has an equal share of the unfolded area.
    a = regularization_weights(np.array([half_gain_m]), np.array([decay_m]))[0][0]
    share = a / count / float(flat._l2.median())
    for values in (flat._l2, flat._membrane, flat._bending):
        values.fill_(values.median() * share)
    return flat


def gain_of(penalty: OffsetRegularizer, mode: torch.Tensor) -> float:
    """The fraction of `mode` that a fit to it keeps against the penalty: the minimum over its amplitude."""
    height = torch.tensor(0.0, dtype=torch.float32, requires_grad=True)
    rest = (height * mode - mode).square().sum(-1).mean() + sum(penalty(height * mode).values())
    (slope,) = torch.autograd.grad(rest, height, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, height)
    return -slope.item() / curvature.item()


@pytest.mark.parametrize("turns", [(2, 0), (0, 3), (3, 1), (5, 4)])
@pytest.mark.parametrize("half_gain_mm", [4.0, 12.0])
def test_gain_of_waves(turns, half_gain_mm):
    """Eigenmodes of 4 to 30 mm keep 1 / (1 + a + b q^2 + c q^4), within 5 %."""
    columns, rows = 60, 60
    field, k = wave(columns, rows, turns)
    mode = torch.tensor(np.outer(0.001 * field, [0.6, 0, 0.8]), dtype=torch.float32)
    a, b, c = (float(s[0]) for s in regularization_weights(np.array([half_gain_mm * 1e-3]), np.array([0.025])))
    q = np.linalg.norm(k) / EDGE_M
    gain = gain_of(elasticity(columns, rows, half_gain_mm * 1e-3), mode)
    assert gain == pytest.approx(1 / (1 + a + b * q**2 + c * q**4), rel=0.05)


def test_half_of_a_wave_of_the_half_gain_length_is_kept():
    field, k = wave(60, 60, (3, 0))
    length_m = 2 * np.pi / np.linalg.norm(k) * EDGE_M
    mode = torch.tensor(np.outer(0.001 * field, [0, 0, 1]), dtype=torch.float32)
    assert gain_of(elasticity(60, 60, length_m), mode) == pytest.approx(0.5, abs=0.02)


def test_an_offset_without_data_decays_over_the_decay_length():
    """One column of a long strip is held 1 mm up: the others sink by a factor e every 25 mm."""
    columns, rows, edge_m = 120, 6, 0.002
    points, triangles = lattice(columns, rows)
    count = columns * rows
    flat = np.concatenate([points, np.zeros((count, 1))], 1) * edge_m
    penalty = OffsetRegularizer(
        triangles,
        flat,
        half_gain_m=np.full(count, 0.004),
        decay_m=np.full(count, 0.025),
        device=torch.device("cpu"),
    )
    for values in (penalty._l2, penalty._membrane, penalty._bending):
        values.fill_(values.median())
    column = torch.arange(count) % columns
    height = torch.zeros(count, 3, dtype=torch.float64)
    free = (column > 0).nonzero()[:, 0]
    penalty._l2, penalty._membrane, penalty._bending = (
        v.double() for v in (penalty._l2, penalty._membrane, penalty._bending)
    )
    penalty._laplacian = penalty._laplacian.double()

    def energy(lifted: torch.Tensor) -> torch.Tensor:
        offsets = height.index_copy(0, free, lifted[:, None] * torch.tensor([0.0, 0, 1], dtype=torch.float64))
        offsets = offsets + 0.001 * (column == 0)[:, None] * torch.tensor([0.0, 0, 1], dtype=torch.float64)
        return 1e12 * sum(penalty(offsets).values())

    unknown = torch.zeros(len(free), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([unknown], max_iter=2000, tolerance_grad=1e-14, tolerance_change=1e-18)
    optimizer.zero_grad()

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = energy(unknown)
        value.backward()
        return value

    optimizer.step(closure)
    lifted = unknown.detach()
    near, far = (lifted[column[free] == distance].mean().item() for distance in (5, 15))
    apart = 10 * np.sqrt(0.75) * edge_m  # columns lean, so they are nearer to each other than an edge is long
    assert apart / np.log(near / far) == pytest.approx(0.025, rel=0.03)


def test_stiffness_depends_on_the_wavelength_at_each_vertex():
    """The same bump costs more where the half-gain wavelength is longer."""
    points, triangles = lattice(40, 40)
    count = 1600
    half = np.where(np.arange(count) % 40 < 20, 0.004, 0.008)
    penalty = OffsetRegularizer(
        triangles,
        np.concatenate([points, np.zeros((count, 1))], 1) * EDGE_M,
        half_gain_m=half,
        decay_m=np.full(count, 0.025),
        device=torch.device("cpu"),
    )
    costs = []
    for vertex in (20 * 40 + 10, 20 * 40 + 30):
        bump = torch.zeros(count, 3)
        bump[vertex, 2] = 0.001
        costs.append(float(penalty(bump)["offset laplacian"]))
    assert costs[1] == pytest.approx(16 * costs[0], rel=1e-3)


def square(cells: int, left_m: float, size_m: float = 0.04) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, 3) of a square in the plane z = 0 and its triangles."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(cells + 1), np.arange(cells + 1)))
    points = np.stack([left_m + x * size_m / cells, y * size_m / cells, np.zeros(len(x))], 1)
    corner = (x + (cells + 1) * y)[(x < cells) & (y < cells)]
    lower = np.stack([corner, corner + 1, corner + cells + 1], 1)
    upper = np.stack([corner + 1, corner + cells + 2, corner + cells + 1], 1)
    return points, np.concatenate([lower, upper])


def test_a_bump_costs_the_same_on_small_faces_as_on_large_ones():
    """One of two squares of one size has sixteen times as many vertices; its bump would cost more by vertices."""
    (coarse, coarse_faces), (fine, fine_faces) = square(20, 0.0), square(80, 0.1)
    points = np.concatenate([coarse, fine])
    penalty = OffsetRegularizer(
        np.concatenate([coarse_faces, fine_faces + len(coarse)]),
        points,
        half_gain_m=np.full(len(points), 0.01),
        decay_m=np.full(len(points), 0.025),
        device=torch.device("cpu"),
    )
    bump = np.exp(-np.square((points[:, :2] - [0.02, 0.02]) / 0.006).sum(1))  # of the coarse square
    bump += np.exp(-np.square((points[:, :2] - [0.12, 0.02]) / 0.006).sum(1))
    costs = []
    for chosen in (np.arange(len(points)) < len(coarse), np.arange(len(points)) >= len(coarse)):
        offsets = torch.tensor(np.outer(0.001 * bump * chosen, [0, 0, 1]), dtype=torch.float32)
        costs.append({name: float(cost) for name, cost in penalty(offsets).items()})
    for name in costs[0]:
        assert costs[1][name] == pytest.approx(costs[0][name], rel=0.2), name  # derivatives differ by the edge length


def test_gaussian_prior():
    coefficients = torch.tensor([1.0, -2.0, 0.0], requires_grad=True)
    value = gaussian_prior(coefficients)
    assert value.item() == pytest.approx(5)
    value.backward()
    torch.testing.assert_close(coefficients.grad, torch.tensor([2.0, -4.0, 0.0]))
    assert gaussian_prior(torch.zeros(0)).item() == 0


def test_the_prior_of_a_coefficient_does_not_depend_on_how_many_there_are():
    few, many = torch.zeros(54), torch.zeros(253)
    few[3] = many[3] = 2.0
    assert gaussian_prior(few).item() == gaussian_prior(many).item()
