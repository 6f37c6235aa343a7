"""Landmark files in place of a detector: exact ones are used as they are, others are refused or named."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.detect.detection import detect_landmarks
from registration.detect.providers import load_source
from registration.errors import InputError
from registration.types import Camera, Capture, View
from tests.registration.capture.small import distorted
from tests.registration.detect.known import cameras, head


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Views with lenses; their landmark files lie in `marks`."""
    views = []
    for k, cam in enumerate(cameras()):
        lens: Camera = replace(cam, distortion=(-0.2, 0.1, 0.0, 0.0))
        views.append(View(name=f"cam{k}", camera=lens, image=tmp_path / f"cam{k}.png"))
    return Capture(root=tmp_path, subject="s", expression="e", views=tuple(views))


def write(capture: Capture, change=lambda k, rows: rows, scheme: str = "hundred") -> str:
    folder = capture.root / "marks"
    folder.mkdir(exist_ok=True)
    for k, view in enumerate(capture.views):
        rows = change(k, np.column_stack([distorted(view.camera, head()), np.ones(100)]))
        if rows is not None:
            (folder / f"{view.name}.json").write_text(json.dumps({scheme: rows.tolist()}))
    return f"files:{folder}"


def test_exact_files(capture: Capture) -> None:
    found = detect_landmarks(capture, load_source(write(capture)))
    assert found.scheme == "hundred" and found.outcome == "found" and found.warnings == ()
    np.testing.assert_allclose(found.points, head(), atol=1e-6)
    for view in found.views:
        np.testing.assert_allclose(view.landmarks[:, :2], distorted_of(capture, view.name), atol=1e-3)


def distorted_of(capture: Capture, name: str) -> np.ndarray:
    view = next(view for view in capture.views if view.name == name)
    return distorted(view.camera, head())


def test_a_stated_spread_is_kept_and_outliers_are_named(capture: Capture) -> None:
    def change(k: int, rows: np.ndarray) -> np.ndarray:
        if k == 1:
            rows[5, :2] += 30
        return np.column_stack([rows, np.full(100, 1.5)])

    found = detect_landmarks(capture, load_source(write(capture, change)))
    assert found.views[1].outliers == (5,) and found.views[1].landmarks[5, 2] == 0
    assert found.views[0].outliers == ()
    np.testing.assert_allclose(found.views[0].spread_px, 1.5)
    np.testing.assert_allclose(found.points[5], head()[5], atol=1e-6)


def test_missing_views_and_points(capture: Capture) -> None:
    def change(k: int, rows: np.ndarray) -> np.ndarray | None:
        rows[:20] = 0
        return None if k == 4 else rows

    found = detect_landmarks(capture, load_source(write(capture, change)))
    assert [view.state for view in found.views] == ["used"] * 4 + ["none"]
    assert np.isnan(found.points[:20]).all() and np.isfinite(found.points[20:]).all()


def test_a_view_that_contradicts(capture: Capture) -> None:
    def change(k: int, rows: np.ndarray) -> np.ndarray:
        return rows + [40, 0, 0] if k == 2 else rows

    found = detect_landmarks(capture, load_source(write(capture, change)))
    assert found.views[2].state == "refused" and any("cam2" in warning for warning in found.warnings)


def test_files_that_cannot_be_used(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be used") as refused:
        detect_landmarks(capture, load_source(f"files:{tmp_path / 'nothing'}"))
    assert "no such file" in refused.value.got
    source = write(capture)
    (tmp_path / "marks" / "other.json").write_text((tmp_path / "marks" / "cam0.json").read_text())
    with pytest.raises(InputError) as refused:
        detect_landmarks(capture, load_source(source))
    assert "other.json" in refused.value.got
    (tmp_path / "marks" / "other.json").unlink()
    (tmp_path / "marks" / "cam0.json").write_text(json.dumps({"hundred": [[1, 2, 1]]}))
    with pytest.raises(InputError) as refused:
        detect_landmarks(capture, load_source(source))
    assert "1 and 100 points" in refused.value.got


def test_one_of_several_schemes(capture: Capture) -> None:
    source = write(capture)
    file = capture.root / "marks" / "cam0.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"two": [[1, 2, 1], [3, 4, 1]]}))
    with pytest.raises(InputError) as refused:
        load_source(source).scheme  # noqa: B018
    assert "hundred, two" in refused.value.got
    assert detect_landmarks(capture, load_source(f"{source}:hundred")).outcome == "found"


def test_files_of_another_resolution_are_refused(capture: Capture) -> None:
    with pytest.raises(InputError, match="images of 2"):
        detect_landmarks(capture, load_source(write(capture, lambda k, rows: rows * [2, 2, 1])))
