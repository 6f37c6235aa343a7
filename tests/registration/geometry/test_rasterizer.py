"""Rasterization and visibility against exact ray casting and against spheres, where the answer is a formula."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from registration.geometry import rasterizer
from registration.geometry.closest_point import barycentric_points
from registration.geometry.rasterizer import RayCaster, rasterize, visible
from registration.types import Camera


def a_camera(focal=200.0, width=60, height=50, distance=1.0):
    """On the world's -z axis, looking along +z, with an off-centre principal point."""
    pose = np.eye(4)
    pose[2, 3] = distance
    intrinsics = np.array([[focal, 0, 33.3], [0, focal * 1.1, 21.7], [0, 0, 1]])
    return Camera(width_px=width, height_px=height, intrinsics=intrinsics, T_cam_world=pose)


def hits(origin, direction, corners):
    """Depths (along an unnormalised ray) at which one ray meets each triangle; inf on a miss."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(all="ignore"):
        solution = np.linalg.solve(np.stack([ab, ac, np.broadcast_to(-direction, a.shape)], 2), (origin - a)[..., None])
    u, v, t = solution[..., 0].T
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)


def soup(rng, count=60, size=0.08):
    vertices = (rng.random((count, 1, 3)) * 0.3 - 0.15 + rng.normal(size=(count, 3, 3)) * size).reshape(-1, 3)
    return vertices, np.arange(3 * count).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(3))
def test_rasterize_equals_ray_casting(seed):
    vertices, triangles = soup(np.random.default_rng(seed))
    camera = a_camera()
    face, barycentric = rasterize(vertices, triangles, camera)
    for y in range(0, 50, 3):
        for x in range(0, 60, 3):
            direction = np.linalg.inv(camera.intrinsics) @ [x + 0.5, y + 0.5, 1]
            depths = hits(camera.centre, direction, vertices[triangles])
            assert face[y, x] == (depths.argmin() if np.isfinite(depths.min()) else -1)
    shown = face >= 0
    assert 0.2 < shown.mean() < 1
    points = barycentric_points(vertices, triangles, face[shown], barycentric[shown])
    rows, columns = np.nonzero(shown)
    np.testing.assert_allclose(camera.project(points)[0], np.stack([columns, rows], 1) + 0.5, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_visible_equals_ray_casting(seed):
    rng = np.random.default_rng(seed)
    vertices, triangles = soup(rng)
    points = rng.random((300, 3)) * 0.4 - 0.2
    camera = a_camera()
    corners, eye = vertices[triangles], camera.centre
    expected = [
        ((0 <= xy) & (xy <= (60, 50))).all() and not hits(eye, p - eye, corners).min() < 1
        for p, xy in zip(points, camera.project(points)[0], strict=True)
    ]
    got = visible(points, vertices, triangles, camera, tolerance=0.0)
    np.testing.assert_array_equal(got, expected)
    assert 0.05 < got.mean() < 0.5


def test_a_sphere_shows_the_side_that_faces_the_camera():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    camera = a_camera(focal=300)
    points = np.asarray(ball.vertices)
    towards = camera.centre - points
    facing = (points * towards).sum(1) / np.linalg.norm(points, axis=1) / np.linalg.norm(towards, axis=1)
    got = visible(points, points, np.asarray(ball.faces), camera)
    clear = np.abs(facing) > 0.1  # at the rim the polyhedron is not the sphere
    np.testing.assert_array_equal(got[clear], facing[clear] > 0)


def test_outside_the_image_and_behind_the_camera_is_unseen():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -2], [0, 0, -1]])
    nothing = np.zeros((0, 3), int)
    np.testing.assert_array_equal(visible(points, points, nothing, a_camera()), [True, False, False, False])


def test_tolerance_is_a_distance_along_the_ray():
    wall = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0]])
    points = np.array([[0, 0, 0.0004], [0, 0, 0.0006], [0.01, 0, 0.5], [0, 0, -0.5]])
    got = visible(points, wall, np.array([[0, 1, 2]]), a_camera(), tolerance=5e-4)
    np.testing.assert_array_equal(got, [True, False, False, True])


def test_batches_do_not_matter(monkeypatch):
    rng = np.random.default_rng(0)
    vertices, triangles = soup(rng, count=200)
    points = rng.random((300, 3)) * 0.4 - 0.2
    camera = a_camera()
    face, barycentric = rasterize(vertices, triangles, camera)
    seen = visible(points, vertices, triangles, camera)
    monkeypatch.setattr(rasterizer, "_BATCH", 50)
    np.testing.assert_array_equal(rasterize(vertices, triangles, camera)[0], face)
    np.testing.assert_array_equal(rasterize(vertices, triangles, camera)[1], barycentric)
    np.testing.assert_array_equal(visible(points, vertices, triangles, camera), seen)


def test_nothing_to_draw():
    face, barycentric = rasterize(np.zeros((3, 3)), np.array([[0, 1, 2]]), a_camera())
    assert (face == -1).all() and (barycentric == 0).all()


def test_the_distance_to_the_origin_of_the_frame_does_not_matter():
    """Single precision would not resolve the tolerance a kilometre away."""
    rng = np.random.default_rng(4)
    vertices, triangles = soup(rng)
    camera, offset = a_camera(), np.array([900.0, -500, 2000])
    pose = camera.T_cam_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ offset
    moved = replace(camera, T_cam_world=pose)
    near, far = RayCaster(vertices, triangles), RayCaster(vertices + offset, triangles)
    np.testing.assert_array_equal(far.rasterize(moved)[0], near.rasterize(camera)[0])
    np.testing.assert_allclose(far.rasterize(moved)[1], near.rasterize(camera)[1], atol=1e-6)
    np.testing.assert_array_equal(far.visible(vertices + offset, moved), near.visible(vertices, camera))


def test_no_gaps_between_the_faces_of_a_closed_surface():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.4)  # the camera is inside
    camera = a_camera(width=600, height=500, distance=0.05)
    assert (rasterize(np.asarray(ball.vertices), np.asarray(ball.faces), camera)[0] >= 0).all()


def test_subnormal_numbers_survive():
    """A ray caster makes its thread flush them to zero if nothing is done about it."""
    RayCaster(np.eye(3), np.array([[0, 1, 2]]))
    assert (np.full(4, 1e-310) * 0.5 > 0).all() and (torch.full((4,), 1e-40) * 0.5 > 0).all()
