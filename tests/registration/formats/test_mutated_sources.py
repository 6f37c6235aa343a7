"""Every description of a capture in another format, mutated: it is read, or refused with an `InputError`."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from registration.capture import native
from registration.formats.plan import plan_views
from registration.formats.registry import FORMATS, read_source
from registration.formats.source import ReadOptions
from tests.registration.capture.small import make
from tests.registration.formats.writers import NAMES, with_square_pixels, writer_of
from tests.workflows.records.test_mutated_files import (
    QUICK,
    edit,
    mutated,
    nodes,
    place,
    read_or_refuse,
    replaced,
    values,
)

FEW = settings(QUICK, max_examples=int(os.environ.get("MUTATIONS", "15")))
IMAGES = {".png", ".jpg", ".tif", ".mp4", ".avi", ".ply"}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Format -> the folder of a capture in it."""
    root = tmp_path_factory.mktemp("mutated")
    capture = with_square_pixels(native.read_capture(make(root / "capture")))
    for name in NAMES:
        (root / "sources" / name).mkdir(parents=True)
        writer_of(name).write(capture, root / "sources" / name)
    return {name: root / "sources" / name for name in NAMES}


def descriptions(folder: Path) -> list[Path]:
    """The files that are no pictures, one of each suffix and folder."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.suffix not in IMAGES)
    first: dict[tuple[Path, str], Path] = {}
    for file in files:
        first.setdefault((file.parent, file.suffix if file.suffix in (".xmp", ".json") else file.name), file)
    return sorted(first.values())


def read(folder: Path, name: str) -> None:
    """Detect, read and plan, as the command does before it writes."""
    for known in FORMATS:
        known.detect(folder)
    plan_views(read_source(folder, ReadOptions(), name=name))


@pytest.mark.parametrize("name", NAMES)
def test_the_valid_source_is_read(folders: dict[str, Path], name: str) -> None:
    assert descriptions(folders[name])
    read(folders[name], name)


@pytest.mark.parametrize("name", NAMES)
@given(where=place, edits=st.lists(edit, min_size=1, max_size=3))
@FEW
def test_mutated_descriptions_are_read_or_refused(folders, name, where, edits):
    files = descriptions(folders[name])
    file = files[int(where * len(files))]
    read_or_refuse(lambda _: read(folders[name], name), file, mutated(file.read_bytes(), edits))


@pytest.mark.parametrize("name", ["nerfstudio", "vhap", "nersemble", "facescape"])
@given(where=place, new=values)
@FEW
def test_other_values_in_json_are_read_or_refused(folders, name, where, new):
    file = next(file for file in descriptions(folders[name]) if file.suffix == ".json")
    value = json.loads(file.read_bytes())
    paths = nodes(value)
    changed = replaced(value, paths[int(where * len(paths))], new)
    read_or_refuse(lambda _: read(folders[name], name), file, json.dumps(changed).encode())
