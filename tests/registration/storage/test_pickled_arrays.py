"""Pickles of arrays are read as Python reads them; what runs, names or makes anything else is refused."""

import collections
import io
import os
import pickle
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from bench.support.python2_pickle import Chumpy, write_pickle
from registration.errors import InputError
from registration.storage import pickle_values
from registration.storage.pickled_arrays import as_array, read_pickled_arrays

ARRAYS = {
    "real": np.arange(6.0).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    "unsigned": np.array([[2**32 - 1, 0]], np.uint32),
    "big": np.arange(3, dtype=">i8"),
    "bytes": np.arange(300, dtype=np.uint8),
    "number": np.array(2.5),
    "empty": np.zeros((0, 3)),
}


def refuse(*, expected: object, got: object) -> InputError:
    return InputError("The pickle cannot be read", where="file", expected=expected, got=got)


def loaded(content: bytes, folder: Path, **limits: int) -> dict[str, object]:
    file = folder / "file.pkl"
    file.write_bytes(content)
    return read_pickled_arrays(file, refuse, **limits)


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_of_python_3_are_read(tmp_path, protocol):
    values = {**ARRAYS, "sparse": sparse.csc_matrix(np.eye(3)[:2]), "scalar": np.float64(2), "text": "é", "none": None}
    if protocol < 2:
        values = {"text": "a", "list": [1, 2.5, (True, None)]}  # arrays of these are texts of Python 2 only
    found = loaded(pickle.dumps(collections.OrderedDict(values), protocol), tmp_path)
    assert found.keys() == values.keys()
    for name in values.keys() & ARRAYS.keys():
        assert np.array_equal(as_array(found[name]), ARRAYS[name]), name
        assert as_array(found[name]).shape == ARRAYS[name].shape
    if protocol >= 2:
        assert np.array_equal(as_array(found["sparse"]), np.eye(3)[:2]) and found["scalar"] == 2.0
        assert found["text"] == "é"


@pytest.mark.parametrize("form", ["csc", "csr", "coo"])
def test_sparse_matrices_are_written_out(tmp_path, form):
    dense = np.random.default_rng(0).normal(size=(4, 7)) * (np.random.default_rng(1).random((4, 7)) > 0.6)
    matrix = sparse.csc_matrix(dense).asformat(form)
    assert np.allclose(as_array(loaded(pickle.dumps({"a": matrix}), tmp_path)["a"]), dense)


def python_2_values() -> dict[str, object]:
    return {"x": Chumpy(ARRAYS["real"]), "s": sparse.csc_matrix(np.eye(3)), "f": ARRAYS["fortran"], "t": "lbs", "n": 3}


def test_python_2_pickles_with_chumpy_are_read(tmp_path):
    write_pickle(python_2_values(), tmp_path / "a.pkl")
    found = read_pickled_arrays(tmp_path / "a.pkl", refuse)
    assert np.array_equal(as_array(found["x"]), ARRAYS["real"]) and np.array_equal(as_array(found["s"]), np.eye(3))
    assert np.array_equal(as_array(found["f"]), ARRAYS["fortran"]) and (found["t"], found["n"]) == ("lbs", 3)


def test_the_writer_makes_what_python_itself_reads(tmp_path, monkeypatch):
    class Ch:
        pass

    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    write_pickle(python_2_values(), tmp_path / "a.pkl")
    with pytest.warns(DeprecationWarning):  # scipy's and NumPy's older names
        found = pickle.loads((tmp_path / "a.pkl").read_bytes(), encoding="latin1")
    assert np.array_equal(found["x"].x, ARRAYS["real"]) and np.array_equal(found["s"].toarray(), np.eye(3))
    assert np.array_equal(found["f"], ARRAYS["fortran"]) and found["t"] == "lbs"


class Runs:
    """Pickles as a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


MARK = "/tmp/gnm-registration-pickle-was-run"
CALLS = {
    "os.system": Runs(os.system, f"touch {MARK}"),
    "eval": Runs(eval, f"open({MARK!r}, 'w')"),
    "exec": Runs(exec, f"open({MARK!r}, 'w')"),
    "getattr": Runs(getattr, "text", "upper"),
    "open": Runs(open, MARK, "w"),
    "numpy.load": Runs(np.load, MARK),
    "numpy.fromfile": Runs(np.fromfile, "/etc/hostname"),
    "numpy.save": Runs(np.save, MARK, np.zeros(3)),
    "numpy.memmap": Runs(np.memmap, MARK, "u1", "w+", 0, (4,)),
    "numpy.zeros": Runs(np.zeros, 2**50),
    "sparse.load_npz": Runs(sparse.load_npz, MARK),
    "sparse.eye": Runs(sparse.eye_array, 10**9),
    "partial": Runs(__import__("functools").partial, os.system, "true"),
    "bytearray": Runs(bytearray, 2**50),
    "bytes": Runs(bytes, 2**50),
    "a class": {"a": collections.Counter("ab")},
    "a record dtype": {"a": np.zeros(2, [("x", "f8")])},
    "a list": [1, 2],
    "a number": 3,
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_nothing_is_run(tmp_path, name, protocol):
    value = CALLS[name]
    content = pickle.dumps(value if name.startswith("a ") else {"v_template": value}, protocol)
    with pytest.raises(InputError) as caught:
        loaded(content, tmp_path)
    assert not Path(MARK).exists() and "a pickle of a mapping of arrays" in caught.value.expected


def program(*parts: bytes) -> bytes:
    return b"\x80\x02" + b"".join(parts) + b"."


RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
EMPTY = RECONSTRUCT + b"(cnumpy\nndarray\n(K\x00tU\x01btR"
DTYPE = b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR"
SHAPE_2_60 = b"(\x8a\x08" + struct.pack("<q", 2**60) + b"t"
HOSTILE = {
    "attributes of a function": program(RECONSTRUCT, b"N}U\x0b__defaults__NsU\x01x\x86b"),
    "attributes of a class": program(b"cnumpy\nndarray\n}U\x01aK\x01sb"),
    "attributes of a dictionary": program(b"}}U\x01aK\x01sb"),
    "attributes of the dtype class": program(b"cnumpy\ndtype\n}U\x01aK\x01sb"),
    "a call of a call's result": program(EMPTY, b"(tR"),
    "a call of chumpy": program(b"cchumpy.ch\nCh\n(tR"),
    "a call of a text": program(b"U\x09os.system(tR"),
    "a dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0fndarray.tofile.x\x93.",
    "a name with a path": program(b"cnumpy.core.multiarray\n_reconstruct.__globals__\n"),
    "a name of scipy": program(b"cscipy.sparse.csc\nos\n"),
    "an instance opcode": program(b"(U\x04trueios\nsystem\n"),
    "an object opcode": program(b"(cos\nsystem\nU\x04trueo"),
    "a persistent id": program(b"Pabc\n"),
    "an extension code": program(b"\x82\x01"),
    "an out-of-band buffer": b"\x80\x05\x97.",
    "2^60 numbers": program(EMPTY, b"(K\x01", SHAPE_2_60, DTYPE, b"\x89U\x00tb"),
    "a negative shape": program(EMPTY, b"(K\x01(J\xff\xff\xff\xfft", DTYPE, b"\x89U\x08" + bytes(8) + b"tb"),
    "an array of objects as numbers": program(EMPTY, b"(K\x01(K\x01tcnumpy\ndtype\n(U\x02O8tR\x89]K\x01atb"),
    "a text of 4 GB": b"\x80\x02T\xff\xff\xff\x7f",
    "an integer of 2 GB": b"\x80\x02\x8b\xff\xff\xff\x7f",
    "an integer of many digits": b"L" + b"9" * 100_000 + b"L\n.",
    "50,000 tuples within one another": program(b"}", b"(" * 50_000, b"t" * 50_000, b"K\x01s"),
    "200,000 operations": program(b"N0" * 10**5, b"N"),
    "arrays again and again": program(
        b"U\x01aq\x00T" + struct.pack("<i", 2**22) + bytes(2**22) + b"q\x010",
        b"".join(EMPTY + b"(K\x01(J" + struct.pack("<i", 2**19) + b"t" + DTYPE + b"\x89h\x01tb" for _ in range(40)),
    ),
    "no stop": b"\x80\x02}",
    "an empty stack": b"\x80\x02.",
    "no mark": program(b"t"),
    "a reference to nothing": program(b"h\x07"),
    "protocol 255": b"\x80\xff\x93.",
    "nothing": b"",
    "a text": b"hello",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_programs_are_refused(tmp_path, name):
    before = {key: dict(vars(value)) for key, value in vars(pickle_values).items() if isinstance(value, type)}
    defaults = pickle_values.CALLABLE[pickle_values.PickledGlobal("numpy", "dtype")].__defaults__
    with pytest.raises(InputError):
        loaded(HOSTILE[name], tmp_path)
    assert before == {key: dict(vars(value)) for key, value in vars(pickle_values).items() if isinstance(value, type)}
    assert pickle_values.CALLABLE[pickle_values.PickledGlobal("numpy", "dtype")].__defaults__ == defaults
    assert not hasattr(np.ndarray, "a")


def test_deep_nesting_that_nobody_reads_is_harmless(tmp_path):
    deep = program(b"}U\x01a", b"N" + b"\x85" * 100_000, b"sU\x01bK\x01s")
    assert loaded(deep, tmp_path)["b"] == 1


def test_large_files_are_not_read(tmp_path):
    with pytest.raises(InputError, match="at most 100 bytes"):
        loaded(pickle.dumps({"a": np.zeros(100)}), tmp_path, max_bytes=100)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"_shape": (10**6, 10**6)}, "numbers"),
        ({"_shape": (-1, 3)}, "without a shape"),
        ({"indptr": np.array([0, 2, 1, 3], np.int32)}, "belong"),
        ({"indices": np.array([0, 1, 9], np.int32)}, "other indices"),
        ({"data": np.ones(2)}, "belong"),
        ({"data": np.array(["a", "b", "c"])}, "wrong"),
        ({"data": None}, "a nonetype"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_contradictory_sparse_matrices_are_refused(tmp_path, change, message):
    matrix = sparse.csc_matrix(np.eye(3))
    vars(matrix).update(change)
    stream = io.BytesIO()
    pickle.Pickler(stream, 2).dump({"a": matrix})
    if message == "wrong":
        with pytest.raises(InputError, match="an array of the type 'U1'"):
            loaded(stream.getvalue(), tmp_path)
        return
    with pytest.raises(ValueError, match=message):
        as_array(loaded(stream.getvalue(), tmp_path)["a"])
