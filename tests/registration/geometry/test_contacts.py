"""Depths behind surfaces on solids of known shape; lengths have no unit here."""

import numpy as np
import pytest
import torch
import trimesh

from bench.support.crossed_parts import winding
from registration.geometry.closest_point import closest_points
from registration.geometry.contacts import ContactCandidates, ContactSearch, Depths, Interior, depths


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

    def look(self, inside: float = 20.0, outside: float = 20.0) -> tuple[ContactCandidates, Depths]:
        search = ContactSearch(self.points, self.parts, inside=inside, outside=outside)
        candidates = search.candidates(self.vertices, np.zeros(len(self.points)))
        return candidates, depths(torch.as_tensor(self.vertices), candidates)

    def depth(self) -> np.ndarray:
        """Of each point in the part that it is deepest in; nan where nothing is candidates."""
        candidates, found = self.look()
        depth = np.full(len(self.points), np.nan)
        for place, value in zip(candidates.query.tolist(), found.depth.tolist(), strict=True):
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
        candidates = ContactCandidates(
            query=zero, points=zero, triangles=triangles, rim=torch.zeros(triangles.shape, dtype=torch.bool)
        )
        found = depths(vertices, candidates)
        assert found.depth.item() == pytest.approx(-np.hypot(1, 0.6))
        np.testing.assert_allclose(found.direction[0], np.array([1, 0, 0.6]) / np.hypot(1, 0.6))


def test_gradient_reaches_both_sides():
    points = around(np.linspace(7, 10, 60), 1)
    scene = Scene(points, blob())
    candidates, found = scene.look()
    deep = (found.depth > 0).nonzero()[:, 0]
    assert len(deep) > 30
    vertices = torch.as_tensor(scene.vertices).requires_grad_(True)
    torch.testing.assert_close(found.differentiable(vertices, candidates.points, deep), found.depth[deep])
    (gradient,) = torch.autograd.grad(found.differentiable(vertices, candidates.points, deep).square().sum(), vertices)
    generator = torch.Generator().manual_seed(2)
    for side in (slice(0, len(points)), slice(len(points), None), slice(None)):
        along = torch.zeros_like(vertices)
        along[side] = torch.randn(along[side].shape, dtype=along.dtype, generator=generator)
        value = [
            depths(vertices.detach() + sign * 1e-5 * along, candidates).depth[deep].square().sum() for sign in (1, -1)
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
    candidates, _ = scene.look()
    assert candidates.query.tolist() == [0, 1, 2, 0, 1, 2]


def test_only_what_is_near_is_watched():
    points = np.array([[-1.5, 0, 0], [-0.5, 0, 0], [0.5, 0, 0], [1.5, 0, 0]])
    candidates, found = Scene(points, box(0, 10)).look(inside=1, outside=1)
    assert candidates.query.tolist() == candidates.points.tolist() == [1, 2]
    np.testing.assert_allclose(found.depth.numpy(), [-0.5, 0.5], atol=1e-12)
    assert len(Scene(points[:1], box(0, 10)).look(inside=1, outside=1)[0].query) == 0
    fine = Scene(np.array([[4.0, 0.2, 0.1]]), box(0, 10, subdivisions=4))
    assert [len(fine.look(inside, outside=1)[0].query) for inside in (3, 8)] == [0, 1]


def test_a_vertex_that_left_what_it_watched_is_nowhere():
    scene = Scene(np.array([[0.1, -2, -2], [0.1, 1, 1]]), box(0, 10, subdivisions=4))
    candidates, found = scene.look()
    np.testing.assert_allclose(found.depth, 0.1)
    moved = torch.as_tensor(scene.vertices).clone()
    moved[:2] += torch.tensor([0.0, 3.5, 2.0])
    assert (depths(moved, candidates).depth == -torch.inf).all()
    np.testing.assert_allclose(Scene(moved[:2].numpy(), box(0, 10)).depth(), 0.1)


def test_nothing_to_watch():
    for scene in (Scene(np.empty((0, 3)), box(0, 10)), Scene(np.zeros((2, 3)))):
        candidates, found = scene.look()
        assert len(candidates.query) == len(found.depth) == 0


def pin_in_a_block() -> tuple[np.ndarray, np.ndarray, int]:
    """Vertices, triangles and how many of the vertices are the block's: a pin, open at its far end, stuck into it.

    The block reaches from x = -9 to 1, the pin from -1 to 9; the origin is inside of both.
    """
    block, pin = box(-9, 1), box(-1, 9, subdivisions=1)
    pin.vertices *= (1, 0.4, 0.4)
    pin.update_faces(~(pin.triangles_center[:, 0] > 9 - 1e-9))
    count = len(block.vertices)
    triangles = np.concatenate([block.faces, np.asarray(pin.faces) + count]).astype(np.int64)
    return np.concatenate([block.vertices, pin.vertices]), triangles, count


def test_flesh_holds_what_is_inside_of_another_part_and_nothing_on_the_outside():
    vertices, triangles, block = pin_in_a_block()
    interior = Interior(triangles)
    stuck = (np.arange(len(vertices)) >= block) & (vertices[:, 0] < 1)
    assert 5 < stuck.sum() < len(vertices) - block
    np.testing.assert_array_equal(interior.contains(vertices, np.arange(len(vertices))), stuck)
    assert interior.contains(vertices, np.empty(0, int)).shape == (0,)


def test_the_far_side_of_ones_own_flesh_is_no_contact():
    vertices, triangles, block = pin_in_a_block()
    left = triangles[(vertices[triangles][:, :, 0] < -9 + 1e-9).all(1)]
    right = np.flatnonzero(np.isclose(vertices, (1, 2.5, 2.5)).all(1))  # the block's own, right across from `left`
    tip = block + np.flatnonzero(vertices[block:, 0] < -1 + 1e-9)
    points = np.concatenate([right, tip])
    assert len(right) == 1 and len(tip) >= 9
    options = {"parts": [left], "inside": 20.0, "outside": 20.0}
    everything, none = list(range(len(points))), np.zeros(len(points))
    assert ContactSearch(points, **options).candidates(vertices, none).query.tolist() == everything
    checked = ContactSearch(points, **options, interior=Interior(triangles))
    assert checked.candidates(vertices, none).query.tolist() == everything[1:]
    # What is no deeper than allowed is candidates all the same.
    assert checked.candidates(vertices, np.full(len(points), 11.0)).query.tolist() == everything
