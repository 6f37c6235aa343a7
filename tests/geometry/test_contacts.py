"""Depths behind surfaces on solids of known shape; lengths have no unit here."""

import numpy as np
import pytest
import torch
import trimesh

from registration.geometry.closest_point import closest_points
from registration.geometry.contacts import Depths, Solids, Watched, Ways, depths
from tests.losses.crossing import winding


class Scene:
    """Some solids and points in one mesh."""

    def __init__(self, points: np.ndarray, *solids: trimesh.Trimesh):
        first = len(points)
        self.parts = []
        for solid in solids:
            self.parts.append(np.asarray(solid.faces, np.int64) + first)
            first += len(solid.vertices)
        self.points = np.arange(len(points))
        self.vertices = np.concatenate([points, *(solid.vertices for solid in solids)])

    def look(self, inside: float = 20.0, outside: float = 20.0) -> tuple[Watched, Depths]:
        watched = Solids(self.points, self.parts, inside=inside, outside=outside).watched(self.vertices)
        return watched, depths(torch.as_tensor(self.vertices), watched)

    def depth(self) -> np.ndarray:
        """Of each point in the part that it is deepest in; nan where nothing is watched."""
        watched, found = self.look()
        depth = np.full(len(self.points), np.nan)
        for place, value in zip(watched.place.tolist(), found.depth.tolist(), strict=True):
            depth[place] = np.fmax(depth[place], value)
        return depth


def box(low: float, high: float, subdivisions: int = 2) -> trimesh.Trimesh:
    """A box from x = low to high, 10 wide, its centre on the x axis; each subdivision cuts every edge in two."""
    solid = trimesh.creation.box((high - low, 10, 10)).apply_translation(((low + high) / 2, 0, 0))
    for _ in range(subdivisions):
        solid = solid.subdivide()
    return solid


def blob() -> trimesh.Trimesh:
    """A ball with hills and hollows: no convex body."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    x, y, z = ball.vertices.T
    ball.vertices *= (10 + 2 * np.sin(4 * x + 1) * np.cos(3 * y) + np.sin(5 * z))[:, None]
    return ball


def around(radii: np.ndarray, seed: int) -> np.ndarray:
    """Points at these distances from the origin."""
    directions = np.random.default_rng(seed).normal(size=(len(radii), 3))
    return directions / np.linalg.norm(directions, axis=1)[:, None] * radii[:, None]


def test_depth_in_a_box_is_the_distance_to_its_nearest_side():
    points = np.array([[0.5, 0, 0], [9, 1, 0], [5, -4.8, 2], [4, 0, 4.4], [-0.3, 1, 1], [5, 5.7, 0], [-0.3, -5.4, 0]])
    found = Scene(points, box(0, 10)).depth()
    np.testing.assert_allclose(found, [0.5, 1, 0.2, 0.6, -0.3, -0.7, -0.5], atol=1e-12)


def test_depth_in_a_blob_is_exact_in_hollows_too():
    solid, points = blob(), around(np.linspace(6, 14, 400), 0)
    scene = Scene(points, solid)
    distance, _, _ = closest_points(points, solid.vertices, solid.faces)
    inside = winding(points, solid.vertices[solid.faces]) > 0.5
    hull = solid.convex_hull
    into_hull = -(points @ hull.face_normals.T - (hull.triangles[:, 0] * hull.face_normals).sum(1)).max(1)
    assert 100 < inside.sum() < 300 and (into_hull - distance)[inside].max() > 1
    np.testing.assert_allclose(scene.depth(), np.where(inside, distance, -distance), atol=1e-9)


def test_over_a_sharp_tip_the_side_that_looks_at_a_point_decides():
    base = [[2, 2, 0], [-2, 2, 0], [-2, -2, 0], [2, -2, 0]]
    vertices = torch.tensor([[1.0, 0.0, 10.6], [0.0, 0.0, 10.0], *base], dtype=torch.float64)
    sides = torch.tensor([[1, 2, 3], [1, 3, 4], [1, 4, 5], [1, 5, 2]])
    for order in ((0, 1, 2, 3), (1, 2, 3, 0), (2, 3, 0, 1), (3, 0, 1, 2)):
        triangles = sides[list(order)][None]
        zero = torch.zeros(1, dtype=torch.int64)
        watched = Watched(
            place=zero, points=zero, triangles=triangles, rim=torch.zeros(triangles.shape, dtype=torch.bool)
        )
        found = depths(vertices, watched)
        assert found.depth.item() == pytest.approx(-np.hypot(1, 0.6))
        np.testing.assert_allclose(found.direction[0], np.array([1, 0, 0.6]) / np.hypot(1, 0.6))


def test_gradient_reaches_both_sides():
    points = around(np.linspace(7, 10, 60), 1)
    scene = Scene(points, blob())
    watched, found = scene.look()
    deep = (found.depth > 0).nonzero()[:, 0]
    assert len(deep) > 30
    vertices = torch.as_tensor(scene.vertices).requires_grad_(True)
    torch.testing.assert_close(found.again(vertices, watched.points, deep), found.depth[deep])
    (gradient,) = torch.autograd.grad(found.again(vertices, watched.points, deep).square().sum(), vertices)
    generator = torch.Generator().manual_seed(2)
    for side in (slice(0, len(points)), slice(len(points), None), slice(None)):
        along = torch.zeros_like(vertices)
        along[side] = torch.randn(along[side].shape, dtype=along.dtype, generator=generator)
        value = [
            depths(vertices.detach() + sign * 1e-5 * along, watched).depth[deep].square().sum() for sign in (1, -1)
        ]
        assert float((gradient * along).sum()) == pytest.approx(float(value[0] - value[1]) / 2e-5, rel=1e-4)


def test_nothing_is_past_the_border_of_an_open_part():
    solid = box(0, 10)
    solid.update_faces(~(solid.triangles_center[:, 0] > 10 - 1e-9))
    points = np.array([[10.4, 1, 1], [9.8, 4.9, 0.1], [9.8, 1, 0.5], [9.5, 4.4, 0.3]])
    np.testing.assert_allclose(Scene(points, solid).depth(), [np.nan, 0.1, 4.0, 0.6])


def test_a_touching_part_hides_nothing():
    points = np.array([[9.75, 0.3, 0.2], [9.9, 0.3, 0.2], [10.2, 0.3, 0.2]])
    scene = Scene(points, box(0, 10), box(9.8, 20))
    np.testing.assert_allclose(scene.depth(), [0.25, 0.1, 0.4], atol=1e-12)
    watched, _ = scene.look()
    assert watched.place.tolist() == [0, 1, 2, 0, 1, 2]


def test_only_what_is_near_is_watched():
    points = np.array([[-1.5, 0, 0], [-0.5, 0, 0], [0.5, 0, 0], [1.5, 0, 0]])
    watched, found = Scene(points, box(0, 10)).look(inside=1, outside=1)
    assert watched.place.tolist() == watched.points.tolist() == [1, 2]
    np.testing.assert_allclose(found.depth.numpy(), [-0.5, 0.5], atol=1e-12)
    assert len(Scene(points[:1], box(0, 10)).look(inside=1, outside=1)[0].place) == 0


def test_nothing_to_watch():
    for scene in (Scene(np.empty((0, 3)), box(0, 10)), Scene(np.zeros((2, 3)))):
        watched, found = scene.look()
        assert len(watched.place) == len(found.depth) == 0


def hairpin(length: int, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of flesh: a grid of unit steps that runs out, turns around an edge and comes back `gap` below.

    Upper rows are vertices 0 .. 5 * length - 1, row by row towards the turn; lower ones follow, away from it.
    """
    along = np.concatenate([np.arange(length), np.arange(length)[::-1]]).astype(float)
    height = np.repeat([gap, 0.0], length)
    vertices = np.stack([np.broadcast_to(c[:, None], (2 * length, 5)) for c in (along, height)], -1).reshape(-1, 2)
    vertices = np.column_stack([vertices, np.tile(np.arange(5.0), 2 * length)])
    corner = (5 * np.arange(2 * length - 1)[:, None] + np.arange(4)).ravel()
    a, b, c, d = corner, corner + 1, corner + 6, corner + 5
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_ways_run_along_the_surface():
    vertices, triangles = hairpin(10, gap=1.0)
    turn, start = 5 * 9 + 2, 5 * 5 + 2
    ways = Ways(np.array([start, turn]), triangles, vertices, limit=6.5)
    below = 5 * np.array([14, 12, 11, 10]) + 2  # the start, further towards the turn, and the turn itself
    assert [float(ways.least(np.array([0]), np.array([[end]]))[0]) for end in below] == [np.inf, np.inf, 6, 5]
    assert ways.least(np.array([1]), below[None]).tolist() == [1]
    np.testing.assert_allclose(ways.least(np.array([0, 1]), np.array([[start], [start]])), [0, 4])


def test_the_far_side_of_ones_own_flesh_is_no_contact():
    vertices, triangles = hairpin(10, gap=1.0)
    lower = triangles[(triangles >= 50).all(1)]
    points = np.arange(10) * 5 + 2  # of the upper side, inwards to the turn
    ways = Ways(points, triangles, vertices, limit=12.0)
    options = {"inside": 2.0, "outside": 2.0}
    plain = Solids(points, [lower], **options).watched(vertices)
    checked = Solids(points, [lower], **options, ways=ways).watched(vertices)
    assert plain.place.tolist() == list(range(1, 9))  # the ends lie over the border
    # From place k the way around the turn to what is straight below is 2 (9 - k) + 1 long, the depth is 1.
    assert checked.place.tolist() == list(range(1, 8))
