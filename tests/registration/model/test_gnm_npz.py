import inspect
import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from registration.errors import InputError
from registration.model import gnm_npz
from tests.conftest import FIXTURES, SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model

TINY = FIXTURES / "tiny_gnm.npz"


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    with np.load(TINY) as archive:
        return dict(archive)


def save(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    path = folder / "model.npz"
    np.savez(path, **arrays)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        gnm_npz.read(path)
    assert caught.value.where == str(path)
    return str(caught.value)


def equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return list(a) == list(b) and all(a[k].dtype == b[k].dtype and np.array_equal(a[k], b[k]) for k in a)


def test_table_and_annotations_agree():
    annotations = inspect.get_annotations(gnm_npz.GNMData)
    annotations.pop("extra")
    table = {name: axes for name, (_, axes) in gnm_npz.AXES.items()}
    assert {name: kind.dim_str for name, kind in annotations.items()} == table
    assert len(gnm_npz.AXES) == 23


def contents(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


EXTRA = {"provenance": np.array("written by hand"), "rounds": np.arange(3, dtype=np.uint8)}


@pytest.mark.parametrize("inside", [False, True])
def test_round_trip_is_exact(tmp_path, arrays, inside):
    data = gnm_npz.read(save(tmp_path, arrays | EXTRA))
    assert data.extra.keys() == EXTRA.keys()
    path = tmp_path / "deep" / "again.npz"
    gnm_npz.write(data, path, extra_inside=inside)
    assert equal(contents(path), arrays | EXTRA if inside else arrays)  # exactly the 23 fields unless asked
    files = [p.name for p in sorted(path.parent.iterdir())]
    assert files == (["again.npz"] if inside else ["again.extra.npz", "again.npz"])
    again = gnm_npz.read(path)
    assert equal(dict(again.extra), EXTRA)
    assert gnm_npz.content_hash(again) == gnm_npz.content_hash(data) != gnm_npz.content_hash(tiny_model())


def test_fields_that_are_not_known_are_told(tmp_path, arrays):
    assert gnm_npz.read(TINY).remarks == ()
    (remark,) = gnm_npz.read(save(tmp_path, arrays | EXTRA)).remarks
    assert remark.endswith("kept and not used: provenance, rounds")
    (remark,) = gnm_npz.read(save(tmp_path, arrays | {"version": np.array("4.1")})).remarks
    assert "version 4.1" in remark and "read as 3.0" in remark


def test_the_second_file_belongs_to_the_model(tmp_path, arrays):
    path, second = tmp_path / "model.npz", tmp_path / "model.extra.npz"
    gnm_npz.write(gnm_npz.read(save(tmp_path, arrays | EXTRA)), path)
    gnm_npz.write(tiny_model(), path)  # another model takes its place
    assert not second.exists() and not gnm_npz.read(path).extra
    for twice in ("triangles", "provenance"):
        save(tmp_path, arrays | EXTRA)
        np.savez(second, **{twice: np.zeros(2)})
        with pytest.raises(InputError, match="in two files") as caught:
            gnm_npz.read(path)
        assert caught.value.where == str(second) and caught.value.got == twice
    second.write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(InputError, match="second file of the head model cannot be read"):
        gnm_npz.read(path)


def test_content_ids_stay():
    """Registrations and manifests state them."""
    assert gnm_npz.content_hash(gnm_npz.read(TINY)).startswith("f2aaadf95032")


def test_equal_models_give_equal_files(tmp_path):
    for name in ("a.npz", "b.npz"):
        gnm_npz.write(tiny_model(), tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@needs_shared
def test_round_trip_of_the_full_head(tmp_path):
    source = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"
    data = gnm_npz.read(source)
    gnm_npz.write(data, tmp_path / "again.npz")
    with np.load(source) as first, np.load(tmp_path / "again.npz") as second:
        assert equal(dict(first), dict(second))
    assert gnm_npz.content_hash(gnm_npz.read(tmp_path / "again.npz")) == gnm_npz.content_hash(data)
    assert gnm_npz.content_hash(data).startswith("50c12fdaa69a")


@pytest.mark.parametrize("name", gnm_npz.AXES)
def test_missing_field_is_named(tmp_path, arrays, name):
    del arrays[name]
    text = refusal(save(tmp_path, arrays))
    assert f"field '{name}' is missing" in text and "22 of them" in text


@pytest.mark.parametrize("name", [k for k, (_, axes) in gnm_npz.AXES.items() if axes])
def test_wrong_shape_is_named(tmp_path, arrays, name):
    """One entry less on any axis; where the field is the first with that axis, the next one with it is named."""
    for axis in range(arrays[name].ndim if name != "mesh_component_names" else 0):  # its axis is in no other field
        short = np.delete(arrays[name], 0, axis)
        text = refusal(save(tmp_path, arrays | {name: short}))
        assert "has a wrong shape" in text
        letters = gnm_npz.AXES[name][1].split()
        defines = next(k for k, (_, axes) in gnm_npz.AXES.items() if letters[axis] in axes.split()) == name
        assert defines or f"'{name}'" in text
    assert f"'{name}' has a wrong shape" in refusal(save(tmp_path, arrays | {name: arrays[name][None]}))


@pytest.mark.parametrize("name", [k for k, (kind, _) in gnm_npz.AXES.items() if kind == "float"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_value_that_is_not_finite_is_named(tmp_path, arrays, name, value):
    arrays[name].reshape(-1)[-1] = value
    text = refusal(save(tmp_path, arrays))
    assert f"'{name}' has a wrong value" in text and "1 NaN or infinite" in text


@pytest.mark.parametrize(
    ("name", "value"),
    [("triangles", -1), ("triangles", 10**6), ("quads", 10**6), ("mirror_indices", -2), ("joint_parent_indices", 3)],
)
def test_index_out_of_range_is_named(tmp_path, arrays, name, value):
    arrays[name].reshape(-1)[1] = value
    assert f"'{name}' has a wrong index" in refusal(save(tmp_path, arrays))


@pytest.mark.parametrize("column", [np.zeros(4), np.array([1.5, -0.5, 0, 0])])
def test_vertex_without_a_joint_is_refused(tmp_path, arrays, column):
    arrays["skinning_weights"][:, 7] = column
    assert "'skinning_weights' has a wrong value" in refusal(save(tmp_path, arrays))


@pytest.mark.parametrize(("name", "kind"), [("triangles", float), ("vertex_groups", int), ("version", int)])
def test_wrong_type_is_named(tmp_path, arrays, name, kind):
    assert f"'{name}' has a wrong type" in refusal(save(tmp_path, arrays | {name: np.zeros(arrays[name].shape, kind)}))


def test_a_pickle_is_never_loaded(tmp_path, arrays):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    arrays["joint_names"] = np.array([Trap()] * 4, dtype=object)
    text = refusal(save(tmp_path, arrays))
    assert "field 'joint_names' cannot be read" in text and "never loaded" in text
    assert not (tmp_path / "sprung").exists()


def test_files_that_are_no_archive_are_refused(tmp_path, arrays):
    whole = TINY.read_bytes()
    for content in (b"", b"not a model", whole[: len(whole) // 2], np_bytes(arrays["triangles"])):
        path = tmp_path / "broken.npz"
        path.write_bytes(content)
        assert "cannot be read" in refusal(path)
    assert "The head model is missing" in refusal(tmp_path / "absent.npz")


def test_all_missing_fields_are_named_at_once(tmp_path, arrays):
    for name in ("quads", "version", "mirror_indices"):
        del arrays[name]
    assert "20 of them; missing: version, quads, mirror_indices" in refusal(save(tmp_path, arrays))


FLAME = {"v_template": np.zeros((5, 3)), "shapedirs": np.zeros((5, 3, 2)), "posedirs": np.zeros((5, 3, 2))}


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "an empty file"),
        (b"GNMW\x01\0\0\0", "a GNMW container"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:61\nsize 53000000\n", "Git LFS pointer"),
        (b"<!DOCTYPE html><html>please log in", "a web page"),
        (b"\n<html>not found", "a web page"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"\x1f\x8b\x08", "a gzip archive"),
        (pickle.dumps({"v_template": [1.0]}), "a Python pickle, such as a model of the FLAME or SMPL family"),
        (pickle.dumps({"v_template": [1.0]}, protocol=0), "a Python pickle"),
        (TINY.read_bytes()[:50_000], "a ZIP archive without its end, 50000 bytes"),
    ],
)
def test_another_file_is_told_from_a_damaged_one(tmp_path, content, what):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    assert what in refusal(path)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (FLAME, "a model of the FLAME or SMPL family"),
        ({"identity": 1, "expression": 1, "offsets": 1, "vertices": 1, "scale": 1}, "a registration, not a head model"),
        ({"vertices": 1, "subjects": 1, "labels": 1}, "held-out meshes"),
        ({"weather": 1, "tides": 2}, "none of these fields; it has weather, tides"),
        ({}, "it has no array"),
    ],
)
def test_another_archive_is_told(tmp_path, content, what):
    assert what in refusal(save(tmp_path, content))


def test_a_checkpoint_of_pytorch_is_told(tmp_path):
    torch.save({"weight": torch.zeros(3)}, tmp_path / "model.npz")
    assert "a PyTorch checkpoint" in refusal(tmp_path / "model.npz")


def test_an_older_version_is_named(tmp_path, arrays):
    old = arrays | {"version": np.array("2.1")}
    assert "version 3.0\n  got:      2.1" in refusal(save(tmp_path, old))
    del old["mirror_indices"]
    text = refusal(save(tmp_path, old))
    assert "version 2.1, with 22 of them; missing: mirror_indices" in text


def test_a_damaged_archive_is_told_from_a_wrong_one(tmp_path):
    damaged = bytearray(TINY.read_bytes())
    with zipfile.ZipFile(TINY) as archive:
        for entry in archive.infolist():  # of every field
            damaged[entry.header_offset + 60 + entry.compress_size // 2] ^= 0xFF
    (tmp_path / "model.npz").write_bytes(damaged)
    assert "the file is damaged" in refusal(tmp_path / "model.npz")


def test_damaged_and_unknown_members_are_named(tmp_path):
    damaged = bytearray(TINY.read_bytes())
    with zipfile.ZipFile(TINY) as archive:
        entry = archive.getinfo("expression_basis.npy")
    damaged[entry.header_offset + entry.compress_size // 2] ^= 0xFF
    path = tmp_path / "damaged.npz"
    path.write_bytes(damaged)
    assert "field 'expression_basis' cannot be read" in refusal(path)
    path.write_bytes(TINY.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "not an array")
    assert "field 'notes.txt' cannot be read" in refusal(path)


def test_a_failed_write_leaves_no_file(tmp_path):
    data = tiny_model()
    data.skinning_weights[:] = 0
    with pytest.raises(InputError, match="skinning_weights"):
        gnm_npz.write(data, tmp_path / "model.npz")
    data = tiny_model()
    (tmp_path / "taken.npz").mkdir()
    with pytest.raises(OSError):
        gnm_npz.write(data, tmp_path / "taken.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["taken.npz"]


def test_hashes_depend_on_topology_and_content():
    a, b = tiny_model(), tiny_model()
    assert gnm_npz.content_hash(a) == gnm_npz.content_hash(b)
    b.expression_basis[2, 5, 1] += 1e-3
    assert gnm_npz.content_hash(a) != gnm_npz.content_hash(b)
    assert gnm_npz.topology_hash(a.triangles) == gnm_npz.topology_hash(b.triangles.astype(np.int64))
    assert gnm_npz.topology_hash(a.triangles) != gnm_npz.topology_hash(np.roll(a.triangles, 1, axis=0))


def np_bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()
