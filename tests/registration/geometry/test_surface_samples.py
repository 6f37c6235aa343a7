"""Random points of a mesh: uniform by area, and evenly spread where that is asked for."""

import numpy as np
import trimesh

from registration.geometry.closest_point import barycentric_points
from registration.geometry.surface_samples import sample_surface, spread_over_surface

MESH = trimesh.creation.icosphere(subdivisions=3)
VERTICES, TRIANGLES = np.asarray(MESH.vertices) * (1.0, 1.0, 2.0), np.asarray(MESH.faces)


def heights(sampler, count, seed):
    face, barycentric = sampler(VERTICES, TRIANGLES, count, np.random.default_rng(seed))
    assert face.shape == (count,) and np.allclose(barycentric.sum(1), 1) and (barycentric >= 0).all()
    return barycentric_points(VERTICES, TRIANGLES, face, barycentric)[:, 2]


def area_mean(values):
    area = trimesh.Trimesh(VERTICES, TRIANGLES).area_faces
    return (values * area).sum() / area.sum()


def test_means_over_points_are_means_by_area():
    expected = area_mean(np.abs(VERTICES[TRIANGLES].mean(1)[:, 2]))
    for sampler, tolerance in ((sample_surface, 0.02), (spread_over_surface, 0.005)):
        assert abs(np.abs(heights(sampler, 4000, 1)).mean() - expected) < tolerance


def test_spread_points_vary_less_between_seeds_than_independent_ones():
    spread, independent = (
        np.std([heights(sampler, 300, seed).mean() for seed in range(20)])
        for sampler in (spread_over_surface, sample_surface)
    )
    assert spread < independent / 3


def test_every_large_triangle_gets_its_share():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 1, 5]])
    face, _ = spread_over_surface(vertices, np.array([[0, 1, 2], [0, 0, 1], [3, 4, 5]]), 40, np.random.default_rng(0))
    assert np.bincount(face, minlength=3).tolist() == [10, 0, 30]
