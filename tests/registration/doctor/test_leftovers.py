import json
import shutil
from pathlib import Path

import cv2
import pytest

from registration.capture import native
from registration.doctor import leftovers
from registration.doctor.report import check_capture
from registration.errors import InputError
from tests.registration.capture.small import make

NAMES = [f"cam{i:02d}.png" for i in range(12)]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("good") / "capture")


@pytest.mark.parametrize(
    "name",
    ["cam01.PNG", "cam01.png.png", "CAM01.jpg", "cam1.png", "cam01_mask.png", "rig\\cam01.png", "sub/cam01.png"]
    + ["kam01.png", "images/cam01.png", "cam-01.png", "cam01.png.json", "cam01.tiff"],
)
def test_the_nearest_name(name: str) -> None:
    assert leftovers.nearest(name, NAMES) == "cam01.png"


@pytest.mark.parametrize("name", ["cam20.png", "frame_01.png", "x.png"])
def test_no_name_is_near(name: str) -> None:
    assert leftovers.nearest(name, NAMES) is None


@pytest.mark.parametrize("folder", ["masks", "normals", "segmentation", "landmarks"])
@pytest.mark.parametrize("suffix", [".bmp", ".PNG", ".txt", ".tar.png.x", "_x.png"])
def test_a_channel_without_a_file_that_belongs_to_a_view_is_refused(
    good: Path, tmp_path: Path, folder: str, suffix: str
) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    for path in sorted((root / folder).iterdir()):
        path.rename(path.with_name(path.stem + suffix))
    with pytest.raises(InputError) as caught:
        check_capture(root)
    assert folder in caught.value.what and f"cam0{suffix}" in caught.value.got and "cam0." in caught.value.fix


@pytest.mark.parametrize("folder, suffix", [("masks", ".jpg"), ("masks", ".png.png"), ("landmarks", ".png.json")])
def test_masks_and_landmarks_by_usual_other_names_are_read(
    good: Path, tmp_path: Path, folder: str, suffix: str
) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    for path in sorted((root / folder).iterdir()):
        if suffix == ".jpg":
            cv2.imwrite(str(path.with_suffix(suffix)), cv2.imread(str(path), 0))
            path.unlink()
        else:
            path.rename(path.with_name(path.stem + suffix))
    report = check_capture(root)
    assert report.warnings == () and all(view.landmarks for view in report.views)
    assert all(view.mask is not None for view in report.capture.views)


def test_files_that_belong_to_no_view_are_named(good: Path, tmp_path: Path) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    (root / "masks" / "cam1.png").rename(root / "masks" / "cam1.PNG")
    shutil.copy(root / "images" / "cam0.png", root / "images" / "other.png")
    (root / "masks" / ".hidden").touch()
    (root / "Labels").mkdir()
    (root / "Labels" / "cam0.png").touch()
    (root / "scan.ply").rename(root / "scan.stl")
    warnings = check_capture(root).warnings
    assert "1 files in masks/ belong to no view: cam1.PNG (near cam1.png)" in warnings
    assert "1 files in images/ are not calibrated, the COLMAP model does not name them: other.png" in warnings
    assert "Labels/ with 1 files is not read; rename it to segmentation/" in warnings
    assert "scan.stl is not read; convert or rename it to scan.ply or scan.obj or scan.glb" in warnings


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-8"])
def test_a_byte_order_mark_is_accepted(good: Path, tmp_path: Path, encoding: str) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    for path in (root / "capture.toml", *(root / "landmarks").iterdir()):
        path.write_text(path.read_text("utf-8"), encoding)
    assert all(view.landmarks for view in native.read_capture(root).views)


@pytest.mark.parametrize("name", ["capture.toml", "landmarks/cam0.json"])
def test_another_encoding_is_named(good: Path, tmp_path: Path, name: str) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    (root / name).write_text((root / name).read_text("utf-8"), "utf-16")
    with pytest.raises(InputError) as caught:
        native.read_capture(root)
    assert "UTF-16" in caught.value.got


def test_null_landmarks_are_not_seen(good: Path, tmp_path: Path) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    path = root / "landmarks" / "cam0.json"
    rows = json.loads(path.read_text())["68"]
    rows[5], rows[6] = [None, None, 0], None
    path.write_text(json.dumps({"68": rows}))
    landmarks = native.read_capture(root).views[0].landmarks["68"]
    assert landmarks[[5, 6]].tolist() == [[0, 0, 0], [0, 0, 0]] and landmarks[7, 0] > 0


@pytest.mark.parametrize(
    "old, new, what, got",
    [
        ('"subject" =', "Subject =", 'lacks "subject"', '"Subject"'),
        ('"expression" =', "expresion =", 'lacks "expression"', '"expresion"'),
        ('"units" =', "unit =", "units are not metres", '"unit"'),
        ("[segmentation]", "[Segmentation]", "A table of capture.toml is misspelt", "[Segmentation]"),
        ("[segmentation]", "[segmentations]", "A table of capture.toml is misspelt", "[segmentations]"),
        ("classes =", "class =", "lacks the class names", "class ="),
        ("classes =", "labels =", "lacks the class names", "labels ="),
    ],
)
def test_misspelt_settings_are_named(good: Path, tmp_path: Path, old: str, new: str, what: str, got: str) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    path = root / "capture.toml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        native.read_capture(root)
    assert what in caught.value.what and got in caught.value.got


def test_class_names_may_differ_in_case_spaces_and_hyphens(good: Path, tmp_path: Path) -> None:
    root = shutil.copytree(good, tmp_path / "capture")
    path = root / "capture.toml"
    text = path.read_text()
    path.write_text(
        text.split("[segmentation]")[0] + '[segmentation]\nclasses = ["BACKGROUND", "Left Eye", "upper-lip"]'
    )
    assert native.read_capture(root).classes == ("background", "left_eye", "upper_lip")
