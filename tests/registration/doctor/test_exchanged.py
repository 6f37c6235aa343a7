import shutil
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.conftest import needs_shared
from tests.registration.doctor import faulty

pytestmark = needs_shared


def test_views_with_each_others_files_are_named(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    for folder in faulty.FOLDERS:
        faulty.exchange(root, folder, "cam01", "cam10")
    warnings = faulty.warnings(root)
    assert "cam01 and cam10 seem exchanged: the landmarks of each fit the other's camera" in warnings


@pytest.mark.parametrize("other", ["cam10", "cam13"])
@pytest.mark.parametrize("masks", [True, False])
def test_exchanged_images_are_named(tmp_path: Path, other: str, masks: bool) -> None:
    root = faulty.copy(tmp_path)
    faulty.exchange(root, "images", "cam01", other)
    if not masks:
        shutil.rmtree(root / "masks")
    assert f"the images of cam01 and {other} seem exchanged" in faulty.warnings(root)


@pytest.mark.parametrize("folder", ["masks", "normals", "segmentation"])
def test_exchanged_files_of_one_kind_are_named(tmp_path: Path, folder: str) -> None:
    root = faulty.copy(tmp_path)
    faulty.exchange(root, folder, "cam01", "cam10")
    assert f"the files of cam01 and cam10 seem exchanged in {folder}/" in faulty.warnings(root)


def test_exchanged_landmarks_are_no_wrong_unit(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    faulty.exchange(root, "landmarks", "cam01", "cam13")
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert "cam01 and cam13 seem exchanged" in caught.value.got


def test_the_same_image_twice_is_named(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    shutil.copy(root / "images" / "cam01.png", root / "images" / "cam04.png")
    assert "cam01 and cam04 have the same image" in faulty.warnings(root)
