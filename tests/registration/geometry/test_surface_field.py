"""The expected field against the algebra of Gaussian fields, and what it does with outliers."""

import numpy as np
import pytest

from registration.geometry.surface_field import FieldPrior, expected_field
from tests.registration.losses.test_regularization import square

POINTS, TRIANGLES = square(40, 0.0, 0.2)  # edges of 5 mm
MIDDLE = int(np.square(POINTS[:, :2] - 0.1).sum(1).argmin())
PRIOR = FieldPrior(deviation_m=1e-3, range_m=0.06)


def field(vertices: list[int], values: list[list[float]], spread_m: float, prior: FieldPrior = PRIOR) -> np.ndarray:
    indices = np.repeat(np.array(vertices)[:, None], 3, 1)
    weights = np.tile([1.0, 0, 0], (len(vertices), 1))
    spread = np.full(len(vertices), spread_m)
    return expected_field(TRIANGLES, POINTS, indices, weights, np.array(values), spread, prior)


def test_an_exact_observation_is_reached_and_its_effect_ends_at_the_range():
    found = field([MIDDLE], [[1e-3, 0, -5e-4]], 1e-6)
    assert found[MIDDLE] == pytest.approx([1e-3, 0, -5e-4], rel=0.01)
    distance = np.linalg.norm(POINTS - POINTS[MIDDLE], axis=1)
    at_range = found[np.abs(distance - PRIOR.range_m) < 3e-3, 0] / 1e-3
    # Matern's correlation at its range, sqrt(8) K1(sqrt(8)); this lattice's Laplacian differs with the direction.
    assert at_range.mean() == pytest.approx(0.14, abs=0.04) and at_range.max() < 0.3
    assert np.abs(found[distance > 0.09, 0]).max() < 0.1e-3


def test_the_share_of_an_observation_is_that_of_its_variance():
    """The field has the stated deviation: an observation of the same spread counts a half."""
    assert field([MIDDLE], [[1e-3, 0, 0]], PRIOR.deviation_m)[MIDDLE, 0] == pytest.approx(0.5e-3, rel=0.15)
    less = FieldPrior(deviation_m=0.5e-3, range_m=PRIOR.range_m)
    assert field([MIDDLE], [[1e-3, 0, 0]], 1e-3, less)[MIDDLE, 0] == pytest.approx(0.2e-3, rel=0.15)


def test_what_contradicts_its_neighbours_hardly_counts():
    near = [MIDDLE + step for step in (-3, -2, -1, 1, 2, 3)]
    agreed = [[5e-4, 0, 0]] * len(near)
    assert field([*near, MIDDLE], [*agreed, [0.05, 0, 0]], 2e-4)[MIDDLE, 0] == pytest.approx(5e-4, rel=0.1)


def test_nothing_observed_is_no_field():
    nothing = np.zeros((0, 3))
    found = expected_field(TRIANGLES, POINTS, nothing.astype(np.int64), nothing, nothing, np.zeros(0), PRIOR)
    assert found.shape == POINTS.shape and not found.any()
