"""NPZ files that nobody wrote in good faith: sizes and headers are compared before an array is allocated."""

import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.storage.npz import NpzSchema

SCHEMA = NpzSchema(
    title="example",
    fix="write it again",
    fields={"vertices": ("float", "V 3"), "triangles": ("integer", "F 3")},
    indices={"triangles": "V"},
)
VERTICES, TRIANGLES = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array)
    return stream.getvalue()


def header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def archive(file: Path, method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    members = {"vertices": npy(VERTICES), "triangles": npy(TRIANGLES)} | members
    with zipfile.ZipFile(file, "w", method) as written:
        for name, content in members.items():
            written.writestr(name if "." in name else f"{name}.npy", content)
    return file


def got(file: Path) -> str:
    with pytest.raises(InputError) as caught:
        SCHEMA.read(file)
    assert str(file) in caught.value.where
    return f"{caught.value.what}: {caught.value.got}"


def test_a_file_is_read_whole_or_in_part(tmp_path):
    file = archive(tmp_path / "a.npz", extra=npy(np.array(["x"])))
    assert list(SCHEMA.read(file)) == ["vertices", "triangles", "extra"]
    (only,) = SCHEMA.read(file, only=("vertices",)).values()
    np.testing.assert_array_equal(only, VERTICES)
    bad = archive(tmp_path / "b.npz", triangles=npy(np.array([[0, 1, 9]], np.int32)))
    assert list(SCHEMA.read(bad, only=("vertices",))) == ["vertices"]
    assert "0 to 9" in got(bad)


@pytest.mark.parametrize(
    "shape", [(2**60, 3), (2**30, 3), (2**62, 2**62, 2**62), (4, 3), (2, 3), (-3, 3), (3, 3, 1, 2**40, 0)]
)
def test_a_header_must_match_the_size_of_its_member(tmp_path, shape):
    assert "'vertices'" in got(archive(tmp_path / "a.npz", vertices=header(shape) + VERTICES.tobytes()))


@pytest.mark.parametrize("dtype", ["|O", "<U0", "|V0", "<f4, <f4", "<U1000000000"])
def test_types_that_hold_objects_or_nothing_are_refused(tmp_path, dtype):
    assert "cannot be read" in got(archive(tmp_path / "a.npz", extra=header((10**9,), dtype) + bytes(100)))


def test_a_bomb_of_zeros_is_refused_by_its_size(tmp_path):
    file = tmp_path / "a.npz"
    count = 5 * 2**30 // 12
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("triangles.npy", npy(TRIANGLES))
        # Declared sizes decide, so that the archive need not hold the zeros.
        written.writestr("vertices.npy", header((count, 3)))
    content = bytearray(file.read_bytes())
    place = content.rfind(b"vertices.npy") - 46 + 24  # the size in the table of contents
    struct.pack_into("<I", content, place, 2**32 - 2)
    file.write_bytes(content)
    assert "would unpack to" in got(file)


def test_a_sparse_file_is_refused_by_the_limit_of_its_kind(tmp_path):
    schema = NpzSchema(title="example", fix="write it again", fields={}, max_bytes=2**20)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as written:
        written.writestr("x.npy", npy(np.zeros(2**18)))
    with pytest.raises(InputError, match="more than 1048576"):
        schema.read(tmp_path / "a.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_other_compressions_are_refused(tmp_path, method):
    assert "compression method" in got(archive(tmp_path / "a.npz", method))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_names_occur_once_and_are_arrays(tmp_path):
    file = archive(tmp_path / "a.npz")
    with zipfile.ZipFile(file, "a") as added:
        added.writestr("vertices.npy", npy(VERTICES))
    assert "each name once" in got(file)
    assert "no array" in got(archive(tmp_path / "b.npz", **{"readme.txt": b"hello"}))
    assert "at most" in got(archive(tmp_path / "c.npz", **{f"n{k}": b"" for k in range(5000)}))


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\5\6" + bytes(18), npy(VERTICES)])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    assert "example" in got(tmp_path / "a.npz")


def test_a_table_of_contents_of_gigabytes_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    with file.open("wb") as stream:
        stream.truncate(2**31)
        stream.seek(0, os.SEEK_END)
        stream.write(b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, 1, 1, 2**31 - 1, 1, 0))
    assert "table of contents" in got(file)


def test_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.npz")
    assert "a named pipe" in got(tmp_path / "a.npz")


def test_damage_is_refused_wherever_it_is(tmp_path):
    rng = np.random.default_rng(0)
    vertices = rng.random((500, 3)).astype(np.float32)
    whole = archive(tmp_path / "a.npz", vertices=npy(vertices)).read_bytes()
    for place in rng.integers(0, len(whole), 200).tolist():
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "b.npz").write_bytes(content)
        try:
            SCHEMA.read(tmp_path / "b.npz")
        except InputError:
            pass  # any other exception fails
    for size in rng.integers(0, len(whole), 50).tolist():
        (tmp_path / "b.npz").write_bytes(whole[:size])
        assert got(tmp_path / "b.npz")
