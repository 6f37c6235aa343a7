"""Fits to scans: known distances from a plane and a sphere, sliding vertices, and the least-squares minimum."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coregister.evaluate import linear_fit
from coregister.evaluate.linear_fit import LinearFit, LinearPart
from coregister.evaluate.scan_fit import fit_scan, points_on_skin
from registration.frames import transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.surface_samples import sample_surface
from registration.model import gnm_npz, regions
from tests.coregister.spectrum import heads, spectrum_model


def grid(steps, size):
    """A square in z = 0."""
    axis = np.linspace(-size / 2, size / 2, steps)
    x, y = np.meshgrid(axis, axis)
    index = np.arange(steps * steps).reshape(steps, steps)
    a, b, c, d = (index[i : i + steps - 1, j : j + steps - 1].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    triangles = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(steps * steps)], 1), triangles


def initial(count=0, pose=None):
    return LinearFit(
        coefficients=np.zeros(count),
        T_model_world=np.eye(4) if pose is None else pose,
        distance_mm=np.zeros(0),
        converged=True,
    )


def rigid(x, y, z, rotation=(0, 0, 0)):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), (x, y, z)
    return pose


def surface_points(part, shape, count, seed):
    rng = np.random.default_rng(seed)
    face = rng.integers(0, len(part.triangles), count)
    return barycentric_points(shape, part.triangles, face, rng.dirichlet((1.0, 1.0, 1.0), count))


def test_distances_of_a_scan_above_and_below_a_plane():
    vertices, triangles = grid(9, 0.2)
    part = LinearPart(
        rows=np.arange(len(vertices)), rest=vertices, basis=np.zeros((0, *vertices.shape)), triangles=triangles
    )
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-0.08, 0.08, (600, 2)), np.where(np.arange(600) % 2, 1e-3, -1e-3)]
    fit = fit_scan(part, points, [initial(pose=rigid(0, 0, 4e-3, (0.05, -0.03, 0)))])[0]
    assert fit.converged
    np.testing.assert_allclose(fit.distance_mm, 1.0, atol=0.15)  # 600 points do not balance exactly
    assert fit.distance_mm.mean() == pytest.approx(1.0, abs=5e-3)


def sphere(level=3):
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=level, radius=0.1)
    vertices = np.asarray(mesh.vertices)
    return vertices, np.asarray(mesh.faces)


def test_the_distance_of_a_sphere_is_the_difference_of_radii_without_a_component_for_it():
    vertices, triangles = sphere()
    radial = vertices[None] / 0.1 * 1e-3  # a coefficient of one: 1 mm
    part = LinearPart(rows=np.arange(len(vertices)), rest=vertices, basis=radial, triangles=triangles)
    rng = np.random.default_rng(1)
    points = rng.standard_normal((2000, 3))
    points *= 0.103 / np.linalg.norm(points, axis=1, keepdims=True)
    centre = np.array([0.004, -0.002, 0.003])
    points += centre
    fixed, free = fit_scan(part, points, [initial(0), initial(1)])
    faceted = 0.1 * 1e3 * 0.5 * (0.5 * 2 * np.sin(np.radians(63.4 / 8) / 2)) ** 2  # chords are inside by about this
    assert fixed.converged and free.converged
    assert fixed.distance_mm.mean() == pytest.approx(3.0, abs=3 * faceted)
    assert free.distance_mm.mean() < faceted
    assert free.coefficients[0] == pytest.approx(3.0, abs=3 * faceted)
    np.testing.assert_allclose(transform_points(free.T_model_world, centre[None])[0], 0, atol=1e-4)


@pytest.fixture(scope="module")
def model():
    return spectrum_model()


def test_sliding_along_the_surface_has_no_distance(model):
    part = linear_fit.identity_part(model)
    coefficients = np.random.default_rng(2).standard_normal(len(part.basis))
    truth = heads(model, coefficients[None])[0, part.rows]
    pose = rigid(0.3, -0.2, 1.0, (0.4, 1.9, -0.3))
    points = transform_points(pose, surface_points(part, truth, 3000, 3))
    # The initial guess is on the surface, but its vertices have slid: correspondence is wrong.
    slid = transform_points(pose, truth + np.random.default_rng(4).normal(0, 1e-3, truth.shape))
    guess = linear_fit.fit_correspondence(part, slid, [12])
    fit = fit_scan(part, points, guess)[0]
    assert guess[0].distance_mm.mean() > 0.3
    assert fit.converged
    assert fit.distance_mm.max() < 1e-3
    np.testing.assert_allclose(fit.coefficients, coefficients, atol=1e-2)


def test_fits_reach_the_least_squares_minimum(model):
    part = linear_fit.identity_part(model)
    rng = np.random.default_rng(5)
    truth = part.shape(rng.standard_normal(12)) + rng.normal(0, 4e-4, part.rest.shape)  # outside the model
    points = surface_points(part, truth, 800, 6)
    guess = linear_fit.fit_correspondence(part, truth, [4])
    fit = fit_scan(part, points, guess)[0]
    assert fit.converged

    def residual(variables):
        pose = rigid(*variables[7:], variables[4:7]) @ guess[0].T_model_world
        return 1e3 * closest_points(transform_points(pose, points), part.shape(variables[:4]), part.triangles)[0]

    reference = least_squares(
        residual, np.r_[guess[0].coefficients, np.zeros(6)], x_scale=np.r_[np.ones(4), 1e-2 * np.ones(6)]
    )
    mean_square = (fit.distance_mm**2).mean()
    assert mean_square < 0.995 * (residual(np.r_[guess[0].coefficients, np.zeros(6)]) ** 2).mean()  # the fit improved
    assert mean_square == pytest.approx(2 * reference.cost / len(points), rel=5e-3)


def test_fits_are_deterministic(model):
    part = linear_fit.identity_part(model)
    points = surface_points(part, part.rest, 6000, 7)  # more than a fit uses
    guess = linear_fit.fit_correspondence(
        part, part.rest + 1e-3 * np.random.default_rng(8).standard_normal(part.rest.shape), [4]
    )
    first, second = (fit_scan(part, points, guess, seed=9)[0] for _ in range(2))
    np.testing.assert_array_equal(first.coefficients, second.coefficients)
    assert len(first.distance_mm) == 6000


def test_points_on_eyeballs_are_no_skin(model_file):
    """A scan of skin and eyeballs of a head of the model: the skin is explained exactly, in spite of the eyeballs."""
    data = gnm_npz.read(model_file)
    exterior, balls = regions.exterior(data), np.any(regions.eyeball_shells(data), axis=0)
    part = linear_fit.identity_part(data, exterior)
    coefficients = np.random.default_rng(3).standard_normal(5)
    head = data.template_vertex_positions + np.tensordot(coefficients, data.vertex_identity_basis[:5], 1)
    scan = []
    for members, count in ((exterior, 3000), (balls, 600)):
        triangles = data.triangles[members[data.triangles].all(1)].astype(np.int64)
        samples = sample_surface(head, triangles, count, np.random.default_rng(0))
        scan.append(barycentric_points(head, triangles, *samples))
    visible = scan[1][scan[1][:, 2] > head[balls, 2].max() - 0.006]  # the front, between the lids
    points = np.concatenate([scan[0], visible])
    left = points_on_skin(points, head, data)
    assert len(visible) > 30 and np.array_equal(left, scan[0])
    guess = linear_fit.fit_correspondence(part, head[part.rows], [5])
    assert (
        fit_scan(part, left, guess)[0].distance_mm.mean() < 1e-4 < fit_scan(part, points, guess)[0].distance_mm.mean()
    )
