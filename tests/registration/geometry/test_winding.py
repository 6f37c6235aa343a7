"""Winding numbers against two exact formulas and known solid angles, to the accuracy that the module states."""

import numpy as np
import pytest
import trimesh

from registration.geometry.winding import Winding, closed
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared
from tests.registration.geometry.sausage import BEND, RADIUS, end, sausage

RNG = np.random.default_rng(5)
ACCURACY = 0.01
CUBE = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]]
)


def winding_numbers(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return Winding(vertices, triangles).numbers(points)


def ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def half_ball() -> tuple[np.ndarray, np.ndarray]:
    """The upper half of a fine unit ball, open below; its rim is a polygon on the unit circle at height 0."""
    mesh = trimesh.creation.uv_sphere(radius=1.0, count=[64, 128])
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return vertices, faces[vertices[faces][:, :, 2].mean(1) > 0]


def by_excess(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Winding numbers by spherical excess (L'Huilier), exact, one triangle after the other."""
    total = np.zeros(len(points))
    for triangle in triangles:
        a, b, c = (vertices[k] - points for k in triangle)
        ray = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b, c)]
        arcs = [2 * np.arcsin(np.clip(np.linalg.norm(ray[k] - ray[k - 1], axis=1) / 2, 0, 1)) for k in range(3)]
        s = sum(arcs) / 2
        product = np.prod([np.tan(s / 2), *(np.tan((s - arc) / 2) for arc in arcs)], axis=0)
        total += np.sign((a * np.cross(b, c)).sum(1)) * 4 * np.arctan(np.sqrt(np.maximum(product, 0)))
    return total / (4 * np.pi)


def by_ray(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Winding numbers of a closed mesh by signed crossings of one ray a point."""
    direction = np.array([0.3141, 0.2718, 0.9095])
    a, b, c = vertices[triangles].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    along = normal @ direction
    found = []
    for point in points:
        t = ((a - point) * normal).sum(1) / along
        hit = point + t[:, None] * direction
        inside = [np.sign((np.cross(q - p, hit - p) * normal).sum(1)) > 0 for p, q in ((a, b), (b, c), (c, a))]
        found.append(np.sign(along)[(t > 0) & np.all(inside, axis=0)].sum())
    return np.array(found)


def test_a_cube_is_one_inside_and_zero_outside():
    points = np.array([[0.5, 0.4, 0.6], [0.5, 0.4, 1.6], [-1e-6, 0.3, 0.4], [1e-6, 0.3, 0.4]])
    np.testing.assert_allclose(winding_numbers(points, CUBE, CUBE_FACES), [1, 0, 0, 1], atol=ACCURACY)
    np.testing.assert_allclose(winding_numbers(points[:2], CUBE, CUBE_FACES[:, ::-1]), [-1, 0], atol=ACCURACY)


def test_the_distance_to_the_origin_of_the_frame_does_not_matter():
    points = np.array([[0.5, 0.4, 0.6], [0.5, 0.4, 1.6], [-1e-5, 0.3, 0.4], [1e-5, 0.3, 0.4]])
    offset = np.array([5e3, -2e3, 1e3])
    np.testing.assert_allclose(winding_numbers(points + offset, CUBE + offset, CUBE_FACES), [1, 0, 0, 1], atol=ACCURACY)


def test_a_ball_is_inside_up_to_its_surface():
    vertices, faces = ball(3)
    centres = vertices[faces].mean(1)
    outwards = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    for off in (1e-6, 1e-3, 0.3):
        np.testing.assert_allclose(winding_numbers(centres - off * outwards, vertices, faces), 1, atol=ACCURACY)
        np.testing.assert_allclose(winding_numbers(centres + off * outwards, vertices, faces), 0, atol=ACCURACY)


def test_an_open_half_ball_has_the_share_of_its_solid_angle():
    vertices, faces = half_ball()
    height = np.array([0.0, 0.5, -0.5, -3.0])
    points = np.column_stack([np.zeros((4, 2)), height])
    disc = (1 - np.abs(height) / np.sqrt(height**2 + 1)) / 2  # what the missing lid covers, over 4 pi
    expected = np.where(height > 0, 1 - disc, disc)
    np.testing.assert_allclose(winding_numbers(points, vertices, faces), expected, atol=ACCURACY)
    np.testing.assert_allclose(winding_numbers(np.array([[0, 0, 3.0]]), vertices, faces), -0.02566, atol=ACCURACY)


def test_two_lobes_that_overlap_count_twice():
    beyond = np.pi + 0.4
    vertices, faces, _ = sausage(beyond)
    free = BEND * np.array([np.cos(2.0), np.sin(2.0), 0])
    points = np.array([[-BEND, 0, 0], end(beyond, -1), end(beyond, 1), free, [0, 0, 0], [-BEND, 0, 1.05 * RADIUS]])
    np.testing.assert_allclose(winding_numbers(points, vertices, faces), [2, 2, 2, 1, 0, 0], atol=ACCURACY)
    apart, _, _ = sausage(np.pi - 0.5)
    assert abs(winding_numbers(points[:1], apart, faces)[0]) < ACCURACY


def test_open_surfaces_and_edges_shared_by_many_faces():
    """A soup of crossing triangles of any orientation."""
    vertices = RNG.standard_normal((60, 3))
    soup = np.array([RNG.choice(60, 3, replace=False) for _ in range(700)])
    points = np.concatenate([RNG.standard_normal((40, 3)), 5 * RNG.standard_normal((20, 3))])
    expected = by_excess(points, vertices, soup)
    np.testing.assert_allclose(winding_numbers(points, vertices, soup), expected, atol=ACCURACY)


def test_openings_are_closed_outwards_one_by_one():
    """A tube: two rims of radius 1, so that the tips stand half a radius beyond them."""
    turn = np.arange(96) * 2 * np.pi / 96
    low = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(96)])
    vertices, k = np.concatenate([low, low + [0, 0, 2.0]]), np.arange(96)
    after = np.roll(k, -1)
    faces = np.concatenate([np.stack([k, after, after + 96], 1), np.stack([k, after + 96, k + 96], 1)])
    tube, all_faces = closed(vertices, faces)
    np.testing.assert_allclose(np.sort(tube[192:, 2]), [-0.5, 2.5], atol=1e-12)
    np.testing.assert_array_equal(all_faces[: len(faces)], faces)
    points = np.array([[0, 0, z] for z in (-0.51, -0.49, 1.0, 2.49, 2.51)])
    np.testing.assert_allclose(winding_numbers(points, tube, all_faces), [0, 1, 1, 1, 0], atol=ACCURACY)
    same, unchanged = closed(*ball(1))
    assert len(same) == 42 and len(unchanged) == 80


def test_nothing_winds_round_a_point_without_triangles_and_nan_is_refused():
    assert winding_numbers(CUBE, CUBE, CUBE_FACES[:0]).tolist() == [0] * 8
    with pytest.raises(ValueError, match="finite"):
        winding_numbers(np.full((1, 3), np.nan), CUBE, CUBE_FACES)
    with pytest.raises(ValueError, match="finite"):
        Winding(np.full((8, 3), np.inf), CUBE_FACES)


@needs_shared
def test_the_head_is_inside_where_rays_leave_it():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    skin, faces = closed(data.template_vertex_positions, regions.solids(data)["skin"])
    low, high = skin.min(0), skin.max(0)
    points = low + (high - low) * RNG.random((300, 3))
    rays = by_ray(points, skin, faces)
    assert 60 < (rays == 1).sum() < 240
    np.testing.assert_allclose(winding_numbers(points, skin, faces), rays, atol=ACCURACY)
