"""Layouts of OpenCV's YAML files, and files that cannot be used."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.errors import InputError
from registration.formats.file_storage import read_file_storage
from registration.formats.opencv_yaml import FORMAT, read
from registration.formats.source import Distortion, ReadOptions
from registration.types import Capture
from tests.fixtures.formats import opencv
from tests.registration.capture.small import DISTORTIONS, make


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "c", distortion=DISTORTIONS["OPENCV"]))


@pytest.fixture
def easymocap(capture: Capture, tmp_path: Path) -> Path:
    opencv.write(capture, tmp_path)
    return tmp_path


@pytest.fixture
def single(capture: Capture, tmp_path: Path) -> Path:
    """One file per camera, as the calibration sample of OpenCV and many scripts write them."""
    (tmp_path / "calibration").mkdir()
    (tmp_path / "images").mkdir()
    for view in capture.views:
        K = view.camera.intrinsics.copy()
        K[:2, 2] -= 0.5
        storage = cv2.FileStorage(str(tmp_path / "calibration" / f"{view.name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", view.camera.width_px)
        storage.write("image_height", view.camera.height_px)
        storage.write("camera_matrix", K)
        storage.write("distortion_coefficients", np.array([*view.camera.distortion, 0.0]))
        storage.write("rvec", cv2.Rodrigues(view.camera.T_cam_world[:3, :3])[0])
        storage.write("tvec", view.camera.T_cam_world[:3, 3])
        storage.release()
        shutil.copyfile(view.image, tmp_path / "images" / f"{view.name}.png")
    return tmp_path


def test_one_file_per_camera(single: Path, capture: Capture) -> None:
    assert FORMAT.detect(single)
    source = read(single, ReadOptions())
    assert source.unit_m is None and source.notes == ()
    for view, expected in zip(source.views, capture.views, strict=True):
        assert view.name == expected.name
        np.testing.assert_allclose(view.intrinsics, expected.camera.intrinsics, atol=1e-9)
        np.testing.assert_allclose(view.T_cam_world, expected.camera.T_cam_world, atol=1e-9)
        assert view.distortion.coefficients == (*DISTORTIONS["OPENCV"], 0.0)


def test_yaml_of_other_writers(single: Path) -> None:
    """No header of OpenCV, plain lists, a transform, a fisheye lens, no size."""
    file = single / "calibration" / "cam0.yml"
    file.write_text(
        "K: [[300.5, 0.0, 60.0], [0.0, 301.0, 80.0], [0.0, 0.0, 1.0]]\n"
        "D: [0.1, 0.2, 0.3, 0.4]\ndistortion_model: equidistant\n"
        "RT: [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3]]\n"
    )
    source = read(single, ReadOptions())
    view = source.views[0]
    assert view.intrinsics.tolist() == [[300.5, 0, 60.5], [0, 301, 80.5], [0, 0, 1]]
    assert view.distortion == Distortion(model="opencv_fisheye", coefficients=(0.1, 0.2, 0.3, 0.4))
    assert view.T_cam_world[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert any("sizes" in note for note in source.notes)


def test_frames_are_chosen_by_number(easymocap: Path) -> None:
    for folder in (easymocap / "images").iterdir():
        shutil.copyfile(folder / "000000.png", folder / "000012.png")
    assert {Path(str(view.image)).name for view in read(easymocap, ReadOptions(frame=12)).views} == {"000012.png"}
    assert {Path(str(view.image)).name for view in read(easymocap, ReadOptions()).views} == {"000000.png"}
    with pytest.raises(InputError) as caught:
        read(easymocap, ReadOptions(frame=5))
    assert "frame 5" in caught.value.expected and "0 to 12" in caught.value.got


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "where"),
    [
        ("intri.yml", "K_cam1:", "K_other:", "camera cam1"),
        ("intri.yml", "rows: 3\n   cols: 3", "rows: 2\n   cols: 3", "intri.yml"),
        ("intri.yml", "rows: 3\n   cols: 3", "rows: 100000\n   cols: 100000", "intri.yml"),
        ("intri.yml", "data: [ 2", "data: [ x, 2", "intri.yml"),
        ("extri.yml", "Rot_cam1", "Lost_cam1", ""),
        ("extri.yml", "T_cam1", "Lost_cam1", "camera cam1"),
        ("intri.yml", '"cam1"', '"cam0"', "names"),
        ("intri.yml", '"cam1"', '"cam9"', "camera cam9"),
    ],
)
def test_bad_values_are_refused_with_their_camera(file: str, old: str, new: str, where: str, easymocap: Path) -> None:
    content = (easymocap / file).read_text().replace("\r\n", "\n")
    (easymocap / file).write_text(content if old in content else content.replace("cam1\n", '"cam1"\n'))
    change(easymocap / file, old, new)
    if not where:  # the Rodrigues vector is there too
        assert len(read(easymocap, ReadOptions()).views) == 5
        return
    with pytest.raises(InputError) as caught:
        read(easymocap, ReadOptions())
    assert where in caught.value.where


def test_two_rotations_that_differ_are_refused(easymocap: Path) -> None:
    text = (easymocap / "extri.yml").read_text()
    start = text.index("R_cam0")
    changed = re.sub(r"data: \[[^]]*\]", "data: [ 0.1, 0.2, 0.3 ]", text[start:], count=1)
    (easymocap / "extri.yml").write_text(text[:start] + changed)
    with pytest.raises(InputError) as caught:
        read(easymocap, ReadOptions())
    assert "differs by" in caught.value.got and "cam0" in caught.value.where


@pytest.mark.parametrize(
    "text",
    [
        "",
        "%YAML:1.0\n---\na: [",
        "a: " + "[" * 100000,
        "%YAML:1.0\n---\n" + "\n".join(" " * i + f"a{i}:" for i in range(400)),
        "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1., 2.]\n",
        "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 100000\n   cols: 100000\n   dt: d\n   data: [1., 2.]\n",
        "a\0b",
    ],
)
def test_hostile_files_are_refused_or_empty(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yml").write_text(text)
    try:
        assert read_file_storage(tmp_path / "a.yml").values == {}
    except InputError as error:
        assert "a.yml" in error.where


def test_a_missing_image_is_named(single: Path) -> None:
    (single / "images" / "cam2.png").unlink()
    with pytest.raises(InputError) as caught:
        read(single, ReadOptions())
    assert "cam2.yml" in caught.value.where and "cam2.png" in caught.value.expected


def test_prisms_are_refused(single: Path) -> None:
    file = single / "calibration" / "cam0.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_APPEND)
    storage.release()
    text = file.read_text()
    start = text.index("distortion_coefficients")
    end = text.index("rvec")
    twelve = ", ".join(["0.1"] * 12)
    matrix = f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 12\n   dt: d\n   data: [ {twelve} ]\n"
    file.write_text(text[:start] + matrix + text[end:])
    with pytest.raises(InputError) as caught:
        read(single, ReadOptions())
    assert "12" in caught.value.got
