"""MAT files are read as SciPy writes them; sizes that contradict the bytes are refused before anything is allocated."""

import struct
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from registration.errors import InputError
from registration.storage.mat_files import read_mat

ARRAYS = {
    "double": np.arange(6.0).reshape(2, 3),
    "single": np.arange(6, dtype=np.float32).reshape(3, 2) / 7,
    "whole": np.array([[1, -2, 300]], np.int16),
    "unsigned": np.arange(5, dtype=np.uint32).reshape(1, 5),
    "block": np.arange(24.0).reshape(2, 3, 4),
    "one": np.array([[7.5]]),
    "none": np.zeros((0, 3)),
}


def refuse(*, expected: object, got: object) -> InputError:
    return InputError("The MAT file cannot be read", where="file", expected=expected, got=got)


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_are_read_as_they_were_written(tmp_path, compressed):
    others = {"text": "hello", "struct": {"a": 1}, "cell": np.array([1, "a"], object), "complex": np.ones(2) * 1j}
    savemat(tmp_path / "a.mat", {**ARRAYS, **others}, do_compression=compressed)
    found = read_mat(tmp_path / "a.mat", refuse)
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype, name
    assert read_mat(tmp_path / "a.mat", refuse, ("one",)).keys() == {"one"}


def test_small_whole_numbers_of_a_double_array_are_read(tmp_path):
    """MATLAB itself stores them in fewer bytes."""
    savemat(tmp_path / "a.mat", {"a": np.array([[1, 2]], np.uint8)})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    content[144] = 6  # mxDOUBLE_CLASS
    (tmp_path / "a.mat").write_bytes(content)
    found = read_mat(tmp_path / "a.mat", refuse)["a"]
    assert found.dtype == np.float64 and found.tolist() == [[1.0, 2.0]]


def element(kind: int, content: bytes, size: int | None = None) -> bytes:
    return struct.pack("<II", kind, len(content) if size is None else size) + content + bytes(-len(content) % 8)


def matrix(shape: tuple[int, ...], content: bytes = bytes(16), stored: int = 9) -> bytes:
    flags = element(6, struct.pack("<II", 6, 0))
    dimensions = element(5, struct.pack(f"<{len(shape)}i", *shape))
    return element(14, flags + dimensions + element(1, b"a") + element(stored, content))


DAMAGES = {
    "a wrong size": matrix((2, 2)),
    "2^60 numbers": matrix((2**30, 2**30)),
    "a negative shape": matrix((-1, -2)),
    "one axis": matrix((2,)),
    "an unknown type": matrix((1, 2), stored=99),
    "cut short": matrix((1, 2))[:40],
    "an element of 4 GB": element(14, b"", 2**32 - 8),
    "twice": matrix((1, 2)) * 2,
    "no deflate": element(15, b"hello, world"),
    "deflated 4 GB": element(15, zlib.compress(struct.pack("<II", 14, 2**32 - 8))),
    "deflated and cut": element(15, zlib.compress(matrix((1, 2)))[:30]),
    "a name that is no text": element(
        14, element(6, struct.pack("<II", 6, 0)) + element(5, bytes(8)) + element(1, b"\xff") * 2
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_files_are_refused(tmp_path, name):
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "a.mat").write_bytes(header + DAMAGES[name])
    with pytest.raises(InputError, match="an undamaged MAT file"):
        read_mat(tmp_path / "a.mat", refuse)


def test_other_files_are_refused(tmp_path):
    for content in (b"", b"MATLAB 5.0 MAT-file", b"hello" * 100):
        (tmp_path / "a.mat").write_bytes(content)
        with pytest.raises(InputError, match="another file"):
            read_mat(tmp_path / "a.mat", refuse)
