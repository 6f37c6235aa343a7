"""Flat maps of domes: no face turns over, a mirror image stays one, and the stretch becomes more even."""

import numpy as np
import pytest

from registration.geometry.parameterization import flat_map
from registration.geometry.quads import boundary_loops

COLUMNS = 24


def dome(rows=8, *, opening=0.12, down_to=np.pi / 2, centre=0.0):
    """A part of the unit sphere about +z, from a hole at its top down to a polar angle, lopsided for `centre`."""
    angle = np.linspace(opening, down_to, rows)
    around = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    polar, turn = np.meshgrid(angle, around, indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    points[:, 1] += centre * points[:, 2]
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows - 1), np.arange(COLUMNS), indexing="ij"))
    after = (c + 1) % COLUMNS
    quads = np.stack([r * COLUMNS + c, (r + 1) * COLUMNS + c, (r + 1) * COLUMNS + after, r * COLUMNS + after], 1)
    return points, quads, np.arange((rows - 1) * COLUMNS, rows * COLUMNS)


def circle(rim):
    turn = 2 * np.pi * np.arange(len(rim)) / len(rim)
    return 0.5 + 0.5 * np.stack([np.cos(turn), np.sin(turn)], 1)


def corner_areas(uv, quads):
    """Of each quad the signed areas of its four corner triangles: all positive for a convex, upright one."""
    before, here, after = (uv[np.roll(quads, k, 1)] for k in (1, 0, -1))
    a, b = here - before, after - here
    return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / 2


def test_a_dome_with_a_hole_lies_flat_without_flips():
    points, quads, rim = dome()
    uv = flat_map(points, quads, rim, circle(rim))
    assert corner_areas(uv, quads).min() > 1e-5
    assert uv.min() >= 0 and uv.max() <= 1
    np.testing.assert_array_equal(uv[rim], circle(rim))


def test_two_holes():
    points, quads, rim = dome(10)
    quads = quads[~np.isin(np.arange(len(quads)), [4 * COLUMNS + 3, 4 * COLUMNS + 4, 5 * COLUMNS + 3, 5 * COLUMNS + 4])]
    assert len(boundary_loops(quads)) == 3
    uv = flat_map(points, quads, rim, circle(rim))
    assert corner_areas(uv, quads)[:, :].min() > 1e-6


@pytest.mark.parametrize("down_to", [np.pi / 2, 2.6])
def test_a_symmetric_dome_has_a_symmetric_map(down_to):
    points, quads, rim = dome(down_to=down_to, centre=0.3)
    mirror = np.arange(len(points)).reshape(-1, COLUMNS)
    mirror = mirror[:, (COLUMNS // 2 - np.arange(COLUMNS)) % COLUMNS].ravel()
    np.testing.assert_allclose(points[mirror] * (-1, 1, 1), points, atol=1e-12)
    uv = flat_map(points, quads, rim, circle(rim))
    np.testing.assert_allclose((1, 0) + uv[mirror] * (-1, 1), uv, atol=1e-9)


def test_more_rounds_even_out_the_stretch_and_still_flip_nothing():
    points, quads, rim = dome(12, down_to=2.6)  # most of a sphere: Tutte's own map crowds its top into a dot

    def unevenness(uv):
        solid = np.linalg.norm(
            np.cross(points[quads[:, 2]] - points[quads[:, 0]], points[quads[:, 3]] - points[quads[:, 1]]), axis=1
        )
        flat = corner_areas(uv, quads)
        assert flat.min() > 0
        return np.std(np.log(flat.sum(1) / solid))

    once, often = (unevenness(flat_map(points, quads, rim, circle(rim), rounds)) for rounds in (1, 8))
    assert often < 0.7 * once


def test_a_flat_disc_stays_as_it_is():
    points, quads, rim = dome(8, opening=0.1)
    points = points * (1, 1, 0)
    radius = np.repeat(np.linspace(0.1, 1, 8), COLUMNS)
    points[:, :2] *= (radius / np.linalg.norm(points[:, :2], axis=1))[:, None]
    uv = flat_map(points, quads, rim, circle(rim))
    shown = 2 * np.linalg.norm(uv - 0.5, axis=1)
    np.testing.assert_allclose(shown, radius, atol=0.06)
