from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.capture.triangulation import covariances, residuals, reversed_jaw_points, triangulate
from registration.doctor.report import eye_distance
from registration.types import Camera, Capture, View
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.small import DISTORTIONS, YAWS_RAD, camera, distorted, landmarks_68


def capture_of(cameras: list[Camera], edit: Callable[[int, np.ndarray], None] = lambda view, rows: None) -> Capture:
    """Views with exact 68 landmarks, whose rows (x, y, confidence) `edit` then changes."""
    views = []
    for number, cam in enumerate(cameras):
        rows = np.column_stack([distorted(cam, landmarks_68()), np.ones(68)])
        edit(number, rows)
        views.append(View(name=f"cam{number}", camera=cam, image=Path("unused.png"), landmarks={"68": rows}))
    return Capture(root=Path("unused"), subject="s", expression="e", views=tuple(views))


@pytest.mark.parametrize("distortion", [(), *DISTORTIONS.values()])
def test_exact_landmarks_are_recovered(distortion: tuple[float, ...]) -> None:
    points, used, residual = triangulate(
        capture_of([camera(yaw_rad, distortion=distortion) for yaw_rad in YAWS_RAD]), "68"
    )
    np.testing.assert_allclose(points, landmarks_68(), atol=1e-8)
    assert (used == len(YAWS_RAD)).all() and (residual < 1e-4).all()


@pytest.mark.parametrize("count", [3, 5])
def test_one_wrong_view_is_an_outlier(count: int) -> None:
    def swap_sides(view: int, rows: np.ndarray) -> None:
        if view == 1:
            rows[:, 0] = 120 - rows[:, 0]
            rows[:, 1] += 25

    capture = capture_of([camera(yaw_rad) for yaw_rad in YAWS_RAD[:count]], swap_sides)
    points, used, residual = triangulate(capture, "68")
    np.testing.assert_allclose(points, landmarks_68(), atol=1e-8)
    assert (used == count - 1).all() and (residual < 1e-4).all()
    assert (residuals(capture.views[1], "68", points) > 5).all()
    assert (residuals(capture.views[0], "68", points) < 1e-4).all()


def test_the_solution_minimizes_the_reprojection_error() -> None:
    rng = np.random.default_rng(0)

    def blur(view: int, rows: np.ndarray) -> None:
        rows[:, :2] += rng.normal(0, 0.2, (68, 2))

    capture = capture_of([camera(yaw_rad) for yaw_rad in np.linspace(-1.2, 1.2, 12)], blur)
    points, used, residual = triangulate(capture, "68")
    assert (used == 12).all()

    def cost(xyz: np.ndarray) -> np.ndarray:
        return np.stack([residuals(view, "68", xyz) ** 2 for view in capture.views]).mean(0)

    np.testing.assert_allclose(cost(points), residual**2, rtol=1e-9)
    for step in 3e-5 * np.concatenate([np.eye(3), -np.eye(3)]):  # about 0.02 px
        assert (cost(points + step) > cost(points)).mean() > 0.98
    assert np.linalg.norm(points - landmarks_68(), axis=-1).mean() < 4e-4


def test_confidence_and_number_of_views() -> None:
    def hide(view: int, rows: np.ndarray) -> None:
        rows[3, 2] = 0.5  # not used
        rows[4, 2] = 0.6 if view < 2 else 0.0
        rows[5, 2] = 1.0 if view == 0 else 0.0

    points, used, residual = triangulate(capture_of([camera(yaw_rad) for yaw_rad in YAWS_RAD], hide), "68")
    assert used[3] == 0 and used[4] == 2 and used[5] == 0
    assert np.isnan(points[[3, 5]]).all() and np.isnan(residual[[3, 5]]).all()
    np.testing.assert_allclose(points[4], landmarks_68()[4], atol=1e-8)


def test_cameras_at_one_position_determine_no_depth() -> None:
    points, used, _ = triangulate(capture_of([camera(0.2), camera(0.2, width_px=240, height_px=320)]), "68")
    assert np.isnan(points).all() and (used == 0).all()


def test_a_scheme_that_no_view_has_gives_no_points() -> None:
    points, used, residual = triangulate(capture_of([camera(yaw_rad) for yaw_rad in YAWS_RAD]), "478")
    assert points.shape == (0, 3) and used.shape == residual.shape == (0,)


def test_views_without_the_scheme_are_skipped() -> None:
    capture = capture_of([camera(yaw_rad) for yaw_rad in YAWS_RAD])
    capture = replace(capture, views=(replace(capture.views[0], landmarks={}), *capture.views[1:]))
    points, used, _ = triangulate(capture, "68")
    np.testing.assert_allclose(points, landmarks_68(), atol=1e-8)
    assert (used == len(YAWS_RAD) - 1).all()


def test_jaw_order() -> None:
    points = landmarks_68()
    assert reversed_jaw_points(points) == []
    reversed_points = points.copy()
    reversed_points[2:7] = reversed_points[2:7][::-1]
    assert reversed_jaw_points(reversed_points) == []  # as in Google's first file
    reversed_points = points.copy()
    reversed_points[10:15] = reversed_points[10:15][::-1]
    assert reversed_jaw_points(reversed_points) == [10, 11, 12, 13, 14]
    mirrored = points.copy()
    mirrored[:17] = mirrored[:17][::-1]
    assert reversed_jaw_points(mirrored) == list(range(17))
    points[[4, 9]] = np.nan
    assert reversed_jaw_points(points) == []
    points[27] = np.nan
    assert reversed_jaw_points(points) == []


@needs_shared
def test_shared_landmarks() -> None:
    captures = SHARED / "data" / "captures"
    for name in ("gnm_identity_a/neutral", "ict_dev/jaw_open"):
        points, used, residual = triangulate(native.read_capture(captures / name), "68")
        distance = eye_distance(points)
        assert distance is not None and 0.085 < distance < 0.095
        assert used.min() >= 9 and residual.max() < 0.01
        assert reversed_jaw_points(points) == []


def test_precise_detections_outweigh_vague_ones_and_the_covariance_says_how_well_a_point_is_known() -> None:
    rng, spread = np.random.default_rng(3), np.array([0.05, 1.0] * 4)
    cameras = [camera(yaw_rad) for yaw_rad in np.linspace(-1.2, 1.2, 8)]

    def blur(view: int, rows: np.ndarray) -> None:
        rows[:, :2] += rng.normal(0, spread[view], (68, 2))

    plain = capture_of(cameras, blur)
    known = [
        replace(view, landmark_spread_px={"68": np.full(68, s)}) for view, s in zip(plain.views, spread, strict=True)
    ]
    stated = replace(plain, views=tuple(known))
    errors = {name: triangulate(c, "68")[0] - landmarks_68() for name, c in (("plain", plain), ("stated", stated))}
    rms = {name: np.sqrt(np.square(error).mean()) for name, error in errors.items()}
    assert rms["stated"] < 0.3 * rms["plain"]
    covariance = covariances(stated, "68", triangulate(stated, "68")[0])
    distance = np.einsum("li,lij,lj->l", errors["stated"], np.linalg.inv(covariance), errors["stated"])
    assert 0.6 * 3 < distance.mean() < 1.4 * 3  # chi-square with three degrees of freedom


def test_detections_that_disagree_enlarge_the_covariance() -> None:
    def variance(noise_px: float) -> float:
        rng = np.random.default_rng(4)

        def blur(view: int, rows: np.ndarray) -> None:
            rows[:, :2] += rng.normal(0, noise_px, (68, 2))

        capture = capture_of([camera(yaw_rad) for yaw_rad in np.linspace(-1.2, 1.2, 8)], blur)
        spread = {"68": np.full(68, 0.05)}
        capture = replace(capture, views=tuple(replace(view, landmark_spread_px=spread) for view in capture.views))
        result = covariances(capture, "68", triangulate(capture, "68")[0])
        return float(np.median(np.trace(result, axis1=1, axis2=2)))

    assert variance(0.09) > 1.5 * variance(0.05) and variance(0.01) == pytest.approx(variance(0.02), rel=0.01)
