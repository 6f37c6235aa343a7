"""`gnmreg capture detect` on landmark files: what it prints and writes, and what it never overwrites."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.detect import written
from tests.registration.detect.known import cameras, head
from workflows.cli.app import main


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture whose image folder says nothing, with landmarks of another scheme in one view."""
    root = tmp_path / "capture"
    views = [
        ViewArrays(name=f"cam{k}", camera=cam, rgb=np.full((640, 480, 3), 90, np.uint8))
        for k, cam in enumerate(cameras())
    ]
    write_capture(root, views, CaptureDescription(subject="s", expression="e"))
    (root / "landmarks").mkdir(exist_ok=True)
    (root / "landmarks" / "cam0.json").write_text('{"two": [[1, 2, 1], null]}')
    marks = tmp_path / "marks"
    marks.mkdir()
    for k, cam in enumerate(cameras()):
        rows = np.column_stack([cam.project(head())[0], np.ones(100)])
        (marks / f"cam{k}.json").write_text(json.dumps({"hundred": (rows + [40 * (k == 3), 0, 0]).tolist()}))
    return root


def run(capture: Path, *words: str) -> int:
    return main(["capture", "detect", str(capture), "--provider", f"files:{capture.parent / 'marks'}", *words])


def test_nothing_is_written_unless_asked(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(capture.rglob("*"))
    assert run(capture) == 0
    assert sorted(capture.rglob("*")) == before
    printed = capsys.readouterr().out
    assert "4 of 5 views agree" in printed and "cam3  contradicts the other views" in printed


def test_files_of_a_new_folder(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(capture, "--out", str(out)) == 0
    assert Image.open(out / written.SHEET).width > 900
    said = json.loads((out / written.DETECTIONS).read_text())
    assert said["outcome"] == "found" and said["views"]["cam3"]["state"] == "refused"
    assert len(said["points_m"]) == 100
    marks = json.loads((out / "landmarks" / "cam0.json").read_text())
    assert marks["two"] == [[1, 2, 1], None] and np.shape(marks["hundred"]) == (100, 4)
    assert not (out / "landmarks" / "cam3.json").exists()
    assert run(capture, "--out", str(out)) == 0  # its own result may be written again
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("")
    assert run(capture, "--out", str(tmp_path / "mine")) == 2
    assert "notes.txt" in capsys.readouterr().err


def test_landmarks_are_added_to_the_capture_but_not_replaced(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capture, "--write") == 0
    first = (capture / "landmarks" / "cam0.json").read_text()
    assert set(json.loads(first)) == {"two", "hundred"}
    assert run(capture, "--write") == 2
    assert "--replace" in capsys.readouterr().err and (capture / "landmarks" / "cam0.json").read_text() == first
    assert run(capture, "--write", "--replace") == 0


def test_landmarks_that_cannot_be_used_are_drawn_and_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(5):
        file = tmp_path / "marks" / f"cam{k}.json"
        rows = np.array(json.loads(file.read_text())["hundred"]) + [0, 60 * k, 0]
        file.write_text(json.dumps({"hundred": rows.tolist()}))
    assert run(capture, "--out", str(tmp_path / "out"), "--write") == 2
    assert (tmp_path / "out" / written.SHEET).is_file() and not (tmp_path / "out" / "landmarks").exists()
    assert "cannot be used" in capsys.readouterr().err
    assert not (capture / "landmarks" / "cam1.json").exists()
