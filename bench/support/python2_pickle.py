"""Pickles as Python 2 wrote them, protocol 2, with chumpy's arrays and SciPy's sparse matrices, byte for byte.

FLAME is published so. Neither Python 2 nor chumpy is needed: the operations are written one by one.
"""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy import sparse


class Chumpy:
    """An array that is pickled as `chumpy.ch.Ch` around it."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array


def write_pickle(values: Mapping[str, object], path: Path) -> None:
    """Write a mapping of texts, numbers, arrays, `Chumpy` arrays and sparse matrices."""
    path.write_bytes(b"\x80\x02" + _value(dict(values)) + b".")


def _value(value: object) -> bytes:
    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    if isinstance(value, str):
        return _string(value.encode("latin-1"))
    if isinstance(value, tuple):
        return b"(" + b"".join(map(_value, value)) + b"t"
    if isinstance(value, dict):
        return b"}(" + b"".join(_value(item) for pair in value.items() for item in pair) + b"u"
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Chumpy):
        return _object("chumpy.ch", "Ch", {"x": value.array, "_status": "new", "_itr": None})
    if isinstance(value, sparse.csc_matrix):
        state = {
            "format": "csc",
            "_shape": tuple(map(int, value.shape)),
            "indptr": value.indptr.astype(np.int32),
            "indices": value.indices.astype(np.int32),
            "data": value.data,
            "maxprint": 50,
        }
        return _object("scipy.sparse.csc", "csc_matrix", state)
    raise TypeError(type(value).__name__)


def _string(content: bytes) -> bytes:
    if len(content) < 256:
        return b"U" + bytes([len(content)]) + content
    return b"T" + struct.pack("<i", len(content)) + content


def _global(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def _object(module: str, name: str, state: dict[str, object]) -> bytes:
    """An object of a new-style class: copy_reg._reconstructor(class, object, None), then its attributes."""
    made = (
        _global("copy_reg", "_reconstructor") + b"(" + _global(module, name) + _global("__builtin__", "object") + b"NtR"
    )
    return made + _value(state) + b"b"


def _array(array: np.ndarray) -> bytes:
    empty = _global("numpy.core.multiarray", "_reconstruct") + b"(" + _global("numpy", "ndarray") + b"(K\x00tU\x01btR"
    order = "|" if array.dtype.itemsize == 1 else "<"
    dtype = _global("numpy", "dtype") + b"(" + _string(array.dtype.str[1:].encode()) + b"K\x00K\x01tR"
    dtype += b"(K\x03" + _string(order.encode()) + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    fortran = array.flags.f_contiguous and not array.flags.c_contiguous
    content = array.astype(array.dtype.newbyteorder(order)).tobytes("F" if fortran else "C")
    shape = _value(tuple(map(int, array.shape)))
    return empty + b"(K\x01" + shape + dtype + (b"\x88" if fortran else b"\x89") + _string(content) + b"tb"
