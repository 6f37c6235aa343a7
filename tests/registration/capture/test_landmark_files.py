"""Landmark files with a spread per point, from disk to disk."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.capture.landmark_files import moved_spread, read_landmarks, write_landmarks
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.capture.pixels import undistort_landmarks, undistorted_spread
from registration.errors import InputError
from registration.types import View
from tests.registration.capture.small import DISTORTIONS, camera, synthetic_view


def file_of(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "view.json"
    path.write_text(json.dumps(content))
    return path


def test_a_fourth_number_is_the_spread(tmp_path: Path) -> None:
    path = file_of(tmp_path, {"face": [[1, 2, 0.9, 1.5], None, [3, 4, 0, 2]], "68": [[5, 6, 1]]})
    marks = read_landmarks(path)
    np.testing.assert_array_equal(marks.points["face"], [[1, 2, 0.9], [0, 0, 0], [3, 4, 0]])
    np.testing.assert_array_equal(marks.spread_px["face"], [1.5, 1, 2])
    assert list(marks.spread_px) == ["face"]
    write_landmarks(path, marks.points, marks.spread_px)
    again = read_landmarks(path)
    np.testing.assert_array_equal(again.spread_px["face"], marks.spread_px["face"])
    np.testing.assert_array_equal(again.points["68"], marks.points["68"])


@pytest.mark.parametrize("spread", [0, -1, float("nan"), float("inf"), None])
def test_a_spread_that_is_none_is_refused(tmp_path: Path, spread: object) -> None:
    with pytest.raises(InputError, match="malformed") as caught:
        read_landmarks(file_of(tmp_path, {"face": [[1, 2, 1, 1], [1, 2, 1, spread]]}))
    assert "face" in str(caught.value)


def test_all_points_of_a_scheme_have_a_spread_or_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="three or four numbers"):
        read_landmarks(file_of(tmp_path, {"face": [[1, 2, 1, 1], [1, 2, 1]]}))


def test_a_written_capture_keeps_the_spread(tmp_path: Path) -> None:
    views = [synthetic_view(f"cam{i}", camera(0.3 * i)) for i in range(2)]
    spread = np.linspace(0.5, 3, 68)
    views = [replace(view, landmark_spread_px={"68": spread}) for view in views]
    root = write_capture(tmp_path / "capture", views, CaptureDescription(subject="s", expression="e"))
    for view in native.read_capture(root).views:
        np.testing.assert_array_equal(view.landmark_spread_px["68"], spread)
        assert view.landmarks["68"].shape == (68, 3)


def test_spread_follows_a_map_of_the_points() -> None:
    points = np.random.default_rng(0).uniform(0, 100, (5, 3))
    spread, order = np.arange(1.0, 6), [4, 3, 2, 1, 0]
    moved = moved_spread(lambda p: (p * [2, 2, 1] + [7, 0, 0])[order], points, spread)
    np.testing.assert_allclose(moved, 2 * spread[order], rtol=1e-9)


def test_spread_without_distortion_is_that_of_noisy_landmarks() -> None:
    lens = camera(distortion=DISTORTIONS["RADIAL"])
    points = np.column_stack([np.random.default_rng(1).uniform(10, 110, (4, 2)), np.ones(4)])
    view = View(
        name="cam", camera=lens, image=Path(), landmarks={"s": points}, landmark_spread_px={"s": np.full(4, 0.1)}
    )
    noise = 0.1 * np.random.default_rng(2).standard_normal((300, 4, 2))
    noisy = [replace(view, landmarks={"s": points + np.pad(n, [(0, 0), (0, 1)])}) for n in noise]
    samples = np.stack([undistort_landmarks(v, "s")[:, :2] for v in noisy])
    expected = np.sqrt(samples.var(0).mean(-1))
    np.testing.assert_allclose(undistorted_spread(view, "s"), expected, rtol=0.1)
