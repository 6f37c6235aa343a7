"""Nearest planes of meshes and of clouds against those of a sphere, which are known."""

import numpy as np
import pytest
import trimesh

from registration.geometry.nearest_planes import CloudPlanes, MeshPlanes, NearestPlanes
from registration.geometry.surface_views import SurfaceViews
from tests.registration.geometry.test_surface_views import RADIUS, a_camera, a_sphere


def mesh(vertices: np.ndarray, triangles: np.ndarray) -> MeshPlanes:
    return MeshPlanes(SurfaceViews(vertices, triangles, [a_camera()]))


def cloud(vertices: np.ndarray, triangles: np.ndarray) -> CloudPlanes:
    return CloudPlanes(trimesh.Trimesh(vertices, triangles, process=False).sample(20_000, seed=1))


def queries(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Points within 3 mm of the sphere, and their directions."""
    rng = np.random.default_rng(3)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * (RADIUS + rng.uniform(-3e-3, 3e-3, (count, 1))), direction


@pytest.mark.parametrize("kind", [mesh, cloud])
def test_the_distance_from_a_sphere(kind) -> None:
    points, direction = queries()
    planes: NearestPlanes = kind(*a_sphere())
    found = planes.of(points)
    cosine = (found.normals * direction).sum(1)
    cosine = cosine if planes.oriented else np.abs(cosine)
    assert cosine.min() > np.cos(np.radians(4))
    assert found.trusted.mean() > 0.95
    distance = np.abs(((points - found.points) * found.normals).sum(1))
    exact = np.abs(np.linalg.norm(points, axis=1) - RADIUS)
    np.testing.assert_allclose(distance[found.trusted], exact[found.trusted], atol=2e-4)


@pytest.mark.parametrize("kind", [mesh, cloud])
def test_nothing_is_trusted_beyond_the_border(kind) -> None:
    vertices, triangles = a_sphere()
    half = triangles[vertices[triangles].mean(1)[:, 2] < 0]
    points, direction = queries()
    found = kind(vertices, half).of(points)
    assert not found.trusted[direction[:, 2] > 0.1].any()
    assert found.trusted[direction[:, 2] < -0.1].mean() > 0.95


def test_a_clump_of_points_is_no_plane() -> None:
    rng = np.random.default_rng(0)
    found = CloudPlanes(0.01 * rng.standard_normal((500, 3))).of(0.01 * rng.standard_normal((200, 3)))
    assert found.trusted.mean() < 0.5
