"""A model at a URL comes with the files that belong to it."""

import shutil
from pathlib import Path

import fsspec
import numpy as np
import pytest

from registration.model import gnm_npz
from tests.fixtures.make_fixtures import HERE
from workflows.records import remote


def test_a_model_comes_with_its_second_file_and_its_schemes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "model"
    with np.load(HERE / "tiny_gnm.npz") as archive:
        np.savez(tmp_path / "with_more.npz", **archive, rounds=np.arange(3))
    gnm_npz.write(gnm_npz.read(tmp_path / "with_more.npz"), folder / "m.npz")
    shutil.copy(HERE / "head_sparse_68.txt", folder)
    (folder / "other.txt").write_text("no part of the model")
    fs = fsspec.filesystem("memory")
    for file in folder.iterdir():
        fs.pipe(f"/models/{file.name}", file.read_bytes())
    monkeypatch.setattr(remote, "filesystem", lambda place: (fs, place.removeprefix("s3:/")))
    local = remote.fetch_model("s3://models/m.npz")
    assert sorted(path.name for path in local.parent.iterdir()) == ["head_sparse_68.txt", "m.extra.npz", "m.npz"]
    assert gnm_npz.content_hash(gnm_npz.read(local)) == gnm_npz.content_hash(gnm_npz.read(folder / "m.npz"))
