from dataclasses import replace

import numpy as np
import pytest

from registration.calibrate.bundle import Observations, project
from registration.calibrate.structure import pose, robust_pose, triangulate
from tests.registration.calibrate.rig import FOCAL_PX, POINTS, cloud, observations, rig

K = np.array([[FOCAL_PX, 0, 240.0], [0, FOCAL_PX, 360.0], [0, 0, 1.0]])


def test_rays_meet_in_the_points_despite_outliers() -> None:
    generator = np.random.default_rng(0)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator, noise_px=0.3, outliers=0.05)
    found, good = triangulate(truth, seen, POINTS, 4.0)
    assert good.mean() > 0.95
    error = np.linalg.norm(found - points, axis=1)[good]
    assert np.median(error) < 4e-4 and np.quantile(error, 0.95) < 3e-3


def test_points_of_one_view_or_of_parallel_rays_are_not_triangulated() -> None:
    generator = np.random.default_rng(1)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator)
    assert not triangulate(truth, seen.where((seen.view == 0) & (seen.point == 0)), POINTS, 4.0)[1].any()
    both = np.arange(2)
    close = replace(
        truth,
        rotations=truth.rotations[[0, 0]],
        translations=truth.translations[[0, 0]] + [[0, 0, 0], [0.02, 0, 0]],
        centres_px=truth.centres_px[:2],
        group=truth.group[:2],
        deviation=truth.deviation[:2],
    )
    xy = project(close, points[:1], both, both * 0)
    two = Observations(view=both, point=both * 0, xy_px=xy, sigma_px=np.ones(2))
    assert not triangulate(close, two, 1, 4.0)[1].any()


@pytest.mark.parametrize("robust", [False, True])
def test_a_pose_is_found_from_points(robust: bool) -> None:
    generator = np.random.default_rng(2)
    truth, points = rig(generator), cloud(generator)
    xy = project(truth, points, np.full(POINTS, 3), np.arange(POINTS)) + generator.normal(size=(POINTS, 2)) * 0.2
    if robust:
        xy[:60] += generator.uniform(-80, 80, size=(60, 2))
        found = robust_pose(points, xy, K, 3.0)
        assert found is not None and 80 < len(found[2]) < 110
    else:
        found = pose(points, xy, K)
    assert found is not None
    np.testing.assert_allclose(found[0], truth.rotations[3], atol=2e-3)
    np.testing.assert_allclose(found[1], truth.translations[3], atol=5e-3)


def test_too_few_points_and_noise_give_no_pose() -> None:
    generator = np.random.default_rng(4)
    points = cloud(generator)
    assert robust_pose(points[:5], np.zeros((5, 2)), K, 3.0) is None
    found = robust_pose(points, generator.uniform(0, 480, size=(POINTS, 2)), K, 2.0)
    assert found is None or len(found[2]) < 0.2 * POINTS
