import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.degrading.degradation import PRESETS
from registration.degrading.degrade import degrade
from registration.doctor.ledger import Channel
from registration.doctor.report import check_capture
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.small import ball, make
from tests.registration.doctor import faulty


def channels(root: Path) -> dict[str, Channel]:
    return {channel.name: channel for channel in validate_capture(native.read_capture(root)).channels}


def test_all_of_a_clean_capture_counts(tmp_path: Path) -> None:
    found = channels(make(tmp_path / "capture"))
    assert list(found) == ["images", "masks", "normals", "segmentation", "landmarks", "scan.ply"]
    for name in ("images", "masks", "normals", "segmentation"):
        assert found[name].files == found[name].matched == 5
        assert found[name].counted > 0.99 * found[name].total > 0
    assert found["landmarks"].total == 5 * 68 and found["scan.ply"].counted == len(ball().vertices)


def test_the_report_shows_the_ledger(tmp_path: Path) -> None:
    root = make(tmp_path / "capture", drop=("normals",))
    shutil.copy(root / "images" / "cam0.png", root / "images" / "cam9.png")
    text = str(check_capture(root))
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert rows["images"][1:5] == ["6", "5", "100", "%"] and rows["normals"][1:] == ["-", "-", "-"]
    assert "usable, with 2 warnings" in text and "cam9.png" in text


def test_each_pixel_is_lost_to_one_reason(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    faulty.images(root, "masks", lambda mask: np.where(np.arange(120) < 90, mask, mask // 255 * 140).astype(np.uint8))
    faulty.normals(root, lambda n: np.where(np.arange(160)[:, None, None] < 80, n, [0, 0, 1.0]), ["cam1"])
    found = channels(root)["normals"]
    soft, away = found.losses["mask between 50 and 99 %"], found.losses["normal faces away"]
    assert soft > 0 and away > 0 and found.counted + sum(found.losses.values()) == found.total


@needs_shared
@pytest.mark.parametrize(
    "names, fix",
    [
        ("background skn left_eye right_eye upper_lip lower_lip ears mouth_interior neck", "rename skn to skin"),
        ("hintergrund haut a b c d e f g", 'ignore = ["hintergrund", "haut", "a", '),
    ],
)
def test_classes_of_another_vocabulary_are_refused(tmp_path: Path, names: str, fix: str) -> None:
    root = faulty.copy(tmp_path)
    faulty.classes(root, lambda _: names.split())
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert caught.value.what == "A segmentation class is unknown" and fix in caught.value.fix
    assert "celebamask_hq, " in str(caught.value.expected) and "lapa" in str(caught.value.expected)


@needs_shared
@pytest.mark.parametrize(
    "style", [str.upper, lambda name: name.title().replace("_", ""), lambda n: n.replace("_", "-")]
)
def test_other_spellings_of_classes_count(tmp_path: Path, style: object) -> None:
    assert callable(style)
    root = faulty.copy(tmp_path)
    faulty.classes(root, lambda names: [style(name) for name in names])
    assert channels(root)["segmentation"].counted > 0.99 * channels(root)["segmentation"].total


@needs_shared
def test_other_names_of_classes_are_told(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    faulty.classes(root, lambda names: ["face" if name == "skin" else name for name in names])
    assert faulty.warnings(root) == "classes with other names are read so, left is the subject's: face as skin"
    faulty.classes(root, lambda names: ["haut" if name == "face" else name for name in names])
    path = root / "capture.toml"
    path.write_text(path.read_text() + 'ignore = ["haut"]\n')
    found = channels(root)["segmentation"]
    assert found.losses["class ignored haut"] > 0.5 * found.total and faulty.warnings(root) == ""  # it was said


@needs_shared
@pytest.mark.parametrize(
    "folder, what", [("normals", "Nothing of normals/"), ("segmentation", "Nothing of segmentation")]
)
def test_empty_channels_are_refused(tmp_path: Path, folder: str, what: str) -> None:
    root = faulty.copy(tmp_path)
    faulty.images(root, folder, lambda pixels: pixels * 0)
    with pytest.raises(InputError, match=what):
        faulty.warnings(root)


def test_label_maps_without_a_subject_are_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "capture", drop=("mask", "normals"))
    faulty.images(root, "segmentation", lambda pixels: pixels * 0)
    with pytest.raises(InputError, match="The label maps show no subject"):
        faulty.warnings(root)


@needs_shared
@pytest.mark.slow
def test_no_shared_capture_is_warned_of() -> None:
    for path in sorted((SHARED / "data" / "captures").glob("*/*/capture.toml")):
        assert faulty.warnings(path.parent) == "", path


@needs_shared
@pytest.mark.parametrize("preset", ["studio", "harsh"])
def test_degraded_captures_raise_no_false_alarm(tmp_path: Path, preset: str) -> None:
    root = degrade(faulty.SOURCE, tmp_path / "capture", preset=PRESETS[preset], seed=2)
    assert faulty.warnings(root) == ""
