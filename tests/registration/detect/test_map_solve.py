from dataclasses import replace

import numpy as np
import pytest

from registration.detect import map_solve
from registration.detect.map_regions import regions_of
from registration.detect.map_renders import Observations, _opposite, sample_cameras
from registration.geometry.topology import vertex_normals
from registration.model import regions
from registration.model.landmarks import LandmarkScheme
from tests.fixtures.make_fixtures import tiny_model

NOISE_PX = 1.0


@pytest.fixture(scope="module")
def data():
    return tiny_model()


@pytest.fixture(scope="module")
def truth(data):
    """Four points on the left half of the face, and their mirror images."""
    skin = regions.head_skin(data) & ~regions.ears(data) & (data.template_vertex_positions[:, 0] > 0.01)
    normals = vertex_normals(_tensor(data.template_vertex_positions), _tensor(data.triangles.astype(np.int64))).numpy()
    faces = data.triangles[(skin & (normals[:, 2] > 0.6))[data.triangles].all(1)].astype(np.int64)
    chosen = faces[np.linspace(0, len(faces) - 1, 4).astype(int)]
    weights = np.tile([0.5, 1 / 3, 1 / 6], (8, 1))
    mirrored = data.mirror_indices.astype(np.int64)[chosen]
    return LandmarkScheme(name="test", indices=np.concatenate([chosen, mirrored]), weights=weights)


@pytest.fixture(scope="module")
def observations(data, truth):
    """What an exact detector with a little noise would find on people of the model."""
    rng = np.random.default_rng(0)
    heads, rigs, pixels = [], [], []
    for _ in range(8):
        vertices = data.template_vertex_positions + np.tensordot(
            rng.standard_normal(len(data.vertex_identity_basis)), data.vertex_identity_basis.astype(np.float64), 1
        )
        cameras = sample_cameras(data, vertices, rng)
        found = np.stack([camera.project(truth.points(vertices))[0] for camera in cameras])
        heads.append(vertices.astype(np.float32))
        rigs.append(cameras)
        pixels.append(found + rng.normal(0, NOISE_PX, found.shape))
    return Observations(
        vertices=np.stack(heads),
        cameras=tuple(rigs),
        pixels=np.array(pixels),
        person=np.arange(8),
        expression=("neutral",) * 8,
        opposite=np.r_[4:8, 0:4],
    )


def _tensor(array):
    import torch

    return torch.as_tensor(np.asarray(array))


def test_an_exact_detectors_points_are_found(data, truth, observations):
    areas = regions_of(data, "test")
    solved = map_solve.solve(data, observations, areas, "test")
    template = data.template_vertex_positions.astype(np.float64)
    distance = np.linalg.norm(solved.points(template) - truth.points(template), axis=1)
    assert distance.max() < 2e-3  # one step of the grid on the faces of the small model
    np.testing.assert_allclose(solved.points(template)[:4] * (-1, 1, 1), solved.points(template)[4:], atol=1e-6)


def test_the_spread_measures_the_detectors_noise_on_held_out_people(data, truth, observations):
    areas = regions_of(data, "test")
    held_out = map_solve.held_out_errors(data, observations, areas, "test")
    assert held_out.shape == (8, 8, 3) and np.isfinite(held_out).all()
    spread = map_solve.spread(held_out, observations.opposite)
    np.testing.assert_array_equal(spread[:4], spread[4:])
    assert (spread < 2e-3).all()
    slid = replace(observations, pixels=observations.pixels.copy())
    slid.pixels[:, :, 0] += np.random.default_rng(1).normal(0, 12, (8, 1, 2))  # one that differs from person to person
    widened = map_solve.spread(map_solve.held_out_errors(data, slid, areas, "test"), slid.opposite)
    assert widened[0] > 2 * spread[0] and widened[0] == widened[4]


def test_outliers_and_pictures_without_a_face_do_not_move_a_point(data, truth, observations):
    spoiled = replace(observations, pixels=observations.pixels.copy())
    spoiled.pixels[::4, 0] += 60
    spoiled.pixels[1, 2] = np.nan
    template = data.template_vertex_positions.astype(np.float64)
    solved = map_solve.solve(data, spoiled, regions_of(data, "test"), "test")
    assert np.linalg.norm(solved.points(template) - truth.points(template), axis=1).max() < 2.5e-3


def test_counterparts_are_found_from_mirrored_pictures():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 400, (6, 2))
    other = np.array([1, 0, 2, 4, 3, 5])
    pairs = [(points + rng.normal(0, 1, (6, 2)), points[other] + rng.normal(0, 1, (6, 2))) for _ in range(4)]
    np.testing.assert_array_equal(_opposite(pairs, 6), other)
    np.testing.assert_array_equal(_opposite([], 6), np.full(6, -1))
