"""Specificity: nothing where random heads are the real ones, and the known distance where there is one."""

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


def drawn_heads(part, count):
    drawn = np.random.default_rng(SEED).standard_normal((SAMPLES, count))
    return np.stack([part.shape(row) for row in drawn])


def test_random_heads_that_are_the_training_set_are_at_no_distance(part):
    real = drawn_heads(part, 12)[::-1]
    found = specificity_mm(part, real, [12], samples=SAMPLES, seed=SEED)
    assert found.shape == (SAMPLES, 1)
    assert found.max() < 1e-3
    without = specificity_mm(part, real[1:], [12], samples=SAMPLES, seed=SEED)  # the last sample's own head is missing
    assert without[-1, 0] > 0.1
    np.testing.assert_allclose(without[:-1], found[:-1], atol=1e-6)


def test_where_real_heads_lie_and_how_they_are_turned_does_not_matter(part):
    real = drawn_heads(part, 4)[:5]
    turns = Rotation.random(len(real), random_state=4)
    moved = np.stack([turn.apply(head) + (1.0, -2.0, 0.5) for turn, head in zip(turns, real, strict=True)])
    one, two = (specificity_mm(part, heads, [2, 12], samples=SAMPLES, seed=SEED) for heads in (real, moved))
    np.testing.assert_allclose(one, two, atol=1e-4)


def test_spheres_of_random_size_are_as_far_from_the_real_one_as_their_radii_tell():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    vertices = np.asarray(mesh.vertices)
    radial = vertices[None] * 1e-2  # a coefficient of one: 1 mm
    part = LinearPart(rows=np.arange(len(vertices)), rest=vertices, basis=radial, triangles=np.asarray(mesh.faces))
    found = specificity_mm(part, vertices[None], [1], samples=50, seed=5)[:, 0]
    wanted = np.abs(np.random.default_rng(5).standard_normal((50, 1))[:, 0])
    np.testing.assert_allclose(found, wanted, rtol=2e-2)  # chords lie within the sphere


def test_a_longer_shortlist_finds_nothing_farther(part):
    real = drawn_heads(part, 4)
    short, long = (
        specificity_mm(part, real, [12], samples=SAMPLES, seed=SEED + 1, shortlist=count) for count in (1, len(real))
    )
    assert (long <= short + 1e-9).all()
