"""Completions are made once, again if their record is damaged, and the oldest go when the cache is full."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.completion import saved
from registration.completion.saved import RECORD, completed, completions_folder
from registration.errors import InputError
from registration.progress import NullProgress
from registration.types import Camera, Capture


@pytest.fixture
def capture(tmp_path, monkeypatch) -> Capture:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    intrinsics = np.array([[40.0, 0, 20], [0, 40, 25], [0, 0, 1]])
    views = [
        ViewArrays(
            name=f"cam{k}",
            camera=Camera(width_px=40, height_px=50, intrinsics=intrinsics, T_cam_world=np.eye(4)),
            rgb=np.full((50, 40, 3), 90, np.uint8),
        )
        for k in range(2)
    ]
    return read_capture(
        write_capture(tmp_path / "capture", views, CaptureDescription(subject="s", expression="neutral"))
    )


class Maker:
    """Makes masks, and counts how often."""

    def __init__(self, error: Exception | None = None):
        self.count, self._error = 0, error

    def __call__(self, root: Path) -> Mapping[str, Any]:
        self.count += 1
        (root / "masks").mkdir()
        cv2.imwrite(str(root / "masks" / "cam0.png"), np.full((50, 40), 255, np.uint8))
        if self._error is not None:
            raise self._error
        return {"notes": ["a note"], "figures": {"channels": ["masks"]}, "seconds": {}, "head_rows": None}


def made(capture: Capture, maker: Maker, key: str = "a" * 64) -> saved.Completion:
    return completed(capture, key, maker, "68", NullProgress())


def test_a_completion_is_made_once_for_a_key(capture):
    maker = Maker()
    first, second = made(capture, maker), made(capture, maker)
    assert maker.count == 1 and first == second and first.notes == ("a note",)
    assert [view.mask for view in first.capture.views] == [first.folder / "masks" / "cam0.png", None]
    assert first.sheet.is_file()
    made(capture, maker, "b" * 64)
    assert maker.count == 2


@pytest.mark.parametrize("text", ["", "{", '{"kind": "gnm-completion", "schema": 99}', "[]"])
def test_a_damaged_record_is_made_again(capture, text):
    maker = Maker()
    (made(capture, maker).folder / RECORD).write_text(text, "utf-8")
    assert made(capture, maker).notes == ("a note",) and maker.count == 2


def test_nothing_is_kept_of_an_error(capture):
    error = InputError("w", where="here", expected="e", got="g", fix="f")
    with pytest.raises(InputError):
        made(capture, Maker(error))
    assert list(completions_folder().iterdir()) == []


def test_the_oldest_are_deleted_when_the_cache_is_full(capture, monkeypatch):
    size = sum(file.stat().st_size for file in made(capture, Maker()).folder.rglob("*") if file.is_file())
    monkeypatch.setattr(saved, "_MOST_BYTES", int(2.5 * size))
    folders = [made(capture, Maker(), letter * 64).folder for letter in "bcd"]
    assert [folder.is_dir() for folder in folders] == [False, True, True]
