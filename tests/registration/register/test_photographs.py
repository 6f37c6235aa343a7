"""Registrations of photographs and cameras alone, and photographs that are refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from coregister.first_model import build
from coregister.synthetic.capture import Studio
from coregister.synthetic.subject import synthesize_capture
from registration.capture.native import read_capture
from registration.detect.weights import read_face_landmarker
from registration.errors import InputError
from registration.evaluate.evaluation import evaluate_registration
from registration.options import RegisterOptions
from registration.pipeline import register

OPTIONS = RegisterOptions(recipe="preview", use_scan="never")


@pytest.fixture(scope="module", autouse=True)
def nets(tmp_path_factory):
    try:
        read_face_landmarker()
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    studio = Studio(cameras=8, size_px=(240, 360), spread_deg=(100.0, 40.0), texture_size=1024)
    return synthesize_capture(tmp_path_factory.mktemp("photographs") / "whole", seed=3, studio=studio)


@pytest.fixture(scope="module")
def photographs(whole: Path) -> Path:
    root = whole.with_name("photographs")
    shutil.copytree(
        whole, root, ignore=shutil.ignore_patterns("masks", "normals", "segmentation", "landmarks", "scan.ply")
    )
    settings = root / "capture.toml"
    settings.write_text(settings.read_text("utf-8").split("[segmentation]")[0], "utf-8")
    return root


@pytest.mark.slow
def test_photographs_and_cameras_alone_give_the_head(photographs: Path, whole: Path, tmp_path: Path) -> None:
    result = register(photographs, build.bootstrap(), tmp_path / "out", OPTIONS)
    assert result.status == "converged", result.reason
    assert result.figures["made"]["channels"] == ["landmarks", "masks", "labels", "normals"]
    face = evaluate_registration(result, read_capture(whole)).metrics["scan_to_mesh"]["face"]
    assert face["median_mm"] < 0.5 and face["mean_mm"] < 1.0
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "Made from the photographs" in page
    again = register(photographs, build.bootstrap(), tmp_path / "again", OPTIONS)
    assert np.abs(again.vertices - result.vertices).max() < 1e-5


def changed(photographs: Path, tmp_path: Path, change) -> Path:
    root = tmp_path / "capture"
    shutil.copytree(photographs, root)
    files = sorted((root / "images").iterdir())
    change(files)
    return root


def blur(files: list[Path]) -> None:
    for file in files:
        cv2.imwrite(str(file), cv2.GaussianBlur(cv2.imread(str(file)), (0, 0), 25))


def exchange(files: list[Path]) -> None:
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, contents[3:] + contents[:3], strict=True):
        file.write_bytes(content)


@pytest.mark.parametrize(
    ("change", "got"),
    [pytest.param(blur, "no face in any of 8 views", marks=pytest.mark.slow), (exchange, "agree on a face")],
)
def test_photographs_without_one_face_are_refused_with_a_picture(
    photographs, tmp_path, monkeypatch, change, got
) -> None:
    with pytest.raises(InputError, match=got) as caught:
        register(changed(photographs, tmp_path, change), build.bootstrap(), tmp_path / "out", OPTIONS)
    assert Path(caught.value.got.rsplit("look at ", 1)[1]).is_file()
    assert not (tmp_path / "out").exists()


def test_without_detection_photographs_alone_do_not_locate_the_head(photographs, tmp_path) -> None:
    with pytest.raises(InputError, match="cannot be located"):
        register(photographs, build.bootstrap(), tmp_path / "out", replace(OPTIONS, detect=False))
