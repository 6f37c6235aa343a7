"""NPZ files of a declared schema: one table of types and shapes checks what is read and what is written.

A file may come from anybody: sizes, types and shapes are compared with one another and with the schema before an array
is allocated, and nothing is unpickled.
"""

import math
import os
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from registration.errors import InputError
from registration.storage.reading import open_file

Kind = Literal["text", "float", "integer", "bool"]
_DTYPE_KINDS: dict[Kind, str] = {"text": "U", "float": "f", "integer": "iu", "bool": "b"}
MAX_BYTES = 2**36  # of all arrays of a file, unpacked, where its schema has no other limit
_PLAIN_BYTES = 2**28  # that any file may unpack to
_MAX_RATIO = 100  # of the unpacked size to the file's, beyond `_PLAIN_BYTES`; heads' models have up to 20
_MAX_DEFLATION = 1032  # of one member: the format's own limit
_MAX_MEMBERS = 4096
_MAX_READ_BYTES = 2**24  # at once: zipfile reads the table of contents whole


@runtime_checkable
class ArrayHeader(Protocol):
    """Type and shape of an array, of which the values may not be read yet."""

    @property
    def dtype(self) -> np.dtype[Any]: ...
    @property
    def shape(self) -> tuple[int, ...]: ...


@dataclass(frozen=True)
class _Header:
    """What a file says about an array."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Defect:
    """A field that breaks the schema."""

    name: str
    what: str  # "type", "shape", "value" or "index"; "" if the field is missing
    expected: object
    got: object


@dataclass(frozen=True, kw_only=True)
class NpzSchema:
    """Declares the arrays of an NPZ file.

    Shapes are axis letters: `"J 9*V 3"` is three axes of the lengths of J, nine times that of V, and 3. A letter is one
    length within a file; the first field that has it alone on an axis sets it.
    """

    title: str  # what messages call the file, after "The"
    fix: str  # how a user gets a valid one
    fields: Mapping[str, tuple[Kind, str]]  # name -> type, axes
    families: Mapping[str, tuple[Kind, str]] = field(default_factory=dict)  # name's prefix -> as `fields`, own letters
    indices: Mapping[str, str] = field(default_factory=dict)  # field of indices -> the letter that they count
    never_empty: str = ""  # letters of axes that must not have length 0
    finite: bool = True  # whether floats must be finite
    max_bytes: int = MAX_BYTES  # of all arrays, unpacked

    def read(self, file: Path, only: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Read the arrays of a file. Nothing is unpickled.

        Args:
            file: its path.
            only: names of the arrays to read; None: all, also those outside the schema. The types and shapes of all are
                checked either way.

        Raises:
            InputError: the file is missing, damaged or larger than its kind may be, a field is missing, or breaks the
                schema.
        """
        file = Path(file)
        if not os.path.exists(file):
            what = f"The {self.title} is missing"
            raise InputError(what, where=file, expected="an NPZ file", got="no such file", fix=self.fix)
        with open_file(file, partial(InputError.unreadable, self.title, where=file, fix=self.fix)) as stream:
            members = self._members(file, stream)
            headers = {name: self._header(file, members, name) for name in members.names}
            if (defect := self.find_defect(headers, values=())) is not None:
                raise self.error(defect, file)
            names = [name for name in headers if only is None or name in only]
            arrays = {name: self._array(file, members, name) for name in names}
        if (defect := self.find_defect({**headers, **arrays}, values=names)) is not None:
            raise self.error(defect, file)
        return arrays

    def names(self, file: Path) -> tuple[str, ...]:
        """Return the names of a file's arrays, whether they are in the schema or not. Raises InputError as `read`."""
        with open_file(file, partial(InputError.unreadable, self.title, where=file, fix=self.fix)) as stream:
            return self._members(file, stream).names

    def find_defect(
        self,
        arrays: Mapping[str, ArrayHeader],
        *,
        finite: bool | None = None,
        values: Collection[str] | None = None,
    ) -> Defect | None:
        """Return the first defect of arrays, or None.

        Args:
            arrays: by name.
            finite: overrides the schema's.
            values: names of the arrays whose values are checked besides type and shape; None: all.
        """
        if missing := [name for name in self.fields if name not in arrays]:
            expected = f"the {len(self.fields)} fields of the format"
            got = f"{len(self.fields) - len(missing)} of them; missing: {', '.join(missing)}"
            return Defect(name=missing[0], what="", expected=expected, got=got)
        lengths: dict[str, int] = {}
        families = {n: f for prefix, f in self.families.items() for n in arrays if n.startswith(prefix)}
        declared = {**self.fields, **families}
        for name, (kind, axes) in declared.items():
            own = lengths if name in self.fields else {}  # a family's letters are its own
            if (defect := self._header_defect(name, arrays[name], kind, axes, own)) is not None:
                return defect
        checked = {n: a for n, a in arrays.items() if isinstance(a, np.ndarray) and (values is None or n in values)}
        if self.finite if finite is None else finite:
            for name, array in checked.items():
                if name in declared and (defect := _not_finite(name, array)) is not None:
                    return defect
        for name, letter in self.indices.items():
            array, count = checked.get(name, np.zeros(0, int)), lengths[letter]
            if array.size and not (array.min() >= 0 and array.max() < count):
                got = f"{array.min()} to {array.max()}"
                return Defect(name=name, what="index", expected=f"indices from 0 to {count - 1}", got=got)
        return None

    def error(self, defect: Defect, where: object) -> InputError:
        """Return the error for a defect of the file `where`."""
        what = f"has a wrong {defect.what}" if defect.what else "is missing"
        sentence = f"The {self.title}'s field '{defect.name}' {what}"
        return InputError(sentence, where=where, expected=defect.expected, got=defect.got, fix=self.fix)

    def _members(self, file: Path, stream: BufferedReader) -> "_Members":
        """Open the archive and check the sizes that it declares."""
        try:
            return _Members(stream, self.max_bytes)
        except Exception as error:  # a damaged or hostile file makes zipfile raise nearly anything
            raise self._unreadable(file, "", error) from None

    def _header(self, file: Path, members: "_Members", name: str) -> _Header:
        try:
            return members.header(name)
        except Exception as error:  # as above, and NumPy
            raise self._unreadable(file, name, error) from None

    def _array(self, file: Path, members: "_Members", name: str) -> np.ndarray:
        try:
            return members.array(name)
        except Exception as error:  # as above, and zlib
            raise self._unreadable(file, name, error) from None

    def _unreadable(self, file: Path, name: str, error: Exception) -> InputError:
        part = f"'s field '{name}'" if name else ""
        return InputError.unreadable(
            f"{self.title}{part}",
            where=file,
            expected="an undamaged NPZ file of plain arrays (pickled objects are never loaded)",
            got=f"{type(error).__name__}: {error}",
            fix=self.fix,
        )

    def _header_defect(
        self, name: str, array: ArrayHeader, kind: Kind, axes: str, lengths: dict[str, int]
    ) -> Defect | None:
        """The defect of the type or shape of an array. Adds new letters to `lengths`."""
        if array.dtype.kind not in _DTYPE_KINDS[kind]:
            return Defect(name=name, what="type", expected=f"a {kind} array", got=str(array.dtype))
        letters = axes.split()
        expected = "(" + ", ".join(f"{axis}={lengths[axis]}" if axis in lengths else axis for axis in letters) + ")"
        wrong_shape = Defect(name=name, what="shape", expected=expected, got=array.shape)
        if len(array.shape) != len(letters):
            return wrong_shape
        for axis, length in zip(letters, array.shape, strict=True):
            factor, _, letter = axis.rpartition("*")
            if axis.isalpha() and letter not in lengths and (length > 0 or letter not in self.never_empty):
                lengths[letter] = length
            if length != (int(letter) if letter.isdigit() else int(factor or 1) * lengths.get(letter, -1)):
                return wrong_shape
        return None


def _not_finite(name: str, array: np.ndarray) -> Defect | None:
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return None
    bad = np.argwhere(~np.isfinite(array))
    got = f"{len(bad)} NaN or infinite, first at {tuple(bad[0].tolist())}"
    return Defect(name=name, what="value", expected="finite numbers", got=got)


class _Members:
    """The arrays of an archive, whose declared sizes were checked."""

    def __init__(self, stream: BufferedReader, max_bytes: int) -> None:
        size = os.fstat(stream.fileno()).st_size
        self._archive = zipfile.ZipFile(_Bounded(stream))
        infos = self._archive.infolist()
        self._infos = {info.filename.removesuffix(".npy"): info for info in infos}
        self.names = tuple(self._infos)
        if len(infos) > _MAX_MEMBERS or len(self.names) < len(infos):
            raise ValueError(f"{len(infos)} members; at most {_MAX_MEMBERS}, each name once")
        unpacked = sum(info.file_size for info in infos)
        if unpacked > (limit := min(max_bytes, max(_PLAIN_BYTES, _MAX_RATIO * size))):
            raise ValueError(f"it would unpack to {unpacked} bytes, more than {limit}")
        if sum(info.compress_size for info in infos) > size:
            raise ValueError("the members are larger than the file")

    def header(self, name: str) -> _Header:
        """Parse the header of a member, and compare it with the member's size."""
        info = self._infos[name]
        if not info.filename.endswith(".npy"):
            raise ValueError("no array")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"compression method {info.compress_type}, which NPZ files do not have")
        if info.file_size > _MAX_DEFLATION * max(info.compress_size, 1):
            raise ValueError(f"{info.file_size} bytes cannot be in {info.compress_size}")
        with self._archive.open(info) as member:
            dtype, shape = _npy_header(member)  # type: ignore[arg-type]  # it is a ZipExtFile
            held = info.file_size - member.tell()
        if dtype.hasobject:
            raise ValueError("an array of Python objects, which would have to be unpickled")
        needed = math.prod(shape) * max(dtype.itemsize, 1)
        if min(shape, default=0) < 0 or needed != held:
            raise ValueError(f"an array of type {dtype} and shape {shape} needs {needed} bytes, there are {held}")
        return _Header(dtype, shape)

    def array(self, name: str) -> np.ndarray:
        with self._archive.open(self._infos[name]) as member:
            array: np.ndarray = np.lib.format.read_array(member, allow_pickle=False)
            if member.read(1):  # also makes zipfile compare the checksum
                raise ValueError("bytes behind the array")
        return array


def _npy_header(member: zipfile.ZipExtFile) -> tuple[np.dtype[Any], tuple[int, ...]]:
    version = np.lib.format.read_magic(member)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(member)
    return dtype, shape


class _Bounded:
    """A file that is never asked for more than `_MAX_READ_BYTES` at once."""

    def __init__(self, stream: BufferedReader) -> None:
        self._stream = stream
        self.seek, self.tell, self.seekable = stream.seek, stream.tell, stream.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_READ_BYTES:
            raise ValueError(f"a table of contents of {size} bytes")
        return self._stream.read(min(size, _MAX_READ_BYTES) if size >= 0 else _MAX_READ_BYTES)
