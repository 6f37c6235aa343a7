import numpy as np
import pytest

from registration.geometry.self_overlap import SelfOverlap
from tests.registration.geometry.sausage import RADIUS, end, sausage

OPEN, SHUT = np.pi - 0.8, np.pi - 0.1336  # shut, the ends' centres are 8 mm apart
UNBOUNDED = 1.0


def flattened(vertices: np.ndarray, share: np.ndarray, to: float) -> np.ndarray:
    """The half of the sausage with positive share made flat, up to its end: a blade."""
    way = np.clip(share / 0.2, 0, 1)
    return vertices * np.column_stack([np.ones((len(share), 2)), 1 - (1 - to) * way])


def in_first_end(vertices: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Depth of the second end's vertices in the first end's half ball, 0 outside of it, metres."""
    away = vertices - end(SHUT, -1)
    onwards = -np.array([np.sin(SHUT), np.cos(SHUT), 0])
    within = (share > 0.9) & (np.linalg.norm(away, axis=1) < RADIUS) & (away @ onwards > 0)
    return np.where(within, RADIUS - np.linalg.norm(away, axis=1), 0)


@pytest.mark.parametrize(("at_rest", "thickness"), [(1.0, 1.0), (0.15, 0.15), (0.15, 0.2)])
def test_the_way_out_of_a_lobe_is_its_surface_not_the_own_far_side(at_rest, thickness):
    """The blade of 3 mm is up to 8 mm deep in the ball: its far side is nearer than the way out. It may swell."""
    rest, faces, share = sausage(OPEN)
    overlap = SelfOverlap(flattened(rest, share, at_rest), faces)
    vertices = flattened(sausage(SHUT)[0], share, thickness)
    expected = in_first_end(vertices, share)
    members = np.flatnonzero(expected > 2e-4)
    np.testing.assert_array_equal(overlap.inside(vertices, members), members)
    assert len(members) > 30 and expected.max() > 4.5e-3
    all_faces, unbounded = np.arange(len(faces)), np.full(len(members), UNBOUNDED)
    distance, face, penetrated = overlap.penetrated_faces(vertices, members, all_faces, unbounded)
    assert penetrated.all() and (share[faces[face]] < 0).all()
    np.testing.assert_allclose(distance, expected[members], atol=1.2e-4)  # the facets' depth


def test_a_free_surface_has_no_vertex_inside_and_outside_is_not_inside():
    rest, faces, share = sausage(OPEN)
    overlap = SelfOverlap(rest, faces)
    all_faces = np.arange(len(rest))
    assert not len(overlap.inside(rest, all_faces))
    shut = sausage(SHUT)[0]
    inside = overlap.inside(shut, all_faces)
    assert (np.abs(share[inside]) > 0.85).all()
    distance, _, _ = overlap.penetrated_faces(shut, inside[:0], np.arange(len(faces)), np.zeros(0))
    assert distance.shape == (0,)


def test_only_the_faces_asked_for_and_only_within_reach():
    rest, faces, share = sausage(OPEN)
    overlap, vertices = SelfOverlap(rest, faces), sausage(SHUT)[0]
    members = np.flatnonzero(in_first_end(vertices, share) > 4e-3)
    own = np.flatnonzero((share[faces] > 0).all(1))
    distance, face, penetrated = overlap.penetrated_faces(vertices, members, own, np.full(len(members), 1e-4))
    assert np.isin(face, own).all() and not penetrated.any()
    _, none, _ = overlap.penetrated_faces(vertices, members, own[:0], np.full(len(members), UNBOUNDED))
    assert (none == -1).all()


def test_where_the_rest_shape_overlaps_itself_small_motions_change_little():
    """No way out can be told there; but the depth at rest and a moment later must be one measure."""
    rest, faces, _ = sausage(SHUT)
    overlap, all_faces = SelfOverlap(rest, faces), np.arange(len(faces))
    later = sausage(SHUT + 0.003)[0]  # 0.09 mm at either end
    members = np.intersect1d(*(overlap.inside(v, np.arange(len(rest))) for v in (rest, later)))
    unbounded = np.full(len(members), UNBOUNDED)
    before, after = (overlap.penetrated_faces(v, members, all_faces, unbounded)[0] for v in (rest, later))
    assert len(members) > 100 and np.abs(after - before).max() < 3e-4
