"""Large steps against dense algebra and formulas, on a regular triangulation that closes on itself (no boundary)."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from registration.fit.optimizer import AdamUniformBlock, minimize
from registration.fit.recipes import Rate
from registration.geometry.large_steps import (
    LargeSteps,
    combinatorial_laplacian,
    normalised_laplacian,
    spacing,
    to_torch,
)

CPU = torch.device("cpu")
EDGE_M = 0.002


def lattice(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Equilateral triangles of unit edges: positions (V, 2) and triangles; opposite borders are one."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(columns), np.arange(rows)))

    def at(dx: int, dy: int) -> np.ndarray:
        return (x + dx) % columns + columns * ((y + dy) % rows)

    lower, upper = [at(0, 0), at(1, 0), at(0, 1)], [at(1, 0), at(1, 1), at(0, 1)]
    triangles = np.concatenate([np.stack(corners, 1) for corners in (lower, upper)])
    return np.stack([x + 0.5 * y, np.sqrt(0.75) * y], 1), triangles


def wave(columns: int, rows: int, turns: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A plane wave on the closed lattice, an eigenvector of every Laplacian, and its wave vector per edge length."""
    positions, _ = lattice(columns, rows)
    # Periods along (1, 0) and (1/2, sqrt 3/2), so these are multiples of the reciprocal lattice vectors.
    k = 2 * np.pi * np.linalg.solve([[1, 0], [0.5, np.sqrt(0.75)]], np.divide(turns, (columns, rows)))
    return np.cos(positions @ k), k


def eigenvalue(k: np.ndarray) -> float:
    """Of the combinatorial Laplacian: sum over the six neighbours of 1 - cos(k . step)."""
    steps = np.array([[1, 0], [0.5, np.sqrt(0.75)], [-0.5, np.sqrt(0.75)]])
    return float(2 * (1 - np.cos(steps @ k)).sum())


def make(columns: int, rows: int, smoothing_m: float) -> LargeSteps:
    _, triangles = lattice(columns, rows)
    return LargeSteps(triangles, columns * rows, edge_length_m=EDGE_M, smoothing_m=smoothing_m, device=CPU)


def test_laplacians_by_hand():
    """Two triangles on a square and a vertex that belongs to none."""
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    expected = np.array([[3, -1, -1, -1, 0], [-1, 2, -1, 0, 0], [-1, -1, 3, -1, 0], [-1, 0, -1, 2, 0], [0] * 5])
    found = combinatorial_laplacian(triangles, 5).toarray()
    np.testing.assert_array_equal(found, expected)
    mean = normalised_laplacian(triangles, 5)
    np.testing.assert_allclose(mean.toarray(), expected / np.array([3, 2, 3, 2, 1])[:, None])
    points = np.random.default_rng(0).random((5, 3)).astype(np.float32)
    product = to_torch(mean, CPU) @ torch.tensor(points)
    np.testing.assert_allclose(product[1], points[1] - (points[0] + points[2]) / 2, atol=1e-6)


def random_case(seed: int = 0) -> tuple[LargeSteps, np.ndarray, np.ndarray]:
    """Large steps of an open mesh with lengths that vary a hundredfold, their matrix M, dense, and right-hand sides."""
    rng = np.random.default_rng(seed)
    points = rng.random((600, 2))
    triangles = Delaunay(points).simplices
    edge_m, smoothing_m = rng.uniform(0.001, 0.01, 600), rng.uniform(0.001, 0.1, 600)
    steps = LargeSteps(triangles, 600, edge_length_m=edge_m, smoothing_m=smoothing_m, device=CPU)
    dense = np.eye(600) + combinatorial_laplacian(triangles, 600, (smoothing_m / edge_m) ** 2 / 1.5).toarray()
    return steps, dense, rng.standard_normal((600, 3))


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-7), (torch.float64, 1e-13)])
def test_solutions_and_gradients_against_a_dense_solve(dtype, tolerance):
    """Exact to the rounding of the tensors' own type, because the solve itself is in double precision."""
    steps, dense, numbers = random_case()
    right = torch.tensor(numbers.T.copy(), dtype=dtype).T.requires_grad_()  # not contiguous
    weight = torch.tensor(numbers[::-1].copy(), dtype=dtype)
    solution = steps.displacement(right)
    (solution * weight).sum().backward()
    assert solution.dtype == right.grad.dtype == dtype
    for result, given in ((solution, right), (right.grad, weight)):
        expected = np.linalg.solve(dense, given.detach().double().numpy())
        assert np.abs(result.detach().double().numpy() - expected).max() < tolerance * np.abs(expected).max()


def test_every_factor_gives_the_same_bits():
    numbers = torch.tensor(random_case()[2], dtype=torch.float32)
    first, second = (random_case()[0].displacement(numbers) for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.cuda
def test_tensors_on_a_gpu_are_solved_as_on_the_cpu():
    _, triangles = lattice(20, 24)
    lengths = {"edge_length_m": EDGE_M, "smoothing_m": 0.008}
    latent = torch.randn(480, 3, generator=torch.Generator().manual_seed(0))
    results = []
    for device in (CPU, torch.device("cuda")):
        steps = LargeSteps(triangles, 480, device=device, **lengths)
        right = latent.to(device).requires_grad_()
        solution = steps.displacement(right)
        assert solution.device.type == device.type
        solution.square().sum().backward()
        results.append((solution.detach().cpu(), right.grad.cpu()))
    torch.testing.assert_close(results[1], results[0])


@pytest.mark.parametrize("smoothing_mm", [3.0, 8.0, 20.0])
@pytest.mark.parametrize("turns", [(1, 0), (0, 1), (1, 1)])
def test_smoothing_length_is_what_was_asked_for(smoothing_mm, turns):
    """A wave of wave number k comes out 1 / (1 + l^2 k^2) as strong."""
    steps = make(48, 48, smoothing_mm * 1e-3)
    field, k = wave(48, 48, turns)
    smooth = steps.displacement(torch.tensor(np.outer(field, [1, 0, 0]), dtype=torch.float32))[:, 0].double().numpy()
    gain = smooth @ field / (field @ field)
    assert np.abs(smooth - gain * field).max() < 1e-4 * gain
    length_mm = np.sqrt(1 / gain - 1) / (np.linalg.norm(k) / EDGE_M) * 1e3
    assert length_mm == pytest.approx(smoothing_mm, rel=0.02)


def test_latent_and_displacement_are_inverse():
    steps = make(20, 24, 0.008)
    displacement = torch.randn(480, 3, generator=torch.Generator().manual_seed(0)) * 1e-3
    torch.testing.assert_close(steps.displacement(steps.latent(displacement)), displacement, atol=1e-7, rtol=1e-4)


def test_the_adjoint_against_finite_differences():
    """In a loss that is not linear; double precision differences of a dense twin."""
    steps = make(12, 12, 0.008)
    _, triangles = lattice(12, 12)
    strength = (0.008 / EDGE_M) ** 2 / 1.5
    matrix = np.eye(144) + strength * combinatorial_laplacian(triangles, 144).toarray()
    rng = np.random.default_rng(0)
    latent, direction, weight = (rng.standard_normal((144, 3)) for _ in range(3))

    def loss(u):
        return (weight * np.linalg.solve(matrix, u) ** 3).sum()

    attached = torch.tensor(latent, dtype=torch.float32, requires_grad=True)
    (torch.tensor(weight, dtype=torch.float32) * steps.displacement(attached) ** 3).sum().backward()
    difference = (loss(latent + 1e-5 * direction) - loss(latent - 1e-5 * direction)) / 2e-5
    assert (attached.grad.double().numpy() * direction).sum() == pytest.approx(difference, rel=1e-3)


def test_a_known_displacement_is_recovered_from_a_third_of_the_vertices():
    """3 mm high waves of 15 mm, seen at 30% of the vertices, a millimetre apart; the others follow by smoothness."""
    columns, rows, edge_m = 69, 60, 0.001
    _, triangles = lattice(columns, rows)
    field, k = wave(columns, rows, (4, 0))
    assert 2 * np.pi / np.linalg.norm(k) * edge_m == pytest.approx(0.015, rel=0.01)
    target = torch.tensor(np.outer(0.003 * field, [0, 0, 1]), dtype=torch.float32)
    seen = torch.as_tensor(np.random.default_rng(0).permutation(len(field))[: int(0.3 * len(field))])
    found = torch.zeros_like(target)
    for smoothing_m, start, end, count in ((0.008, 4e-2, 1e-3, 150), (0.003, 4e-3, 1e-5, 150)):
        steps = LargeSteps(triangles, len(field), edge_length_m=edge_m, smoothing_m=smoothing_m, device=CPU)
        latent = steps.latent(found).requires_grad_()

        def loss(step, steps=steps, latent=latent):
            return {"seen": (steps.displacement(latent)[seen] - target[seen]).square().sum(-1).mean() * 1e6}

        _, failure = minimize([AdamUniformBlock(latent, Rate(start=start, end=end))], loss, count)
        assert failure is None
        found = steps.displacement(latent).detach()
    rms_mm = float((found - target).square().sum(-1).mean().sqrt()) * 1e3
    assert rms_mm < 0.05


def test_lengths_may_vary_over_the_mesh():
    """Edges twice as long and lengths that change half way: either half smooths as it was asked to."""
    columns, rows = 192, 48
    _, triangles = lattice(columns, rows)
    field, k = wave(columns, rows, (8, 0))
    column = np.arange(columns * rows) % columns
    asked = np.where(column < columns // 2, 0.004, 0.012)
    steps = LargeSteps(
        triangles,
        columns * rows,
        edge_length_m=np.full(columns * rows, EDGE_M),
        smoothing_m=asked,
        device=CPU,
    )
    smooth = steps.displacement(torch.tensor(np.outer(field, [1, 0, 0]), dtype=torch.float32))[:, 0].double().numpy()
    for inside, length_m in (((column > 24) & (column < 72), 0.004), ((column > 120) & (column < 168), 0.012)):
        gain = smooth[inside] @ field[inside] / (field[inside] @ field[inside])
        assert np.sqrt(1 / gain - 1) / (np.linalg.norm(k) / EDGE_M) == pytest.approx(length_m, rel=0.1)


def test_spacing_is_the_mean_length_of_a_vertex_edges():
    points = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0], [9, 9, 9.0]])
    np.testing.assert_allclose(spacing(np.array([[0, 1, 2]]), points), [3.5, 4, 4.5, 4])


def test_no_warning_reaches_the_terminal():
    code = (
        "import numpy as np, torch; from registration.geometry.large_steps import LargeSteps;"
        "s = LargeSteps(np.array([[0, 1, 2]]), 3, edge_length_m=1.0, smoothing_m=1.0, device=torch.device('cpu'));"
        "u = torch.ones(3, 3, requires_grad=True); s.latent(s.displacement(u)).sum().backward();"
        "assert u.grad is not None"
    )
    done = subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr
