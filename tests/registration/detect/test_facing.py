import numpy as np
import pytest

from registration.detect.facing import facing, seen


@pytest.fixture
def sphere() -> np.ndarray:
    """478 points on the front half of a sphere, with those that `facing` takes the head's axes from."""
    k = np.arange(478) + 0.5
    z, angle = -k / 478, np.pi * (1 + 5**0.5) * k
    points = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    points[33], points[263], points[10], points[152] = [-0.6, 0, -0.8], [0.6, 0, -0.8], [0, -0.8, -0.6], [0, 0.8, -0.6]
    return points


@pytest.mark.parametrize("yaw", [0.0, 0.8, -0.5])
def test_the_cosine_of_a_sphere(sphere: np.ndarray, yaw: float) -> None:
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    turned = sphere @ rotation.T
    inner = np.flatnonzero(sphere[:468, 2] < -0.3)  # normals at the rim come from few triangles
    np.testing.assert_allclose(facing(turned)[inner], -turned[inner, 2], atol=0.12)
    np.testing.assert_allclose(facing(turned)[468:], np.cos(yaw), atol=1e-6)


def test_points_behind_the_contour_are_not_seen() -> None:
    assert (seen(np.array([-0.5, 0.02, 0.08, 0.9])) > 0.5).tolist() == [False, False, True, True]
