"""Normals of a surface as cameras see it: on spheres they are a formula; damaged parts must have no weight."""

import numpy as np
import pytest
import trimesh

from registration.geometry.surface_views import SurfaceViews
from registration.geometry.topology import boundary_vertices
from registration.types import Camera

RADIUS = 0.1


def a_camera(turn: float = 0.0, pixels: int = 160) -> Camera:
    """Half a metre from the origin, turned about y by some radians."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[2, 3] = 0.5
    intrinsics = np.array([[2.0 * pixels, 0, 0.48 * pixels], [0, 2.1 * pixels, 0.5 * pixels], [0, 0, 1]])
    return Camera(width_px=pixels, height_px=pixels, intrinsics=intrinsics, T_cam_world=pose)


def a_sphere(subdivisions: int = 5) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    return np.array(mesh.vertices), np.array(mesh.faces)


def points_of(view, camera: Camera) -> np.ndarray:
    """The world points at the pixels that show the surface."""
    row, column = np.nonzero(view.face >= 0)
    rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1) @ np.linalg.inv(camera.intrinsics).T
    local = rays * view.depth[row, column, None]
    return (local - camera.T_cam_world[:3, 3]) @ camera.T_cam_world[:3, :3]


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


@pytest.mark.parametrize("inwards", [False, True])
def test_a_sphere(inwards: bool):
    vertices, triangles = a_sphere()
    camera = a_camera(0.4)
    view = SurfaceViews(vertices, triangles[:, ::-1] if inwards else triangles, [camera]).view(camera)
    hit = view.face >= 0
    points = points_of(view, camera)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RADIUS, atol=5e-5)
    exact = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert angles_deg(view.normals[hit], exact).max() < 0.5
    cosine = ((camera.centre - points) / np.linalg.norm(camera.centre - points, axis=1, keepdims=True) * exact).sum(1)
    weight = view.weight[hit]
    assert (weight[cosine > 0.35] > 0).all() and not weight[cosine < 0.2].any()
    np.testing.assert_allclose(weight[weight > 0], cosine[weight > 0], atol=0.02)
    assert not view.weight[~hit].any() and np.isinf(view.depth[~hit]).all() and not view.normals[~hit].any()


def test_nothing_at_a_hole_and_nothing_of_the_inside_behind_it():
    vertices, triangles = a_sphere()
    camera = a_camera()
    whole = SurfaceViews(vertices, triangles, [camera]).view(camera)
    middle = vertices[triangles].mean(1)
    cut = triangles[np.linalg.norm(middle - [0, 0, -RADIUS], axis=1) > 0.02]
    assert 0 < boundary_vertices(cut, len(vertices)).sum() < 200
    view = SurfaceViews(vertices, cut, [a_camera(0.5), camera, a_camera(-0.5)]).view(camera)
    distance = np.full(whole.face.shape, np.inf)
    distance[whole.face >= 0] = np.linalg.norm(points_of(whole, camera) - [0, 0, -RADIUS], axis=1)
    assert (view.face[distance < 0.018] >= 0).all()  # the back of the sphere, from its inside
    assert not view.weight[distance < 0.021].any()
    away = distance > 0.028
    np.testing.assert_array_equal(view.weight[away], whole.weight[away])


def test_nothing_where_one_piece_hides_another():
    vertices, triangles = a_sphere()
    small = vertices * 0.3 + [0.01, 0, -0.13]  # floats before the sphere
    camera = a_camera()
    both = np.concatenate([vertices, small]), np.concatenate([triangles, triangles + len(vertices)])
    view = SurfaceViews(*both, [camera]).view(camera)
    front = view.face >= len(triangles)
    assert front.sum() > 300
    beside = np.zeros_like(front)
    beside[1:-1, 1:-1] = front[:-2, 1:-1] | front[2:, 1:-1] | front[1:-1, :-2] | front[1:-1, 2:]
    assert (beside & ~front).sum() > 50 and not view.weight[beside & ~front].any()
    assert view.weight[~front & ~beside].any()


def test_noise_is_averaged_along_the_surface():
    vertices, triangles = a_sphere(7)  # edges of 0.9 mm
    rng = np.random.default_rng(0)
    noisy = vertices * (1 + 5e-4 * rng.standard_normal((len(vertices), 1)))
    camera = a_camera()

    def median_error(smoothing_m: float) -> float:
        view = SurfaceViews(noisy, triangles, [camera], smoothing_m=smoothing_m).view(camera)
        exact = points_of(view, camera)
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        return float(np.median(angles_deg(view.normals[view.face >= 0], exact)))

    rough, smooth = median_error(0.0), median_error(2e-3)
    assert rough > 1 and smooth < rough / 3
