"""Which format a folder has, and what is said if it has none or several."""

from pathlib import Path

import pytest

from registration.errors import InputError
from registration.formats.registry import FORMATS, detect_format, find_format, read_source
from registration.formats.source import ReadOptions


def test_names_are_unique_and_plain() -> None:
    names = [known.name for known in FORMATS]
    assert len(set(names)) == len(names) >= 10
    assert all(name == name.lower() and " " not in name for name in names)


def test_every_format_is_in_the_document() -> None:
    text = (Path(__file__).parents[3] / "docs" / "formats.md").read_text("utf-8")
    assert [known.name for known in FORMATS if f"\n| {known.name} |" not in text] == []


def test_a_name_in_any_case() -> None:
    assert find_format(" COLMAP ").name == "colmap"
    with pytest.raises(InputError, match="no such format") as caught:
        find_format("collada")
    assert all(known.name in caught.value.expected for known in FORMATS)


def test_nothing_known_lists_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match="not known") as caught:
        detect_format(tmp_path)
    assert "notes.txt" in caught.value.got and "transforms.json" in caught.value.expected
    with pytest.raises(InputError, match="missing"):
        detect_format(tmp_path / "none")


def test_several_are_named(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    (tmp_path / "capture.toml").write_text("")
    with pytest.raises(InputError, match="several formats") as caught:
        detect_format(tmp_path)
    assert "native" in caught.value.got and "nerfstudio" in caught.value.got
    assert "--format native" in caught.value.fix


def test_a_frame_of_a_format_without_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match="no frames") as caught:
        read_source(tmp_path, ReadOptions(frame=3))
    assert caught.value.where == "--frame"


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.name)
def test_every_reader_refuses_an_empty_folder(known, tmp_path: Path) -> None:
    assert not known.detect(tmp_path)
    with pytest.raises(InputError):
        read_source(tmp_path, ReadOptions(), name=known.name)
    with pytest.raises(InputError):
        read_source(tmp_path / "none", ReadOptions(), name=known.name)
