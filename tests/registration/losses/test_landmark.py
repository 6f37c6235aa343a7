"""Landmarks: projection against `Camera.project`, residuals by hand, and a mean that is robust against outliers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.losses import landmark
from registration.types import Camera, Pixels, Targets


def cameras() -> tuple[Camera, ...]:
    pose = np.eye(4)
    pose[:3, 3] = [0.01, -0.02, 0.5]
    rotated = np.array([[0, 0, 1.0, 0], [0, 1, 0, 0], [-1, 0, 0, 0.6], [0, 0, 0, 1]])
    intrinsics = np.array([[200.0, 0, 61.3], [0, 210.0, 48.9], [0, 0, 1]])
    return tuple(
        Camera(width_px=120, height_px=100, intrinsics=intrinsics, T_cam_world=T_cam_world)
        for T_cam_world in (pose, rotated)
    )


POINTS = 0.08 * np.random.default_rng(0).standard_normal((5, 3))


def test_projection_equals_that_of_the_camera():
    projected = landmark.project(cameras(), torch.tensor(POINTS))
    for camera, image in zip(cameras(), projected, strict=True):
        np.testing.assert_allclose(image, camera.project(POINTS)[0], rtol=1e-12)


def test_residuals_by_hand():
    """3 and 4 px off are 5; at a head of 256 px that is 10 of the standard head; confidence 0.5 is not enough."""
    detected = torch.tensor(np.stack([np.column_stack([c.project(POINTS)[0], np.ones(5)]) for c in cameras()]))
    detected[0, 0, :2] += torch.tensor([3.0, -4.0])
    detected[1, 2, 2], detected[1, 3, 2], detected[0, 1, 2] = 0.5, 0.51, 0.0
    distance, counts = landmark.residuals(cameras(), torch.tensor(POINTS), detected, 256.0)
    expected = torch.zeros(2, 5, dtype=torch.float64)
    expected[0, 0] = 10
    torch.testing.assert_close(distance, expected, atol=1e-5, rtol=0)
    assert counts.tolist() == [[1, 0, 1, 1, 1], [1, 1, 0, 1, 1]]


def test_robust_mean_by_hand():
    residual = torch.tensor([0.0, 3.0, 300.0, 1e6], dtype=torch.float64)
    weight = torch.tensor([1.0, 1, 1, 0], dtype=torch.float64)
    expected = (0 + 0.5 + 1e4 / (1 + 1e4)) / 3
    assert landmark.geman_mcclure(residual, weight, 3.0).item() == pytest.approx(expected)
    small = torch.tensor([0.03], dtype=torch.float64)
    assert landmark.geman_mcclure(small, torch.ones(1), 3.0).item() == pytest.approx(1e-4, rel=1e-3)
    assert landmark.geman_mcclure(residual, torch.zeros(4), 3.0).item() == 0


def test_an_outlier_has_little_gradient():
    residual = torch.tensor([3.0, 300.0], dtype=torch.float64, requires_grad=True)
    landmark.geman_mcclure(residual, torch.ones(2), 3.0).backward()
    assert 0 < residual.grad[1] < 1e-5 * residual.grad[0]


def test_gradient_through_projection():
    detected = torch.tensor(np.stack([np.column_stack([c.project(POINTS)[0] + 2, np.ones(5)]) for c in cameras()]))

    def cost(points: torch.Tensor) -> torch.Tensor:
        distance, counts = landmark.residuals(cameras(), points, detected, 300.0)
        return landmark.geman_mcclure(distance, counts, 3.0)

    assert torch.autograd.gradcheck(cost, torch.tensor(POINTS, requires_grad=True))


def test_a_perfect_fit_has_a_finite_gradient():
    points = torch.tensor(POINTS, requires_grad=True)
    detected = torch.tensor(np.stack([np.column_stack([c.project(POINTS)[0], np.ones(5)]) for c in cameras()]))
    distance, counts = landmark.residuals(cameras(), points, detected, 300.0)
    landmark.geman_mcclure(distance, counts, 3.0).backward()
    assert points.grad.isfinite().all() and points.grad.abs().max() < 1e-3


def exactly_detected() -> torch.Tensor:
    return torch.tensor(np.stack([np.column_stack([c.project(POINTS)[0], np.ones(5)]) for c in cameras()]))


def test_pixels_per_metre_are_those_of_a_small_motion_across_the_line_of_sight():
    scale = landmark.px_per_m(cameras(), torch.tensor(POINTS))
    for camera, row in zip(cameras(), scale, strict=True):
        right = camera.T_cam_world[0, :3]
        moved = np.linalg.norm(camera.project(POINTS + 1e-6 * right)[0] - camera.project(POINTS)[0], axis=1) / 1e-6
        np.testing.assert_allclose(row, moved * np.sqrt(210 / 200), rtol=1e-4)


def test_views_do_not_reduce_the_error_that_they_have_in_common():
    """Information of N detections of 2 px, at 1000 px/m, of a point known to 3 mm: 1 / (3^2 + 2^2 / N) per mm^2."""
    count = 6
    lens = np.array([[1000.0, 0, 0], [0, 1000, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[2, 3] = 1.0
    rig = (Camera(width_px=9, height_px=9, intrinsics=lens, T_cam_world=pose),) * count
    points = torch.zeros(1, 3, dtype=torch.float64)
    spread = landmark.Spread(
        detections_px=torch.full((count, 1), 2.0, dtype=torch.float64), scheme_m=torch.full((1,), 3e-3).double()
    )
    share = spread.shares(rig, points, torch.ones(count, 1))
    assert (share / 2**2 * count).item() == pytest.approx(1 / (3**2 + 2**2 / count))
    residual = torch.full((count, 1), 1e-3, dtype=torch.float64)
    loss = landmark.likelihood(
        residual, torch.ones(count, 1), spread.detections_px, spread.total_px(rig, points), share
    )
    assert loss.item() == pytest.approx(1e-6 / (3**2 + 2**2 / count) / count, rel=1e-5)


def test_the_likelihood_of_equal_spreads_is_the_squared_residual_over_it_and_bounded():
    ones, share = torch.ones(1, 3).double(), torch.ones(3).double()
    spread = torch.full((1, 3), 2.0).double()
    for residual, expected in ((0.02, 1e-4), (6.0, 4.5), (1e6, 9.0)):
        loss = landmark.likelihood(residual * ones, ones, spread, spread, share).item()
        assert loss == pytest.approx(expected, rel=1e-3)
    assert landmark.likelihood(ones, 0 * ones, spread, spread, share).item() == 0


def test_a_spread_is_known_if_the_detector_or_the_scheme_states_it():
    stated = torch.tensor([[0.5] * 5, [torch.nan] * 5])
    few = Pixels.full(cameras()[:1])
    values = {name: torch.zeros(len(few.view)) for name in ("rgb", "normal", "mask", "class")}
    targets = Targets(
        names=("a", "b"),
        class_names=("skin",),
        pixels=few,
        rgb=torch.zeros(len(few.view), 3),
        normals=torch.zeros(len(few.view), 3),
        mask=values["mask"],
        classes=torch.zeros(len(few.view), 1),
        landmarks={"s": exactly_detected()},
        px_per_head=256.0,
        **{f"{name}_weight": value for name, value in values.items()},
    )
    assert landmark.Spread.of("s", targets, None) is None
    unknown = landmark.Spread.of("s", targets, np.full(5, 2e-3))
    assert (unknown.detections_px == 1.5).all() and (unknown.scheme_m == 2e-3).all()
    known = landmark.Spread.of("s", replace(targets, landmark_spread_px={"s": stated}), None)
    assert (known.detections_px[0] == 0.5).all() and (known.detections_px[1] == 1.5).all()
    assert (known.scheme_m == 0).all()
