"""Turns and sharp folds of a strip that is folded by hand."""

import numpy as np
import pytest
import torch

from registration.geometry.folds import Creases, turn_cosines

TRIANGLES = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]])  # two squares beside each other, from left to right
FOLD = {2, 3}  # the edge between them
FLAT = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0], [2, 1, 0]], float) * [1, -1, 1] * 1e-3
EVERYTHING = np.ones(6, bool)


def turned(degrees: float) -> np.ndarray:
    """The strip with its right square turned about the edge between the squares."""
    points, angle = FLAT.copy(), np.radians(degrees)
    points[4:, 0] = 1e-3 * (1 + np.cos(angle))
    points[4:, 2] = 1e-3 * np.sin(angle)
    return points


@pytest.mark.parametrize("degrees", [0, 30, 90, 150, 180])
def test_cosine_of_the_turn(degrees):
    creases = Creases.of(TRIANGLES, FLAT, EVERYTHING)
    cosines = turn_cosines(torch.as_tensor(turned(degrees)), torch.as_tensor(creases.faces)).numpy()
    expected = [np.cos(np.radians(degrees)) if set(edge) == FOLD else 1.0 for edge in creases.vertices.tolist()]
    assert cosines == pytest.approx(expected, abs=1e-9)


def test_a_fold_is_sharp_beyond_120_degrees_and_only_where_there_is_none_at_rest():
    creases = Creases.of(TRIANGLES, FLAT, EVERYTHING)
    assert len(creases.sharp(turned(119), 120)) == 0
    assert [set(edge) for edge in creases.sharp(turned(121), 120).tolist()] == [FOLD]
    assert [set(edge) for edge in creases.sharp(turned(-121), 120).tolist()] == [FOLD]
    folded_at_rest = Creases.of(TRIANGLES, turned(121), EVERYTHING)
    assert len(folded_at_rest.sharp(turned(170), 120)) == 0
    far = np.array([100.0, -20.0, 3.0])
    assert len(creases.sharp(turned(121) * 1.3 + far, 120)) == 1


def test_only_edges_between_faces_of_the_surface_count():
    members = EVERYTHING.copy()
    members[5] = False  # one triangle of the right square remains
    assert len(Creases.of(TRIANGLES, FLAT, EVERYTHING).vertices) == 3
    assert len(Creases.of(TRIANGLES, FLAT, members).vertices) == 2
    members[4] = False
    assert len(Creases.of(TRIANGLES, FLAT, members).sharp(turned(180), 120)) == 0


def test_areas_add_up_to_that_of_the_inner_edges_faces_and_a_face_without_area_has_no_turn():
    creases = Creases.of(TRIANGLES, FLAT, EVERYTHING)
    assert creases.area == pytest.approx(np.full(3, 1e-6 / 3))
    collapsed = FLAT.copy()
    collapsed[4:] = FLAT[2]
    cosines = turn_cosines(torch.as_tensor(collapsed), torch.as_tensor(creases.faces))
    assert cosines.isfinite().all() and (cosines[[set(edge) == FOLD for edge in creases.vertices.tolist()]] == 0).all()
