from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.errors import InputError
from registration.landmark_fit.fit import fit_landmarks, fit_many
from registration.landmark_fit.observations import Observations, ViewCamera
from registration.landmark_fit.options import ExpressionPrior, FitOptions, TemporalPrior
from registration.types import HeadPose
from tests.registration.landmark_fit.scenes import Scene, scheme, tiny

EXACT = FitOptions(robust=False, tolerance=1e-12, max_iterations=100)


@pytest.fixture(scope="module")
def data():
    return tiny()


def test_exact_landmarks_in_three_views_give_the_head(data):
    scene = Scene(data, scheme(data, 400), views=3, frames=2)
    fit = fit_landmarks(scene.observations(sigma=1e-4), data, EXACT)
    assert np.abs(fit.vertices(data, slice(None)) - scene.vertices).max() < 1e-6
    np.testing.assert_allclose(fit.identity, scene.identity, atol=1e-3)
    assert fit.rms_px.max() < 1e-3


def test_unknown_cameras_are_estimated(data):
    scene = Scene(data, scheme(data, 400), views=3)
    fit = fit_landmarks(scene.observations(sigma=1e-4, known=False, poses=False), data, EXACT)
    assert fit.status == "converged", fit.reason
    assert fit.cameras[0].intrinsics[0, 0] == pytest.approx(700, rel=1e-4)
    first = next(i for i, camera in enumerate(fit.cameras) if np.allclose(camera.T_cam_world, np.eye(4)))
    assert scene.views[first].T_cam_world is not None
    to_first = np.linalg.inv(scene.views[first].T_cam_world)
    for view, camera in zip(scene.views, fit.cameras, strict=True):
        np.testing.assert_allclose(camera.T_cam_world, view.T_cam_world @ to_first, atol=1e-4)


@pytest.mark.parametrize("known", [True, False])
def test_one_view_is_explained(data, known):
    scene = Scene(data, scheme(data), views=1)
    fit = fit_landmarks(scene.observations(sigma=1, noise=1, known=known), data)
    assert fit.status == "converged", fit.reason
    assert fit.rms_px[0] < 1.5
    assert (fit.focal_sigma_px[0] > 0) is not known
    projected, _ = fit.cameras[0].project(scene.scheme.points(fit.vertices(data)))
    observed = scene.observations(noise=1).points_px[0, 0]
    np.testing.assert_allclose(projected - observed, fit.residual_px[0, 0], atol=1e-6)


def test_outliers_lose_their_weight(data):
    scene = Scene(data, scheme(data, 400), views=3)
    observations = scene.observations(noise=0.5, sigma=0.5)
    observations.points_px[0, :, :40] += 60
    fit = fit_landmarks(observations, data)
    assert fit.weights[0, :, :40].max() < 0.01
    assert np.median(fit.weights[0, :, 40:]) > 0.7
    assert np.linalg.norm(fit.vertices(data) - scene.vertices[0], axis=1).mean() < 2e-3


def test_frames_share_the_identity_and_leave_it_where_it_was(data):
    scene = Scene(data, scheme(data), views=1, frames=6)
    observations = scene.observations(noise=1)
    one, all_frames = (fit_landmarks(part, data) for part in (observations.frames([0]), observations))
    deviation = np.sqrt(np.diag(one.identity_covariance))
    assert (np.abs(all_frames.identity - one.identity) < 4 * deviation).all()
    assert (np.diag(all_frames.identity_covariance) < np.diag(one.identity_covariance)).all()


def test_the_temporal_prior_smooths(data):
    scene = Scene(data, scheme(data), views=1, frames=8)
    still = scene.observations(noise=0).points_px[:1]
    points = np.repeat(still, 8, 0) + np.random.default_rng(0).normal(size=(8, *still.shape[1:])) * 2
    observations = replace(scene.observations(sigma=2), points_px=points)

    def jitter(temporal):
        fit = fit_landmarks(observations, data, FitOptions(temporal=temporal, covariance=False))
        return np.linalg.norm(np.diff(fit.vertices(data, slice(None)), 2, axis=0), axis=-1).mean()

    assert jitter(TemporalPrior()) < 0.5 * jitter(None)


def test_what_is_known_stays(data):
    scene = Scene(data, scheme(data), views=2)
    offsets = np.random.default_rng(0).normal(size=(len(data.template_vertex_positions), 3)) * 1e-3
    options = FitOptions(identity=scene.identity, offsets=offsets)
    fit = fit_landmarks(scene.observations(noise=1), data, options)
    np.testing.assert_array_equal(fit.identity, scene.identity)
    assert not fit.identity_covariance.any()


def test_a_known_pose_is_where_the_fit_begins(data):
    scene = Scene(data, scheme(data), views=2)
    observations = scene.observations(noise=1)
    pose = HeadPose(rotation=np.eye(3), translation=np.zeros(3))
    first, second = fit_landmarks(observations, data), fit_landmarks(observations, data, None, [pose])
    assert second.energy == pytest.approx(first.energy, abs=0.02)


def test_the_size_is_estimated_if_asked_for(data):
    scene = Scene(data, scheme(data, 400), views=3)
    observations = scene.observations(sigma=1e-4)
    views = []
    for view in observations.views:
        T = view.T_cam_world.copy()
        T[:3, 3] *= 1.07  # a world that is seven per cent larger
        views.append(replace(view, T_cam_world=T))
    fit = fit_landmarks(replace(observations, views=tuple(views)), data, replace(EXACT, size=True))
    assert fit.scale == pytest.approx(1.07, abs=1e-3)


def test_the_prior_of_a_model_is_used(data):
    scene = Scene(data, scheme(data), views=1)
    count = len(data.expression_basis)
    prior = ExpressionPrior(mean=np.full(count, 0.7), covariance=np.eye(count) * 1e-8)
    fit = fit_landmarks(scene.observations(noise=1), data, FitOptions(expression_prior=prior))
    np.testing.assert_allclose(fit.expression[0], 0.7, atol=1e-3)


def test_intervals_cover_the_truth(data):
    """Ninety per cent intervals of identity and vertices over subjects drawn from the priors, one pixel of noise."""
    points = scheme(data, 100)
    inside_identity, inside_vertices = [], []
    scenes = [Scene(data, points, views=2, seed=seed) for seed in range(20)]
    options = FitOptions(head_rotation=0.1, eye_rotation=0.1)
    batch = [scene.observations(noise=1, seed=seed) for seed, scene in enumerate(scenes)]
    for scene, fit in zip(scenes, fit_many(batch, data, options), strict=True):
        deviation = np.sqrt(np.diag(fit.identity_covariance))
        inside_identity.append(np.abs(fit.identity - scene.identity) < 1.645 * deviation)
        basis = np.concatenate([data.vertex_identity_basis, data.expression_basis])
        wrong = np.concatenate([fit.identity - scene.identity, fit.expression[0] - scene.expression[0]])
        axes = fit.cameras[0].T_cam_world[:3, :3]
        sigma = fit.vertex_sigma_m(data)
        assert np.isfinite(sigma).all() and (sigma >= 0).all()
        turn = torch.as_tensor(fit.rotations[0, 0])
        from registration.frames import axis_angle_to_matrix

        error = np.tensordot(wrong, basis, 1) @ (axes @ axis_angle_to_matrix(turn).numpy()).T
        moved = sigma > 1e-6
        inside_vertices.append((np.abs(error) < 1.645 * sigma)[moved])
    assert 0.85 <= np.concatenate(inside_identity).mean() <= 0.95
    assert 0.83 <= np.concatenate(inside_vertices).mean() <= 0.97


def test_many_landmarks_are_fitted_as_few_are(data):
    scene = Scene(data, scheme(data, 1600), views=1)
    fit = fit_landmarks(scene.observations(noise=1), data)
    assert fit.status == "converged" and fit.rms_px[0] == pytest.approx(np.sqrt(2), rel=0.1)
    assert np.linalg.norm(fit.residual_px.mean((0, 1, 2))) < 0.1


def test_the_same_input_gives_the_same_result(data):
    observations = Scene(data, scheme(data), views=2).observations(noise=1)
    first, second = fit_landmarks(observations, data), fit_landmarks(observations, data)
    np.testing.assert_array_equal(first.vertices(data), second.vertices(data))


def test_landmarks_of_something_else_fail(data):
    scene = Scene(data, scheme(data), views=1)
    observations = scene.observations()
    observations.points_px[:] = np.random.default_rng(0).uniform(0, 512, observations.points_px.shape)
    fit = fit_landmarks(observations, data)
    assert fit.status == "failed" and "standard deviations" in fit.reason


def _of_image(data, **changed):
    points = scheme(data)
    pixels = Scene(data, points, views=1).observations().points_px[0, 0]
    return Observations.of_image(points, changed.pop("points", pixels), (512, 512), **changed)


def test_few_landmarks_are_refused(data):
    pixels = np.full((150, 2), np.nan)
    pixels[:19] = 100
    with pytest.raises(InputError, match="Too few landmarks"):
        fit_landmarks(_of_image(data, points=pixels), data)


def test_mirrored_landmarks_are_refused(data):
    observations = Scene(data, scheme(data, front=True), views=2).observations()
    fit_landmarks(observations, data, FitOptions(max_iterations=1))
    mirrored = np.array([512, 0]) + observations.points_px * [-1, 1]
    with pytest.raises(InputError, match="mirrored"):
        fit_landmarks(replace(observations, points_px=mirrored), data)


@pytest.mark.parametrize("focal", [np.nan, 0.0, -3.0, np.inf])
def test_a_focal_length_that_is_no_number_is_refused(data, focal):
    with pytest.raises(InputError, match="focal length"):
        _of_image(data, focal_px=focal)


@pytest.mark.parametrize("sigma", [np.nan, 0.0, -1.0])
def test_a_standard_deviation_that_is_none_is_refused(data, sigma):
    with pytest.raises(InputError, match="standard deviation"):
        _of_image(data, sigma_px=sigma)


def test_shapes_that_do_not_match_are_refused(data):
    points = scheme(data)
    with pytest.raises(InputError, match="another shape"):
        Observations(
            scheme=points,
            views=(ViewCamera(width_px=10, height_px=10),),
            points_px=np.zeros((1, 2, 150, 2)),
            sigma_px=np.ones((1, 2, 150)),
        )
