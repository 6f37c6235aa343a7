"""A capture is computed around an origin near the subject, and is the same wherever its world has its own."""

from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.capture.doctor import check_capture
from registration.capture.origin import capture_origin
from registration.capture.triangulation import triangulate
from tests.conftest import SHARED, needs_shared
from tests.fixtures.far_world import UTM, moved
from tests.registration.capture.small import make


@pytest.mark.parametrize("shift", [UTM, UTM + [0.25, 0.5, 0.125], [70.5, 70.25, 10.125], [-6.4e6, 1e5, 2.0]])
def test_a_far_capture_has_the_landmarks_of_a_near_one(tmp_path: Path, shift: np.ndarray) -> None:
    shift = np.asarray(shift)
    root = make(tmp_path / "near")
    near, far = native.read_capture(root), native.read_capture(moved(root, tmp_path / "far", shift))
    assert not capture_origin([view.camera for view in near.views]).any()
    origin = capture_origin([view.camera for view in far.views])
    assert np.linalg.norm(origin - shift) < 1 and (origin == np.round(origin)).all()
    for a, b in zip(near.views, far.cameras_relative_to(shift).views, strict=True):
        np.testing.assert_allclose(a.camera.T_cam_world, b.camera.T_cam_world, atol=1e-8)
    (points, used, residuals), (far_points, far_used, far_residuals) = triangulate(near, "68"), triangulate(far, "68")
    np.testing.assert_allclose(far_points - shift, points, atol=1e-7)
    np.testing.assert_array_equal(used, far_used)
    np.testing.assert_allclose(residuals, far_residuals, atol=1e-4)


def test_a_far_capture_passes_without_warnings(tmp_path: Path) -> None:
    root = make(tmp_path / "near")
    near, far = check_capture(root), check_capture(moved(root, tmp_path / "far"))
    assert near.eye_distance_mm == pytest.approx(far.eye_distance_mm, abs=1e-4)
    assert [view.row for view in near.views] == [view.row for view in far.views] and near.warnings == far.warnings


@needs_shared
def test_near_captures_are_computed_in_their_own_world() -> None:
    for capture in sorted((SHARED / "data" / "captures").glob("*/*")):
        if (capture / "capture.toml").is_file():
            assert not capture_origin([view.camera for view in native.read_capture(capture).views]).any(), capture
