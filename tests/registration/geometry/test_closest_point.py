"""Exactness against brute force written another way, known distances, and shapes that break shortcuts."""

import numpy as np
import pytest
import torch
import trimesh

from registration.geometry import contacts
from registration.geometry.closest_point import ClosestPointQuery, barycentric_points, closest_points, on_triangles


def ericson(p, a, b, c):
    """Closest point of one triangle by Voronoi regions (Real-Time Collision Detection, 5.1.5), scalar."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    if d1 <= 0 and d2 <= 0:
        return a
    bp = p - b
    d3, d4 = ab @ bp, ac @ bp
    if d3 >= 0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return a + d1 / (d1 - d3) * ab
    cp = p - c
    d5, d6 = ab @ cp, ac @ cp
    if d6 >= 0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return a + d2 / (d2 - d6) * ac
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        return b + (d4 - d3) / (d4 - d3 + d5 - d6) * (c - b)
    return a + (vb * ab + vc * ac) / (va + vb + vc)


def brute_force(points, vertices, triangles):
    return np.array([min(np.linalg.norm(p - ericson(p, *vertices[t])) for t in triangles) for p in points])


def check_against_brute_force(points, vertices, triangles):
    distance, face, barycentric = closest_points(points, vertices, triangles)
    np.testing.assert_allclose(distance, brute_force(points, vertices, triangles), rtol=0, atol=1e-12)
    on_surface = barycentric_points(vertices, triangles, face, barycentric)
    np.testing.assert_allclose(np.linalg.norm(points - on_surface, axis=1), distance, rtol=0, atol=1e-12)
    assert (barycentric >= 0).all()
    np.testing.assert_allclose(barycentric.sum(1), 1, atol=1e-12)


def soup(rng, count, size):
    """Unconnected random triangles of about this size in the unit cube."""
    return (rng.random((count, 1, 3)) + rng.normal(size=(count, 3, 3)) * size).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(5))
def test_equals_brute_force(seed):
    rng = np.random.default_rng(seed)
    vertices = np.concatenate([soup(rng, 120, 0.02), soup(rng, 20, 0.2), soup(rng, 2, 3.0)])
    check_against_brute_force(rng.random((60, 3)) * 2 - 0.5, vertices, np.arange(len(vertices)).reshape(-1, 3))


def test_a_prepared_query_equals_single_queries():
    rng = np.random.default_rng(0)
    vertices, triangles = soup(rng, 100, 0.1), np.arange(300).reshape(-1, 3)
    points = rng.random((40, 3))
    query = ClosestPointQuery(vertices, triangles)
    for _ in range(2):
        for a, b in zip(query.closest(points), closest_points(points, vertices, triangles), strict=True):
            np.testing.assert_array_equal(a, b)


def test_distances_alone_are_those_of_the_closest_points():
    rng = np.random.default_rng(4)
    vertices = np.concatenate([soup(rng, 100, 0.1), [[0.2, 0.2, 0.2], [0.6, 0.6, 0.6], [0.4, 0.4, 0.4 + 1e-9]]])
    query = ClosestPointQuery(vertices, np.arange(303).reshape(-1, 3))
    points = np.concatenate([rng.random((40, 3)), vertices[:5], [[50.0, 0, 0]]])
    np.testing.assert_allclose(query.distance(points), query.closest(points)[0], atol=2e-8)
    with pytest.raises(ValueError, match="finite"):
        query.distance(np.full((1, 3), np.nan))


def test_vertices_that_no_triangle_uses_are_ignored():
    vertices = np.concatenate([np.eye(3), [[np.nan] * 3, [0, 0, 0]]])
    assert closest_points(np.zeros((1, 3)), vertices, np.array([[0, 1, 2]]))[0] == pytest.approx(1 / np.sqrt(3))


def test_plane_at_a_known_distance():
    side = np.linspace(0, 1, 11)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(121)], 1)
    quads = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    triangles = np.concatenate([quads[:, None] + [0, 1, 11], quads[:, None] + [1, 12, 11]])
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.random((500, 2)), np.full(500, 0.003)])
    distance, face, barycentric = closest_points(points, vertices, triangles)
    np.testing.assert_allclose(distance, 0.003, atol=1e-15)
    feet = barycentric_points(vertices, triangles, face, barycentric)
    np.testing.assert_allclose(feet, points * [1, 1, 0], atol=1e-14)


@pytest.mark.parametrize("offset", [-0.02, 0.001, 0.5])
def test_sphere_at_a_known_distance(offset):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(400, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * (0.1 + offset)
    distance, _, _ = closest_points(points, ball.vertices, ball.faces)
    sagitta = 0.1 - 0.1 * np.cos(ball.edges_unique_length.max() / 0.1 / 2)
    assert np.abs(distance - abs(offset)).max() < 2 * sagitta < 4e-4


def test_degenerate_triangles_are_segments_and_points():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5], [0, 1e-9, 0]])
    triangles = np.array([[0, 1, 2], [0, 0, 1], [3, 3, 3], [0, 2, 4]])
    points = np.array([[0.5, 0.3, 0], [1.5, 0, -0.4], [5, 5, 6], [-1, 0, 0], [3, 4, 0]])
    distance, face, barycentric = closest_points(points, vertices, triangles)
    np.testing.assert_allclose(distance, [0.3, 0.4, 1, 1, np.hypot(1, 4)], atol=2e-9)
    assert np.isfinite(barycentric).all() and face[2] == 2
    coincident = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]])
    needle = closest_points(np.ones((1, 3)), coincident, np.array([[0, 1, 2], [3, 3, 3]]))[0]
    np.testing.assert_allclose(needle, np.sqrt(1.5))
    only_points = closest_points(points, vertices, np.array([[3, 3, 3]]))[0]
    np.testing.assert_allclose(only_points, np.linalg.norm(points - 5, axis=1), atol=1e-12)


def test_slivers():
    rng = np.random.default_rng(3)
    a, b = rng.random((2, 80, 3))
    thin = np.stack([a, b, a + rng.random((80, 1)) * (b - a) + rng.normal(size=(80, 3)) * 1e-9], 1).reshape(-1, 3)
    points = rng.random((30, 3))
    triangles = np.arange(240).reshape(-1, 3)
    pairs = list(zip(a, b, strict=True))
    segments = np.array([min(np.linalg.norm(p - on_segment(p, *pair)) for pair in pairs) for p in points])
    np.testing.assert_allclose(closest_points(points, thin, triangles)[0], segments, atol=1e-8)


def on_segment(p, a, b):
    return a + np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1) * (b - a)


def test_far_points_and_the_centre_of_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    points = np.array([[0.0, 0, 0], [1e-4, 0, 0], [100, 0, 0], [-30, 40, 0]])
    check_against_brute_force(points, np.asarray(ball.vertices), np.asarray(ball.faces))


def test_one_triangle_and_no_points():
    vertices, triangles = np.eye(3), np.array([[0, 1, 2]])
    assert closest_points(np.zeros((1, 3)), vertices, triangles)[0] == pytest.approx(1 / np.sqrt(3))
    assert closest_points(np.zeros((0, 3)), vertices, triangles)[2].shape == (0, 3)


def test_refuses_what_has_no_answer():
    with pytest.raises(ValueError, match="without triangles"):
        closest_points(np.zeros((1, 3)), np.eye(3), np.zeros((0, 3), int))
    with pytest.raises(ValueError, match="finite"):
        closest_points(np.full((1, 3), np.nan), np.eye(3), np.array([[0, 1, 2]]))


def test_tensors_and_arrays_have_the_same_closest_points():
    """The fit computes them in PyTorch, without the special treatment of slivers."""
    rng = np.random.default_rng(7)
    corners, points = rng.normal(size=(4000, 3, 3)), 2 * rng.normal(size=(4000, 3))
    expected, barycentric = on_triangles(points, corners)
    a, b, c, p = (torch.from_numpy(x)[:, None] for x in (*corners.swapaxes(0, 1), points))
    weights = contacts._closest(b - a, c - a, p - a)[:, 0].numpy()
    np.testing.assert_allclose(weights, barycentric, atol=1e-9)
    feet = np.einsum("mk,mkc->mc", weights, corners)
    np.testing.assert_allclose(np.linalg.norm(points - feet, axis=1), expected, rtol=1e-12)
