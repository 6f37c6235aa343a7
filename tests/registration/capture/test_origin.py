"""A capture is computed around an origin near the subject, and is the same wherever its world has its own."""

from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.capture.origin import capture_origin
from registration.capture.scan import read_scan, read_truth
from registration.capture.triangulation import triangulate
from registration.doctor.report import check_capture
from registration.errors import InputError
from registration.storage.mesh import write_ply
from tests.conftest import SHARED, needs_shared
from tests.fixtures.far_world import UTM, moved
from tests.registration.capture.small import ball, make


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


def test_far_scans_and_truths_in_float32_are_refused(tmp_path: Path) -> None:
    vertices = ball().vertices + UTM
    assert len(vertices) > 5000
    write_ply(tmp_path / "scan.ply", vertices, ball().triangles)
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.ply").vertices, vertices)
    write_ply(tmp_path / "scan.ply", vertices.astype(np.float32).astype(np.float64), ball().triangles)
    with pytest.raises(InputError, match="scan has too few digits") as caught:
        read_scan(tmp_path / "scan.ply")
    assert "double" in caught.value.fix
    np.savez(tmp_path / "ground_truth.npz", vertices=vertices)
    np.testing.assert_array_equal(read_truth(tmp_path / "ground_truth.npz"), vertices)
    np.savez(tmp_path / "ground_truth.npz", vertices=vertices.astype(np.float32))
    with pytest.raises(InputError, match="ground truth has too few digits"):
        read_truth(tmp_path / "ground_truth.npz")
    near = (ball().vertices + [70.5, 70.25, 10.125]).astype(np.float32)
    np.savez(tmp_path / "ground_truth.npz", vertices=near)
    assert len(read_truth(tmp_path / "ground_truth.npz")) == len(near)
