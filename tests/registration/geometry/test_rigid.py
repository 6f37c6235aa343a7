import numpy as np
from scipy.spatial.transform import Rotation

from registration.frames import transform_points
from registration.geometry.rigid import align, angle_deg, fit_twists, motion_fields


def some_points(count: int = 50, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.1, (count, 3)) + (0.3, -1.0, 2.0)


def some_motions(count: int = 4) -> np.ndarray:
    rng = np.random.default_rng(1)
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    motions[:, :3, 3] = rng.normal(size=(count, 3))
    return motions


def test_a_known_motion_is_found_whatever_has_no_weight():
    points, motions = some_points(), some_motions()
    source = np.stack([transform_points(np.linalg.inv(motion), points) for motion in motions])
    weights = np.random.default_rng(2).uniform(0.1, 1, source.shape[:2])
    source[:, :20] += 5.0
    weights[:, :20] = 0
    np.testing.assert_allclose(align(source, points, weights), motions, atol=1e-9)


def test_no_alignment_is_a_reflection():
    points = some_points(4)
    found = align((points * (1, 1, -1))[None], points, np.ones((1, 4)))
    assert np.linalg.det(found[0, :3, :3]) > 0.999


def test_without_weights_nothing_moves():
    np.testing.assert_array_equal(align(some_points()[None], some_points(seed=3), np.zeros((1, 50)))[0], np.eye(4))


def test_angles_are_exact_when_small():
    for degrees in (1e-6, 0.1, 90.0, 179.0):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        np.testing.assert_allclose(angle_deg(motion[None]), [degrees], rtol=1e-9)


def test_twists_are_the_motion_to_first_order():
    points = some_points()
    twist = np.array([[1e-5, -2e-5, 3e-5, 1e-3, 0, -2e-3]])
    moved = Rotation.from_rotvec(twist[0, :3]).apply(points) + twist[0, 3:] - points
    np.testing.assert_allclose(np.tensordot(twist, motion_fields(points), 1)[0], moved, atol=1e-8)
    weights = np.random.default_rng(4).uniform(0.1, 1, 50)
    np.testing.assert_allclose(fit_twists(moved[None], points, weights), twist, atol=1e-8)


def test_a_twist_leaves_a_residual_that_no_twist_shares():
    points, weights = some_points(), np.random.default_rng(4).uniform(0.1, 1, 50)
    field = np.random.default_rng(5).normal(size=(1, 50, 3))
    rest = field - np.tensordot(fit_twists(field, points, weights), motion_fields(points), 1)
    np.testing.assert_allclose(fit_twists(rest, points, weights), 0, atol=1e-9)
