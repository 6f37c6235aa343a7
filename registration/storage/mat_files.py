"""MATLAB's MAT files of version 5: their numeric arrays, with every size compared with the bytes that are there.

Structures, cells, texts, sparse and complex arrays are skipped. Files of version 7.3 are HDF5 (`hdf5_files`).
"""

import math
import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from registration.storage.reading import Refuse, read_bytes

MAX_BYTES = 2**31
_TITLE = b"MATLAB 5.0 MAT-file"
_HEADER_BYTES = 128
_MAX_INFLATED = 2**32  # of one array
_MAX_RATIO = 1032  # of deflation
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_COMPLEX = 0x08


def is_mat(start: bytes) -> bool:
    """Whether a file begins as MAT files of version 5 do."""
    return start.startswith(_TITLE)


def read_mat(
    file: Path, refuse: Refuse, only: Collection[str] | None = None, *, max_bytes: int = MAX_BYTES
) -> dict[str, np.ndarray]:
    """Read the numeric arrays of a MAT file of version 5, as MATLAB shows them.

    Args:
        file: its path.
        refuse: makes the error.
        only: names of the arrays to read; None: all.
        max_bytes: largest size of the file.

    Returns:
        By name, in the type that the file stores the class in; a name that the file lacks is absent.

    Raises:
        InputError: it cannot be read, is larger, is no such file, or sizes in it contradict each other.
    """
    content = read_bytes(file, refuse, max_bytes=max_bytes)
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if not is_mat(content) or order is None:
        raise refuse(expected="a MAT file of version 5", got="another file")
    arrays: dict[str, np.ndarray] = {}
    try:
        for kind, data in _elements(memoryview(content)[_HEADER_BYTES:], order):
            if kind == _COMPRESSED:
                kind, data = _inflated(data, order)
            if kind != _MATRIX or not len(data):
                continue
            found = _matrix(data, order, only)
            if found is not None:
                if found.name in arrays:
                    raise ValueError(f"the array {found.name!r} twice")
                arrays[found.name] = found.values
    except (ValueError, IndexError, struct.error, zlib.error, UnicodeError) as error:
        raise refuse(expected="an undamaged MAT file", got=error) from None
    return arrays


@dataclass(frozen=True, kw_only=True)
class _Found:
    name: str
    values: np.ndarray


def _elements(data: memoryview, order: str, *, padded: bool = False) -> "list[tuple[int, memoryview]]":
    """Type and content of the elements that follow one another; `padded`: to 8 bytes, as within an array."""
    found, at = [], 0
    while at < len(data):
        if at + 8 > len(data):
            if not any(data[at:]):
                break
            raise ValueError("an element cut short")
        first, size = struct.unpack_from(f"{order}II", data, at)
        if first >> 16:  # a small element: its size and type share four bytes
            kind, size, start, end = first & 0xFFFF, first >> 16, at + 4, at + 8
            if size > 4:
                raise ValueError("a small element of more than 4 bytes")
        else:
            kind, start, end = first, at + 8, at + 8 + size
            end += -end % 8 if padded else 0
        if start + size > len(data):
            raise ValueError(f"an element of {size} bytes, of which {max(len(data) - start, 0)} are there")
        found.append((kind, data[start : start + size]))
        at = end
    return found


def _inflated(data: memoryview, order: str) -> tuple[int, memoryview]:
    """The array within a compressed element, whose size its first bytes state."""
    stream = zlib.decompressobj()
    start = stream.decompress(data, 8)
    kind, size = struct.unpack(f"{order}II", start)
    if size > min(_MAX_INFLATED, _MAX_RATIO * max(len(data), 1)):
        raise ValueError(f"an array of {size} bytes in {len(data)}")
    content = stream.decompress(stream.unconsumed_tail, size + 8) if size else b""
    if len(content) < size:
        raise ValueError(f"an array of {size} bytes, of which {len(content)} are there")
    return kind, memoryview(content)[:size]


def _matrix(data: memoryview, order: str, only: Collection[str] | None) -> _Found | None:
    """The array of an element; None if it is no wanted numeric one."""
    parts = _elements(data, order, padded=True)
    if len(parts) < 3 or len(parts[0][1]) < 8:
        return None
    flags = struct.unpack_from(f"{order}I", parts[0][1])[0]
    name = bytes(parts[2][1]).decode("ascii")
    code, kind = flags & 0xFF, (flags >> 8) & 0xFF
    if code not in _CLASSES or kind & _COMPLEX or len(parts) < 4 or (only is not None and name not in only):
        return None
    shape = np.frombuffer(parts[1][1], f"{order}i4").tolist()
    stored = _NUMBERS.get(parts[3][0])
    if stored is None or not 2 <= len(shape) <= 8 or min(shape) < 0:
        raise ValueError(f"the array {name[:40]!r} without a type or a shape")
    needed = math.prod(shape) * int(stored[1:])
    if needed != len(parts[3][1]):
        raise ValueError(f"the array {name[:40]!r} of shape {shape}, which needs {needed} bytes, of {len(parts[3][1])}")
    values = np.frombuffer(parts[3][1], order + stored).reshape(shape, order="F")
    wanted = _CLASSES[code]  # small whole numbers of a double array are stored in fewer bytes
    return _Found(name=name, values=values.astype(wanted))
