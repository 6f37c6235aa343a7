"""Inputs that a registration must refuse with a clear message, before any computation and without writing anything."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.errors import InputError
from registration.model import gnm_npz
from registration.render import backend
from tests.registration.register.bad_input_cases import BAD, Request, image_missing, write_neutral
from tests.registration.register.synthetic import FIXTURES, MODEL, Truth


def state(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_size if path.is_file() else 0, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def request_(neutral: Truth, tmp_path: Path) -> Request:
    for name in (MODEL.name, "head_sparse_68.txt"):
        shutil.copy(FIXTURES / name, tmp_path / name)
    capture = shutil.copytree(neutral.root, tmp_path / "capture")
    return Request(folder=tmp_path, capture=capture, model=tmp_path / MODEL.name, out=tmp_path / "out")


@pytest.mark.parametrize("name", BAD)
def test_invalid_requests_are_refused_before_any_computation(
    name: str, request_: Request, monkeypatch: pytest.MonkeyPatch
):
    damage, what, where, got, fix = BAD[name]
    damage(request_)
    before = state(request_.folder)
    monkeypatch.setattr(backend, "activate", lambda *a, **k: pytest.fail("the renderer was started"))
    with pytest.raises(InputError) as caught:
        request_.register()
    error = caught.value
    assert what in error.what
    assert where in error.where
    assert got in error.got and error.got
    assert fix in error.fix
    assert error.expected
    assert state(request_.folder) == before


def test_there_are_at_least_twenty_cases():
    assert len(BAD) >= 20


def test_the_unmodified_request_is_valid(request_: Request, monkeypatch: pytest.MonkeyPatch):
    """Without the changes of the table the registration starts to compute."""

    class Started(Exception):
        pass

    def start(*args, **kwargs):
        raise Started

    monkeypatch.setattr(backend, "activate", start)
    with pytest.raises(Started):
        request_.register()
    assert not request_.out.exists()


def test_a_previous_result_is_kept(request_: Request, monkeypatch: pytest.MonkeyPatch):
    write_neutral(request_.out, gnm_npz.read(request_.model))
    image_missing(request_)
    before = state(request_.folder)
    with pytest.raises(InputError, match="The image is missing"):
        request_.options["force"] = True
        request_.register()
    assert state(request_.folder) == before


@pytest.mark.slow
def test_masks_without_a_head_are_refused(request_: Request):
    """Without landmarks the pose is estimated from the masks; thin stripes are no head. Nothing is written."""
    shutil.rmtree(request_.capture / "landmarks")
    stripes = np.zeros((200, 160), np.uint8)
    stripes[:, 30:34] = stripes[:, 120:123] = 255
    for path in (request_.capture / "masks").iterdir():
        assert cv2.imwrite(str(path), stripes)
    request_.options["views"] = 2
    before = state(request_.folder)
    with pytest.raises(InputError) as caught:
        request_.register()
    error = caught.value
    assert error.what == "The pose of the head cannot be estimated"
    assert "masks" in error.where
    assert "0.7" in error.expected and float(error.got.split()[0]) < 0.7
    assert "--landmarks" in error.fix
    assert state(request_.folder) == before
