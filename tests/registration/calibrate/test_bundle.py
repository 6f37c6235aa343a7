from dataclasses import replace

import numpy as np
import pytest

from registration.calibrate.bundle import Observations, adjust, project
from registration.geometry.rigid import similarity_transform
from tests.registration.calibrate.rig import (
    FOCAL_PX,
    POINTS,
    VIEWS,
    cloud,
    no_priors,
    observations,
    perturbed,
    rig,
)


def moved_points(points: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return points + generator.normal(size=points.shape) * 0.004


def test_exact_positions_give_the_true_cameras() -> None:
    generator = np.random.default_rng(0)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator, noise_px=1e-9)
    seen = replace(seen, sigma_px=np.full(len(seen), 1.0))
    start = perturbed(truth, generator, 1.02)
    result = adjust(start, moved_points(points, generator), seen, no_priors(points), max_iterations=200)
    scale, rotation, shift = similarity_transform(result.points, points, free_scale=True)
    assert result.rig.focals_px[0] == pytest.approx(FOCAL_PX, abs=0.05)
    np.testing.assert_allclose(result.rig.moved(scale, rotation, shift).positions, truth.positions, atol=1e-4)
    assert np.abs(result.residuals_px).max() < 1e-3


def test_errors_are_as_large_as_the_stated_standard_deviations() -> None:
    """Half a pixel of noise, 5 % outliers, an unknown focal length that starts 15 % off."""
    errors, positions = [], []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        truth, points = rig(generator), cloud(generator)
        seen = observations(truth, points, generator, outliers=0.05)
        start = perturbed(truth, generator)
        result = adjust(start, moved_points(points, generator), seen, no_priors(points))
        errors.append((result.rig.focals_px[0] - FOCAL_PX) / result.focal_sigma_px[0])
        assert 4 < result.focal_sigma_px[0] < 20
        assert 0.8 < result.unit_variance < 1.5
        scale, rotation, shift = similarity_transform(result.points, points, free_scale=True)
        positions.append(np.abs(result.rig.moved(scale, rotation, shift).positions - truth.positions).max())
    assert np.abs(errors).max() < 3 and np.std(errors) < 2
    assert max(positions) < 0.03  # 1 % of the focal length is 1 % of the distance of 1.25 m


def test_outliers_lose_their_weight() -> None:
    generator = np.random.default_rng(3)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator)
    wrong = generator.choice(len(seen), 20, replace=False)
    xy = seen.xy_px.copy()
    xy[wrong] += 25.0
    shifted = Observations(view=seen.view, point=seen.point, xy_px=xy, sigma_px=seen.sigma_px)
    result = adjust(truth, points, shifted, no_priors(points))
    assert result.weights[wrong].max() < 0.02
    assert np.median(np.delete(result.weights, wrong)) > 0.6


def test_focal_lengths_of_single_views_and_distortion_are_recovered() -> None:
    generator = np.random.default_rng(5)
    truth, points = rig(generator, deviation=0.03, k1=-0.5), cloud(generator)
    seen = observations(truth, points, generator, noise_px=0.05)
    priors = no_priors(points, deviation_sigma=0.03, k1_sigma=1.0)
    result = adjust(perturbed(truth, generator, 1.05), moved_points(points, generator), seen, priors)
    errors = (result.rig.view_focals_px - truth.view_focals_px) / result.view_focal_sigma_px
    assert np.abs(errors).max() < 4
    assert np.abs(result.rig.view_focals_px / truth.view_focals_px - 1).max() < 0.01
    assert abs(result.rig.k1[0] + 0.5) < 4 * result.k1_sigma[0] < 0.4


def test_priors_of_points_hold_the_gauge() -> None:
    generator = np.random.default_rng(7)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator, noise_px=0.2)
    priors = replace(no_priors(points), point_sigma_m=np.where(np.arange(POINTS) < 30, 1e-3, np.inf))
    start = perturbed(truth, generator).moved(1.1, np.eye(3), np.array([0.02, 0.0, 0.01]))
    result = adjust(start, 1.1 * points + [0.02, 0.0, 0.01], seen, priors)
    assert np.linalg.norm(result.points - points, axis=1).max() < 1e-3


def test_a_known_focal_length_stays() -> None:
    generator = np.random.default_rng(8)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator)
    priors = replace(no_priors(points), focal_sigma=np.zeros(1))
    result = adjust(truth, moved_points(points, generator), seen, priors)
    assert result.rig.focals_px[0] == FOCAL_PX and result.focal_sigma_px[0] == 0


def test_views_without_observations_stay_where_they_are() -> None:
    generator = np.random.default_rng(9)
    truth, points = rig(generator), cloud(generator)
    seen = observations(truth, points, generator)
    result = adjust(truth, points, seen.where(seen.view != 3), no_priors(points))
    np.testing.assert_array_equal(result.rig.translations[3], truth.translations[3])
    assert (np.delete(result.rig.translations, 3, 0) != np.delete(truth.translations, 3, 0)).any()


def test_points_behind_a_camera_have_no_image() -> None:
    truth = rig(np.random.default_rng(1))
    behind = truth.positions[:1] * 2
    xy = project(truth, behind, np.arange(VIEWS), np.zeros(VIEWS, np.int64))
    assert np.isnan(xy[0]).all()
