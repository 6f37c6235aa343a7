"""Atomic writes: the new content or the old, never a part of either, and no temporary files remain."""

import json

import pytest

from registration.errors import InputError
from registration.storage import files


def test_a_failed_write_keeps_the_previous_file_alone(tmp_path):
    target = tmp_path / "model.npz"
    files.atomic_write_bytes(target, b"old")
    with pytest.raises(OSError, match="disk full"):
        with files.atomic_file(target) as temporary:
            assert temporary.suffix == ".npz" and temporary.parent == tmp_path
            temporary.write_bytes(b"ne")
            raise OSError("disk full")
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]
    files.atomic_write_text(target, "new ü")
    assert target.read_text("utf-8") == "new ü" and list(tmp_path.iterdir()) == [target]


def test_json_has_null_for_numbers_that_are_not_finite(tmp_path):
    files.write_json(tmp_path / "a.json", {"mm": [1.5, float("inf")]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"mm": [1.5, None]}


def test_a_folder_is_created_atomically(tmp_path):
    out = tmp_path / "below" / "out"
    with pytest.raises(OSError, match="disk full"):
        with files.atomic_directory(out) as temporary:
            (temporary / "part").write_text("1")
            raise OSError("disk full")
    assert not out.exists() and not any(out.parent.iterdir())
    for content in ("1", "2"):
        with files.atomic_directory(out) as temporary:
            (temporary / content).write_text(content)
    assert [path.name for path in out.iterdir()] == ["2"] and list(out.parent.iterdir()) == [out]


@pytest.mark.parametrize(
    ("content", "refused"),
    [
        ({}, False),
        ({"manifest.json": '{"kind": "ours"}'}, False),
        ({"manifest.json": '{"kind": "ours"}', "page": ""}, False),
        ({"manifest.json": '{"kind": "ours"}', "thesis": ""}, True),
        ({"manifest.json": '{"kind": "theirs"}'}, True),
        ({"manifest.json": "{"}, True),
        ({"page": ""}, True),
    ],
)
def test_only_folders_with_our_manifest_may_be_replaced(tmp_path, content, refused):
    for name, text in content.items():
        (tmp_path / name).write_text(text)
    arguments = dict(kind="ours", command="stabilize", files=("manifest.json", "page"))
    if refused:
        with pytest.raises(InputError, match="gnmreg stabilize"):
            files.refuse_foreign(tmp_path, **arguments)
    else:
        files.refuse_foreign(tmp_path, **arguments)
    files.refuse_foreign(tmp_path / "missing", **arguments)
