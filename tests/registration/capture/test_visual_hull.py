"""Points outside the masks of a ball are no part of it; one wrong mask does not matter."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.visual_hull import outside_masks
from tests.registration.capture import small


def shell(radius_m: float) -> np.ndarray:
    direction = np.random.default_rng(0).standard_normal((3000, 3))
    return radius_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)


@pytest.mark.parametrize("distortion", [(), small.DISTORTIONS["OPENCV"]])
def test_the_ball_is_inside_and_hair_is_not(tmp_path: Path, distortion: tuple[float, ...]) -> None:
    capture = native.read_capture(small.make(tmp_path / "capture", distortion=distortion))
    assert not outside_masks(capture, shell(small.RADIUS_M)).any()
    hair = shell(small.RADIUS_M + 0.02)
    found = outside_masks(capture, hair)
    assert found.mean() > 0.4
    # The cameras are along the horizon, so that nearly all of them see beside the ball above and below it.
    assert found[np.abs(hair[:, 1]) > 0.1].mean() > 0.95


def test_one_wrong_mask_is_outvoted_and_none_says_nothing(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture")
    file = root / "masks" / "cam0.png"
    empty = np.zeros_like(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    empty[0, 0] = 255
    cv2.imwrite(str(file), empty)
    assert not outside_masks(native.read_capture(root), shell(small.RADIUS_M)).any()
    bare = native.read_capture(small.make(tmp_path / "bare", drop=("mask",)))
    assert not outside_masks(bare, shell(0.2)).any()
