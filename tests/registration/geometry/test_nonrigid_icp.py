"""Non-rigid ICP on spheres and ellipsoids, whose closest points are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.sparse import csr_matrix

from registration.geometry.nonrigid_icp import SPLINES, Bent, IcpSettings, Rung, Surface, bend

RADIUS = 0.1
LADDER = tuple(
    Rung(length_m=length, landmarks=landmarks, reach_m=0.05, facing=0.3)
    for length, landmarks in ((0.1, 50.0), (0.05, 50.0), (0.02, 20.0))
)
QUICK = IcpSettings(splines=(), ladder=LADDER, steps=2, rounds=6)


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(3, RADIUS)
    return np.array(sphere.vertices), np.array(sphere.faces, np.int64)


@pytest.fixture(scope="module")
def egg():
    """A surface with other triangles than the ball's."""
    sphere = trimesh.creation.uv_sphere(RADIUS, count=[48, 48])
    return np.array(sphere.vertices) * [1.0, 1.25, 0.9], np.array(sphere.faces, np.int64)


def bent(ball, surface, settings=QUICK, **options):
    vertices, triangles = ball
    data = options.pop("data", np.ones(len(vertices), bool))
    unmarked = {"landmarks": csr_matrix((0, len(vertices))), "marks": np.zeros((0, 3)), "trust": np.zeros(0)}
    mesh = Bent(vertices=vertices, triangles=triangles, data=data, whole=data, **(unmarked | options))
    return bend(mesh, surface, settings)


def test_a_ball_is_bent_onto_an_egg(ball, egg):
    surface = Surface(*egg)
    before, after = surface.closest(ball[0]).distance, surface.closest(bent(ball, surface)).distance
    assert before.max() > 0.02
    assert after.mean() < 2e-5 and after.max() < 5e-4


def test_vertices_without_data_follow_the_others(ball, egg):
    free = ball[0][:, 2] > 0.08
    result = bent(ball, Surface(*egg), data=~free)
    distance = Surface(*egg).closest(result).distance
    assert distance[~free].mean() < 2e-5
    assert distance[free].max() < 0.01  # the ball itself is up to 2 cm off


def test_faces_that_are_left_out_attract_nothing(ball, egg):
    low = egg[0][:, 1] < -0.05
    surface = Surface(*egg, members=~low)
    hits = surface.closest(bent(ball, surface))
    assert hits.distance[hits.usable].mean() < 2e-5
    assert not hits.usable.all() and not hits.usable[hits.points[:, 1] < -0.055].any()


def test_landmarks_turn_the_mesh_along_the_surface(ball):
    """Closest points alone leave a ball on an equal ball as it is."""
    marked = np.arange(0, len(ball[0]), 40)
    weights = csr_matrix((np.ones(len(marked)), (np.arange(len(marked)), marked)), (len(marked), len(ball[0])))
    angle = 0.1
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    truth = ball[0] @ turn.T
    options = {"landmarks": weights, "marks": truth[marked], "trust": np.ones(len(marked))}
    result = bent(ball, Surface(*ball), **options)
    assert np.linalg.norm(result - truth, axis=1).mean() < 0.3 * np.linalg.norm(ball[0] - truth, axis=1).mean()


def test_normals_that_disagree_are_rejected(ball):
    """A surface that looks the other way attracts nothing."""
    inside_out = Surface(1.05 * ball[0], ball[1][:, ::-1])
    np.testing.assert_allclose(bent(ball, inside_out), ball[0], atol=1e-6)


@pytest.fixture(scope="module")
def marked_third(ball):
    """A ball that is stretched, bent and turned, with landmarks on a third: the surface, where points lie, options."""
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])

    def move(points):
        return (points * [1.2, 1, 0.9] + 0.005 * np.sin(15 * points[:, [1, 2, 0]])) @ turn.T

    fine = trimesh.creation.icosphere(4, RADIUS)
    surface, truth = Surface(move(np.array(fine.vertices)), np.array(fine.faces, np.int64)), move(ball[0])
    marked = np.flatnonzero(ball[0][:, 2] > 0.03)[::5]
    weights = csr_matrix((np.ones(len(marked)), (np.arange(len(marked)), marked)), (len(marked), len(ball[0])))
    return surface, truth, {"landmarks": weights, "marks": truth[marked], "trust": np.ones(len(marked))}


SPACE = replace(QUICK, splines=SPLINES[1:8])


def test_bent_space_finds_where_points_lie_along_the_surface(ball, marked_third):
    surface, truth, options = marked_third
    errors = [np.linalg.norm(bent(ball, surface, s, **options) - truth, axis=1).mean() for s in (QUICK, SPACE)]
    assert errors[1] < 0.6 * errors[0]


def test_space_is_not_bent_where_landmarks_do_not_ask_for_it(ball, marked_third):
    """What is gained must exceed the landmarks' own errors; without landmarks nothing tells."""
    surface, truth, options = marked_third
    wrong = options["marks"] + 0.02 * np.random.default_rng(0).standard_normal(options["marks"].shape)
    for given in (options | {"marks": wrong}, {}):
        np.testing.assert_array_equal(bent(ball, surface, SPACE, **given), bent(ball, surface, QUICK, **given))
