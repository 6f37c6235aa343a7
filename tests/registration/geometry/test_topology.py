"""Edges and vertex normals, on meshes small enough to write down, and on spheres, where normals are known."""

import numpy as np
import pytest
import torch
import trimesh

from registration.errors import InputError
from registration.geometry.topology import edges, grown, vertex_normals

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def by_ends(found):
    """{ends: index} of the edges, ends in any order."""
    return {frozenset(ends): k for k, ends in enumerate(found.vertices.tolist())}


def check_corners(triangles):
    """Every side's corners hold the edge's own vertices, in the edge's order, on the face of that side."""
    found = edges(triangles)
    for ends, faces, corners in zip(found.vertices, found.faces, found.corners, strict=True):
        for face, corner in zip(faces, corners, strict=True):
            if face < 0:
                assert (corner == -1).all()
                continue
            np.testing.assert_array_equal(corner // 3, face)
            np.testing.assert_array_equal(triangles.ravel()[corner], ends)
    assert (found.faces[:, 0] >= 0).all()
    return found


def test_a_square_has_four_boundary_edges_and_a_diagonal():
    found = check_corners(SQUARE)
    index = by_ends(found)
    assert set(index) == {frozenset(p) for p in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2))}
    diagonal = index.pop(frozenset((0, 2)))
    assert sorted(found.faces[diagonal]) == [0, 1]
    assert (found.faces[list(index.values()), 1] == -1).all()
    assert found.faces[index[frozenset((2, 3))], 0] == 1
    # Ends run as the first face does: 2 -> 0 in face 0.
    np.testing.assert_array_equal(found.vertices[diagonal], [2, 0])


def test_a_flipped_neighbour_keeps_its_corners_with_their_vertices():
    flipped = np.array([[0, 1, 2], [0, 3, 2]])
    found = check_corners(flipped)
    assert (found.faces[:, 1] >= 0).sum() == 1


@pytest.mark.parametrize("seed", range(3))
def test_any_closed_mesh(seed):
    """Faces, corners and starting points in random order; a third of the faces flipped."""
    rng = np.random.default_rng(seed)
    triangles = np.array(trimesh.creation.icosphere(subdivisions=2).faces)
    triangles = triangles[rng.permutation(len(triangles))]
    triangles = np.stack([np.roll(t, k) for t, k in zip(triangles, rng.integers(0, 3, len(triangles)), strict=True)])
    flip = rng.random(len(triangles)) < 1 / 3
    triangles[flip] = triangles[flip][:, ::-1]
    found = check_corners(triangles)
    assert len(found.vertices) == 3 * len(triangles) // 2
    assert (found.faces >= 0).all() and (found.faces[:, 0] != found.faces[:, 1]).all()
    # Every face is named by its three edges.
    np.testing.assert_array_equal(np.bincount(found.faces.ravel()), 3)


def test_three_faces_at_an_edge_are_refused_by_name():
    with pytest.raises(InputError) as caught:
        edges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert caught.value.where == "edge between vertices 0 and 1"
    assert caught.value.got == "3 triangles"


def test_normals_of_a_sphere_point_outwards():
    ball = trimesh.creation.icosphere(subdivisions=4)
    centre = np.array([0.1, -0.2, 0.3])
    vertices = torch.tensor(0.09 * ball.vertices + centre, dtype=torch.float64)
    normals = vertex_normals(vertices, torch.tensor(np.array(ball.faces)))
    np.testing.assert_allclose(normals.norm(dim=1), 1, atol=1e-12)
    angle = np.degrees(np.arccos((normals.numpy() * ball.vertices).sum(1).clip(-1, 1)))
    assert angle.max() < 0.5
    inwards = vertex_normals(vertices, torch.tensor(np.array(ball.faces)[:, ::-1].copy()))
    torch.testing.assert_close(inwards, -normals)


def test_normals_are_weighed_by_angle():
    """Two walls of one edge: 1 x 1 facing +z, a right angle at vertex 0, and a steep one facing +y."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 3.0]])
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2], [1, 0, 3]]))
    expected = torch.tensor([0.0, np.arctan(3.0), np.pi / 2], dtype=torch.float32)
    torch.testing.assert_close(normals[0], expected / expected.norm())
    torch.testing.assert_close(normals[2], torch.tensor([0.0, 0, 1]))


def test_normals_do_not_depend_on_how_quads_are_cut():
    box = trimesh.creation.box()
    normals = vertex_normals(torch.tensor(box.vertices), torch.tensor(np.array(box.faces)))
    torch.testing.assert_close(normals, torch.nn.functional.normalize(torch.tensor(box.vertices), dim=1))


def test_a_vertex_without_area_has_no_normal_and_finite_gradients():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], requires_grad=True)
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2]]))
    assert normals[3].abs().max() == 0
    normals.sum().backward()
    assert vertices.grad.isfinite().all() and vertices.grad[3].abs().max() == 0


def test_gradient_of_normals():
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices = torch.tensor(ball.vertices + 0.1 * np.random.default_rng(0).standard_normal(ball.vertices.shape))
    triangles = torch.tensor(np.array(ball.faces))
    assert torch.autograd.gradcheck(lambda v: vertex_normals(v, triangles), vertices.requires_grad_())


def test_rings_around_a_vertex():
    strip = np.array([[k, k + 1, k + 2] for k in range(8)])  # neighbours are at most two apart
    members = np.arange(10) == 4
    assert np.flatnonzero(grown(strip, members, 0)).tolist() == [4]
    assert np.flatnonzero(grown(strip, members, 1)).tolist() == [2, 3, 4, 5, 6]
    assert np.flatnonzero(grown(strip, members, 2)).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert members.sum() == 1
