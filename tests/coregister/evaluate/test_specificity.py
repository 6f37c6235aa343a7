"""Specificity: equal to a comparison with every head, zero among the real ones, known distances between spheres."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from coregister.evaluate import linear_fit
from coregister.evaluate.linear_fit import LinearPart
from coregister.evaluate.specificity import SpecificitySettings, random_heads, specificity, specificity_mm
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import align
from registration.geometry.surface_samples import spread_over_surface
from tests.coregister.spectrum import spectrum_model

SAMPLES, SEED = 8, 3
SETTINGS = SpecificitySettings(points=150, seed=SEED)


@pytest.fixture(scope="module")
def part():
    return linear_fit.identity_part(spectrum_model())


@pytest.fixture(scope="module")
def database(part):
    """Heads with half the model's variation, some near one another, so that neighbours are hard to tell apart."""
    coefficients = 0.5 * np.random.default_rng(11).standard_normal((24, 12))
    return np.stack([part.shape(row) for row in coefficients])


def heads_of(part, samples=SAMPLES):
    return list(random_heads(part, [12], samples=samples, seed=SEED))


def find(draws, database, part, settings=SETTINGS):
    return specificity(draws, database, rest=part.rest, triangles=part.triangles, settings=settings)


def with_poses(heads, seed):
    rotations = Rotation.random(len(heads), random_state=seed)
    return np.stack([turn.apply(head) + (1.0, -2.0, 0.5) for turn, head in zip(rotations, heads, strict=True)])


def brute_force_mm(draw, database, part):
    points = spread_over_surface(part.rest, part.triangles, SETTINGS.points, np.random.default_rng(SEED))
    distances = []
    for real in database:
        aligned = transform_points(align(draw[None], real, np.ones((1, len(real))))[0], draw)
        pairs = ((aligned, real), (real, aligned))
        there_and_back = [
            closest_points(barycentric_points(a, part.triangles, *points), b, part.triangles)[0].mean()
            for a, b in pairs
        ]
        distances.append(np.mean(there_and_back) * MM_PER_M)
    return np.array(distances)


def test_the_nearest_is_that_of_a_comparison_with_every_head_aligned_to_each(part, database):
    found = find(heads_of(part), database, part)
    every = np.stack([brute_force_mm(draw, database, part) for draw in heads_of(part)])
    np.testing.assert_allclose(found.distance_mm, every.min(1), atol=1e-9)
    assert found.nearest.tolist() == every.argmin(1).tolist()
    assert found.evaluations.mean() < len(database) / 2


def test_random_heads_among_the_real_ones_have_no_distance(part):
    draws = heads_of(part)
    found = find(draws, np.stack(draws[::-1]), part)
    assert found.distance_mm.max() < 1e-4
    assert found.nearest.tolist() == list(range(SAMPLES))[::-1]
    without = find(draws, np.stack(draws[1:]), part)
    assert without.distance_mm[0] > 0.1 and without.distance_mm[1:].max() < 1e-4


def test_the_result_does_not_depend_on_poses(part, database):
    draws = heads_of(part)
    found, moved = (
        find(first, second, part)
        for first, second in ((draws, database), (with_poses(draws, 4), with_poses(database, 5)))
    )
    np.testing.assert_allclose(found.distance_mm, moved.distance_mm, atol=1e-6)
    assert found.nearest.tolist() == moved.nearest.tolist()


def test_mirror_images_are_not_aligned_by_a_reflection(part, database):
    mirrored = database * (-1.0, 1.0, 1.0)
    found = find(heads_of(part, 2), mirrored, part)
    assert found.distance_mm == pytest.approx(
        [brute_force_mm(draw, mirrored, part).min() for draw in heads_of(part, 2)]
    )


def test_distances_of_spheres_are_differences_of_radii():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    vertices = np.asarray(mesh.vertices)
    radial = vertices[None] * 1e-2  # a coefficient of one: 1 mm
    part = LinearPart(rows=np.arange(len(vertices)), rest=vertices, basis=radial, triangles=np.asarray(mesh.faces))
    distance = specificity_mm(part, vertices[None], [1], samples=20, seed=5)[:, 0]
    expected = np.abs(np.random.default_rng(5).standard_normal((20, 1))[:, 0])
    np.testing.assert_allclose(distance, expected, rtol=2e-2)  # chords are inside the sphere


def test_a_surface_that_the_other_covers_in_part_is_far_in_one_direction():
    """A flat strip of half the length: its points are on the other, whose farther half is not on it."""
    side = np.linspace(0, 1, 5)
    vertices = np.array([(0.1 * x, 0.02 * y, 0.0) for x in side for y in (0, 1)])
    triangles = np.array([(k, k + 1, k + 2) if k % 2 == 0 else (k + 1, k, k + 2) for k in range(8)])
    part = LinearPart(rows=np.arange(10), rest=vertices, basis=np.zeros((1, 10, 3)), triangles=triangles)
    short = vertices * (0.5, 1, 1)
    found = find([short], vertices[None], part, replace(SETTINGS, points=4000))
    outside_mm = 0.5 * 12.5  # half of the points, 0 to 25 mm away from an end
    assert found.distance_mm[0] == pytest.approx((0 + outside_mm) / 2, rel=0.01)


def test_fewer_components_use_the_same_samples(part, database):
    few = database[:3]
    both = specificity_mm(part, few, [2, 12], samples=2, seed=SEED)
    assert both.shape == (2, 2)
    np.testing.assert_allclose(both[:, 1], specificity_mm(part, few, [12], samples=2, seed=SEED)[:, 0])


@pytest.mark.slow
def test_processes_give_the_same_result_in_the_same_order(part, database):
    draws, few = heads_of(part, 3), database[:6]
    alone, together = (find(draws, few, part, replace(SETTINGS, workers=workers)) for workers in (1, 2))
    np.testing.assert_array_equal(together.distance_mm, alone.distance_mm)
    assert together.nearest.tolist() == alone.nearest.tolist()
