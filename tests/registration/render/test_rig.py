"""The studio's rig: framing, sizes, lenses and bad options."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from registration.errors import InputError
from registration.render.studio.rig import HEAD_FRACTION, MAX_SIDE_PX, SPREAD_DEG, RigOptions, make_rig


def test_the_rig_frames_the_head_from_its_specified_angles():
    cameras = make_rig(RigOptions(cameras=22, size_px=(480, 720), seed=4))
    out = np.stack([camera.centre for camera in cameras])
    yaw, pitch = (
        np.degrees(np.arctan2(out[:, 0], out[:, 2])),
        np.degrees(np.arcsin(out[:, 1] / np.linalg.norm(out, axis=1))),
    )
    for angles, spread_deg in ((yaw, SPREAD_DEG[0]), (pitch, SPREAD_DEG[1])):
        assert np.ptp(angles) == pytest.approx(spread_deg, abs=6)
    assert np.linalg.norm(out, axis=1) == pytest.approx(1.2, rel=0.05)
    tall = np.array([[0, -0.17, 0], [0, 0.17, 0]])
    for camera in cameras:
        middle = camera.project(np.zeros((1, 3)))[0][0] / (480, 720)
        assert np.abs(middle - 0.5).max() < 0.03
        height = np.ptp(camera.project(tall)[0][:, 1]) / 720
        assert HEAD_FRACTION * np.cos(np.radians(34)) * 0.93 < height < HEAD_FRACTION * 1.08
    assert (
        len({camera.intrinsics[0, 0] for camera in cameras})
        == len({camera.intrinsics[0, 2] for camera in cameras})
        == 22
    )
    rotated = make_rig(RigOptions(cameras=1), R_world_head=np.diag([-1.0, 1, -1]), centre=np.array([1.0, 2, 3]))[0]
    assert (rotated.centre - (1, 2, 3))[2] < -1.1


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 22, 40])
def test_rigs_of_any_size(count):
    assert len(make_rig(RigOptions(cameras=count, size_px=(64, 48)))) == count


def test_the_lens_displaces_corners_by_a_few_pixels():
    for camera in make_rig(RigOptions(cameras=6, size_px=(480, 720), seed=1, distortion=True)):
        corners = np.array([[1.0, 1], [479, 1], [1, 719], [479, 719]])
        straight = cv2.undistortPoints(
            corners[:, None], camera.intrinsics, np.array(camera.distortion), P=camera.intrinsics
        )
        displacement_px = np.linalg.norm(straight[:, 0] - corners, axis=1)
        assert 0.5 < displacement_px.max() < 30


@pytest.mark.parametrize(
    "settings",
    [
        {"cameras": 0},
        {"cameras": -3},
        {"size_px": (0, 100)},
        {"size_px": (100, -1)},
        {"size_px": (MAX_SIDE_PX + 1, 100)},
        {"spread_deg": (400.0, 10.0)},
    ],
)
def test_invalid_rigs_are_refused(settings):
    with pytest.raises(InputError) as caught:
        make_rig(RigOptions(**settings))
    assert "expected" in str(caught.value) and "fix" in str(caught.value)


@pytest.mark.parametrize("height_m", [0.0, float("nan")])
def test_a_rig_needs_a_positive_head_height(height_m):
    with pytest.raises(InputError, match="height"):
        make_rig(head_height_m=height_m)


def test_the_rig_needs_no_renderer():
    code = "import sys, registration.render.studio.rig; assert 'mitsuba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
