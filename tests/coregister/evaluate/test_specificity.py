"""Specificity: zero where random heads are the real ones, and known distances between spheres."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from coregister.evaluate import linear_fit
from coregister.evaluate.linear_fit import LinearPart
from coregister.evaluate.specificity import specificity_mm
from tests.coregister.spectrum import spectrum_model

SAMPLES, SEED = 12, 3


@pytest.fixture(scope="module")
def part():
    return linear_fit.identity_part(spectrum_model())


def random_heads(part, count):
    coefficients = np.random.default_rng(SEED).standard_normal((SAMPLES, count))
    return np.stack([part.shape(row) for row in coefficients])


def test_random_heads_among_the_real_ones_have_no_distance(part):
    real = random_heads(part, 12)[::-1]
    distance = specificity_mm(part, real, [12], samples=SAMPLES, seed=SEED)
    assert distance.shape == (SAMPLES, 1)
    assert distance.max() < 1e-3
    without = specificity_mm(part, real[1:], [12], samples=SAMPLES, seed=SEED)  # without the last sample's head
    assert without[-1, 0] > 0.1
    np.testing.assert_allclose(without[:-1], distance[:-1], atol=1e-6)


def test_the_result_does_not_depend_on_the_heads_poses(part):
    real = random_heads(part, 4)[:5]
    rotations = Rotation.random(len(real), random_state=4)
    transformed = np.stack(
        [rotation.apply(head) + (1.0, -2.0, 0.5) for rotation, head in zip(rotations, real, strict=True)]
    )
    first, second = (specificity_mm(part, heads, [2, 12], samples=SAMPLES, seed=SEED) for heads in (real, transformed))
    np.testing.assert_allclose(first, second, atol=1e-4)


def test_distances_of_spheres_are_differences_of_radii():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    vertices = np.asarray(mesh.vertices)
    radial = vertices[None] * 1e-2  # a coefficient of one: 1 mm
    part = LinearPart(rows=np.arange(len(vertices)), rest=vertices, basis=radial, triangles=np.asarray(mesh.faces))
    distance = specificity_mm(part, vertices[None], [1], samples=50, seed=5)[:, 0]
    expected = np.abs(np.random.default_rng(5).standard_normal((50, 1))[:, 0])
    np.testing.assert_allclose(distance, expected, rtol=2e-2)  # chords are inside the sphere


def test_a_longer_shortlist_does_not_increase_distances(part):
    real = random_heads(part, 4)
    short, long = (
        specificity_mm(part, real, [12], samples=SAMPLES, seed=SEED + 1, shortlist=count) for count in (1, len(real))
    )
    assert (long <= short + 1e-9).all()
