"""Unfolding: folds of a sheet and of the model's lids open, and nothing else moves."""

import numpy as np
import pytest

from registration.fit.unfolding import unfolding
from registration.frames import MM_PER_M
from registration.geometry.folds import Creases
from registration.model import regions
from tests.fixtures.make_fixtures import tiny_model

COUNT = 15  # vertices on each side of a square sheet with edges of 1 mm
MIDDLE = COUNT // 2


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet's vertices, metres, and its triangles."""
    x, y = np.meshgrid(np.arange(COUNT), np.arange(COUNT), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) / MM_PER_M
    corner = (COUNT * np.arange(COUNT - 1)[:, None] + np.arange(COUNT - 1)).ravel()
    lower, upper = (
        np.stack([corner, corner + COUNT, corner + 1]),
        np.stack([corner + 1, corner + COUNT, corner + COUNT + 1]),
    )
    return vertices, np.concatenate([lower.T, upper.T])


def pleated(vertices: np.ndarray) -> np.ndarray:
    """The sheet with three vertices of its middle row carried over the next row."""
    folded = vertices.copy()
    row = COUNT * MIDDLE + np.arange(MIDDLE - 1, MIDDLE + 2)
    folded[row] += [1.8e-3, 0.0, 0.1e-3]
    return folded


def test_a_pleat_opens_and_the_rest_stays():
    flat, triangles = sheet()
    everything = np.ones(len(flat), bool)
    creases = Creases.of(triangles, flat, everything)
    folded = pleated(flat)
    assert len(creases.sharp(folded, 120)) > 3
    displacement = unfolding(triangles, creases, everything, folded)
    assert len(creases.sharp(folded + displacement, 120)) == 0
    size_mm = np.linalg.norm(displacement, axis=1) * MM_PER_M
    assert size_mm.max() < 2.5
    distance_mm = np.linalg.norm(flat - flat[COUNT * MIDDLE + MIDDLE], axis=1) * MM_PER_M
    assert (size_mm[distance_mm > 7] == 0).all()


def test_only_members_move():
    flat, triangles = sheet()
    creases = Creases.of(triangles, flat, np.ones(len(flat), bool))
    members = flat[:, 0] < (MIDDLE + 0.5) / MM_PER_M
    displacement = unfolding(triangles, creases, members, pleated(flat))
    assert displacement[members].any() and not displacement[~members].any()


def test_a_skin_without_folds_does_not_move():
    data = tiny_model()
    rest = np.asarray(data.template_vertex_positions, np.float64)
    creases = Creases.of(data.triangles, rest, regions.exterior(data))
    assert not unfolding(data.triangles, creases, regions.exterior(data), rest).any()


@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.0], [0.3, -2.0, 1.5]])
def test_it_does_not_depend_on_where_the_head_is(shift):
    flat, triangles = sheet()
    creases = Creases.of(triangles, flat, np.ones(len(flat), bool))
    at_origin, moved = (
        unfolding(triangles, creases, np.ones(len(flat), bool), pleated(flat) + offset)
        for offset in (np.zeros(3), shift)
    )
    assert moved == pytest.approx(at_origin, abs=1e-6)
