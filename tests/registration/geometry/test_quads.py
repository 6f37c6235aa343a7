"""Quad meshes whose answers are known: a cube, a torus, tubes, flat sheets."""

import numpy as np
import pytest

from registration.geometry.quads import (
    beyond_loop,
    boundary_loops,
    corner_triangles,
    edge_loop,
    edges_of,
    pieces,
    subdivide,
    triangles_of,
)

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def sheet(rows, columns, *, wrap_rows=False, wrap_columns=False):
    """Quads of a grid; vertex (row, column) is row * columns + column. Seen from +z with x along columns: outwards."""
    row = np.arange(rows if wrap_rows else rows - 1)
    column = np.arange(columns if wrap_columns else columns - 1)
    r, c = (a.ravel() for a in np.meshgrid(row, column, indexing="ij"))
    up, right = (r + 1) % rows, (c + 1) % columns
    return np.stack([r * columns + c, r * columns + right, up * columns + right, up * columns + c], 1)


def places(rows, columns):
    return np.stack([*np.meshgrid(np.arange(columns), np.arange(rows)), np.zeros((rows, columns))], -1).reshape(-1, 3)


def cycle(loop):
    """A closed loop from its lowest vertex on."""
    return np.roll(loop, -int(np.argmin(loop))).tolist()


def test_triangles_keep_the_corners_and_their_values():
    quads = np.array([[5, 6, 7, 8], [1, 2, 3, 4]])
    assert triangles_of(quads).tolist() == [[5, 6, 7], [7, 8, 5], [1, 2, 3], [3, 4, 1]]
    corners = quads[..., None].astype(float)
    np.testing.assert_array_equal(corner_triangles(corners)[..., 0], triangles_of(quads))


def test_edges_of_a_cube():
    edges, of_quad, count = edges_of(CUBE_QUADS)
    assert len(edges) == 12 and (count == 2).all() and (edges[:, 0] < edges[:, 1]).all()
    for side in range(4):
        ends = np.sort(np.stack([CUBE_QUADS[:, side], CUBE_QUADS[:, (side + 1) % 4]], 1), 1)
        np.testing.assert_array_equal(edges[of_quad[:, side]], ends)


def test_boundary_loops():
    assert boundary_loops(CUBE_QUADS) == []
    assert boundary_loops(sheet(4, 5, wrap_rows=True, wrap_columns=True)) == []
    (around,) = boundary_loops(sheet(3, 4))
    assert cycle(around) == [0, 1, 2, 3, 7, 11, 10, 9, 8, 4]  # counter-clockwise, as the quads are
    lower, upper = boundary_loops(sheet(4, 6, wrap_columns=True))
    assert cycle(lower) == [0, 1, 2, 3, 4, 5] and cycle(upper) == [18, 23, 22, 21, 20, 19]


def test_edge_loops_run_straight_on():
    torus = sheet(5, 7, wrap_rows=True, wrap_columns=True)
    assert edge_loop(torus, 7, 8).tolist() == [7, 8, 9, 10, 11, 12, 13]
    assert edge_loop(torus, 8, 7).tolist() == [8, 7, 13, 12, 11, 10, 9]
    assert edge_loop(torus, 3, 10).tolist() == [3, 10, 17, 24, 31]
    tube = sheet(5, 7, wrap_columns=True)
    assert edge_loop(tube, 14, 15).tolist() == [14, 15, 16, 17, 18, 19, 20]


def test_an_edge_loop_ends_at_a_boundary_and_where_three_edges_meet():
    with pytest.raises(ValueError, match="from 9 to 16 ends at vertex"):
        edge_loop(sheet(5, 7, wrap_columns=True), 9, 16)
    with pytest.raises(ValueError, match="from 0 to 1 ends at vertex 1"):
        edge_loop(CUBE_QUADS, 0, 1)


def test_beyond_a_loop():
    tube = sheet(5, 7, wrap_columns=True)
    loop = edge_loop(tube, 14, 15)
    below, above = beyond_loop(tube, loop, 0), beyond_loop(tube, loop, 34)
    np.testing.assert_array_equal(above, np.arange(len(tube)) >= 14)
    np.testing.assert_array_equal(below, ~above)


def test_pieces_hang_together_over_open_edges_only():
    quads = np.concatenate([CUBE_QUADS, sheet(2, 3) + 8])
    edges, of_quad, _ = edges_of(quads)
    label, number = pieces(of_quad, np.ones(len(edges), bool))
    assert number == 2 and len(set(label[:6])) == 1 and len(set(label[6:])) == 1 and label[0] != label[6]
    shared = (edges == [9, 12]).all(1)
    assert shared.sum() == 1 and pieces(of_quad, ~shared)[1] == 3


def test_catmull_clark_of_a_cube():
    fine = subdivide(CUBE_QUADS, np.arange(8))
    points = fine.weights @ CUBE
    np.testing.assert_allclose(points[:8], CUBE * 5 / 9, atol=1e-14)  # (F + 2 R) / 3, F = 1/3, R = 2/3
    edges, _, _ = edges_of(CUBE_QUADS)
    np.testing.assert_allclose(points[8:20], 0.75 * CUBE[edges].mean(1), atol=1e-14)
    np.testing.assert_allclose(points[20:], CUBE[CUBE_QUADS].mean(1), atol=1e-14)
    np.testing.assert_allclose(fine.linear @ CUBE, [*CUBE, *CUBE[edges].mean(1), *CUBE[CUBE_QUADS].mean(1)], atol=1e-14)


@pytest.mark.parametrize(
    "quads", [CUBE_QUADS, sheet(4, 5), sheet(4, 5, wrap_columns=True)], ids=["cube", "sheet", "tube"]
)
def test_subdivision_keeps_the_surface(quads):
    fine = subdivide(quads, np.arange(quads.max() + 1))
    for weights in (fine.weights, fine.linear):
        np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-14)
    assert len(fine.quads) == 4 * len(quads) and fine.quads.max() + 1 == fine.weights.shape[0]
    loops, fine_loops = boundary_loops(quads), boundary_loops(fine.quads)
    assert [2 * len(loop) for loop in loops] == [len(loop) for loop in fine_loops]
    for loop, fine_loop in zip(loops, fine_loops, strict=True):
        assert cycle(loop) == cycle([v for v in fine_loop if v <= quads.max()])  # the same direction

    def characteristic(mesh):
        return mesh.max() + 1 - len(edges_of(mesh)[0]) + len(mesh)

    assert characteristic(fine.quads) == characteristic(quads)


def test_a_flat_sheet_stays_put_inside_and_its_rim_becomes_a_cubic_curve():
    rows, columns = 6, 7
    quads, points = sheet(rows, columns), places(rows, columns)
    rim = boundary_loops(quads)[0]
    points[rim, 2] = np.random.default_rng(0).normal(size=len(rim))  # so that the inside must not matter
    fine = subdivide(quads, np.arange(len(points)))
    moved = fine.weights @ points
    before, after = points[np.roll(rim, 1)], points[np.roll(rim, -1)]
    np.testing.assert_allclose(moved[rim], before / 8 + 6 / 8 * points[rim] + after / 8, atol=1e-13)
    edges, _, count = edges_of(quads)
    on_rim = len(points) + np.flatnonzero(count == 1)
    np.testing.assert_allclose(moved[on_rim], points[edges[count == 1]].mean(1), atol=1e-13)
    inner = [r * columns + c for r in range(1, rows - 1) for c in range(1, columns - 1)]
    np.testing.assert_allclose(moved[inner, :2], points[inner, :2], atol=1e-13)


def test_a_symmetric_mesh_stays_symmetric():
    rows, columns = 4, 5
    quads, points = sheet(rows, columns), places(rows, columns)
    points += np.random.default_rng(1).normal(size=points.shape) * 0.1
    mirror = np.arange(rows * columns).reshape(rows, columns)[:, ::-1].ravel()
    points = (points + points[mirror] * (-1, 1, 1)) / 2
    fine = subdivide(quads, mirror)
    np.testing.assert_array_equal(fine.mirror[fine.mirror], np.arange(len(fine.mirror)))
    for weights in (fine.weights, fine.linear):
        moved = weights @ points
        np.testing.assert_allclose(moved[fine.mirror] * (-1, 1, 1), moved, atol=1e-14)
