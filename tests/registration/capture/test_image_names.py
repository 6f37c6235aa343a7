"""Names in a COLMAP model that no file has are refused with the name to write."""

from pathlib import Path

import pytest

from registration.capture.image_names import image_file
from registration.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("cam01.png", "rig/cam02.png", "Süd 3.png", "a b.png", "a%20c.png", "back\\slash.png"):
        file = tmp_path / "images" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    return tmp_path


@pytest.mark.parametrize(
    "name", ["cam01.png", "./cam01.png", "rig/cam02.png", "Süd 3.png", "a%20c.png", "back\\slash.png"]
)
def test_a_files_own_name_is_used(root: Path, name: str) -> None:
    assert (root / "images" / image_file(root, name)).is_file()


@pytest.mark.parametrize(
    "name, near, advice",
    [
        ("./images/cam01.png", "cam01.png", "do not begin with images/"),
        ("images/rig/cam02.png", "rig/cam02.png", "do not begin with images/"),
        ("rig\\cam02.png", "rig/cam02.png", "backslash"),
        ("C:\\capture\\images\\cam01.png", "cam01.png", "backslash"),
        ("/data/capture/images/cam01.png", "cam01.png", "relative to images/"),
        ("../capture/images/cam01.png", "cam01.png", "relative to images/"),
        ("Su\u0308d 3.png", "Süd 3.png", "Unicode"),
        ("a%20b.png", "a b.png", "percent"),
        ("CAM01.PNG", "cam01.png", "all letters"),
        ("cam01.jpg", "cam01.png", "all letters"),
        ("cam01", "cam01.png", "relative to images/"),
    ],
)
def test_the_name_to_write_is_told(root: Path, name: str, near: str, advice: str) -> None:
    with pytest.raises(InputError) as caught:
        image_file(root, name)
    assert near in caught.value.fix and advice in caught.value.fix


@pytest.mark.parametrize("name", ["../other.png", "a\0b.png", "x" * 300 + ".png", "other", ".png"])
def test_other_names_are_refused(root: Path, name: str) -> None:
    with pytest.raises(InputError, match="cannot be used"):
        image_file(root, name)


def test_a_missing_image_is_left_to_the_reader(root: Path) -> None:
    assert image_file(root, "cam07.png").name == "cam07.png"
