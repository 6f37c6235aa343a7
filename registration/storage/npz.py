"""NPZ files of a declared schema: one table of types and shapes checks what is read and what is written."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from registration.errors import InputError

Kind = Literal["text", "float", "integer", "bool"]
_DTYPE_KINDS: dict[Kind, str] = {"text": "U", "float": "f", "integer": "iu", "bool": "b"}


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
    max_bytes: int | None = None  # of all arrays, unpacked

    def read(self, file: Path) -> dict[str, np.ndarray]:
        """Read all arrays of a file, also those outside the schema. Nothing is unpickled.

        Raises:
            InputError: the file is missing or damaged, a field is missing, or breaks the schema.
        """
        arrays = self._load(Path(file))
        if (defect := self.find_defect(arrays)) is not None:
            raise self.error(defect, file)
        return arrays

    def find_defect(self, arrays: Mapping[str, np.ndarray], *, finite: bool | None = None) -> Defect | None:
        """Return the first defect of arrays, or None. `finite` overrides the schema's."""
        if missing := [name for name in self.fields if name not in arrays]:
            expected = f"the {len(self.fields)} fields of the format"
            got = f"{len(self.fields) - len(missing)} of them; missing: {', '.join(missing)}"
            return Defect(name=missing[0], what="", expected=expected, got=got)
        lengths: dict[str, int] = {}
        finite = self.finite if finite is None else finite
        for name, (kind, axes) in self.fields.items():
            if (defect := self._defect(name, arrays[name], kind, axes, lengths, finite)) is not None:
                return defect
        for prefix, (kind, axes) in self.families.items():
            for name in (name for name in arrays if name.startswith(prefix)):
                if (defect := self._defect(name, arrays[name], kind, axes, {}, finite)) is not None:
                    return defect
        for name, letter in self.indices.items():
            array, count = arrays[name], lengths[letter]
            if array.size and not (array.min() >= 0 and array.max() < count):
                got = f"{array.min()} to {array.max()}"
                return Defect(name=name, what="index", expected=f"indices from 0 to {count - 1}", got=got)
        return None

    def error(self, defect: Defect, where: object) -> InputError:
        """Return the error for a defect of the file `where`."""
        what = f"has a wrong {defect.what}" if defect.what else "is missing"
        sentence = f"The {self.title}'s field '{defect.name}' {what}"
        return InputError(sentence, where=where, expected=defect.expected, got=defect.got, fix=self.fix)

    def _load(self, file: Path) -> dict[str, np.ndarray]:
        if not file.is_file():
            what = f"The {self.title} is missing"
            raise InputError(what, where=file, expected="an NPZ file", got="no such file", fix=self.fix)
        name, arrays = "", {}
        try:
            if self.max_bytes is not None:
                check_unpacked_size(file, self.max_bytes)
            with np.load(file, allow_pickle=False) as archive:
                if not isinstance(archive, np.lib.npyio.NpzFile):
                    raise ValueError("a single array")
                for name in archive.files:
                    arrays[name] = archive[name]
                    if not isinstance(arrays[name], np.ndarray):  # numpy returns other members of the archive as bytes
                        raise ValueError("no array")
        except Exception as error:  # a damaged or hostile file makes zipfile, zlib and numpy raise nearly anything
            part = f"'s field '{name}'" if name else ""
            raise InputError(
                f"The {self.title}{part} cannot be read",
                where=file,
                expected="an undamaged NPZ file of plain arrays (pickled objects are never loaded)",
                got=f"{type(error).__name__}: {error}",
                fix=self.fix,
            ) from error
        return arrays

    def _defect(
        self, name: str, array: np.ndarray, kind: Kind, axes: str, lengths: dict[str, int], finite: bool
    ) -> Defect | None:
        """The defect of one array. Adds new letters to `lengths`."""
        if array.dtype.kind not in _DTYPE_KINDS[kind]:
            return Defect(name=name, what="type", expected=f"a {kind} array", got=str(array.dtype))
        letters = axes.split()
        expected = "(" + ", ".join(f"{axis}={lengths[axis]}" if axis in lengths else axis for axis in letters) + ")"
        wrong_shape = Defect(name=name, what="shape", expected=expected, got=array.shape)
        if array.ndim != len(letters):
            return wrong_shape
        for axis, length in zip(letters, array.shape, strict=True):
            factor, _, letter = axis.rpartition("*")
            if axis.isalpha() and letter not in lengths and (length > 0 or letter not in self.never_empty):
                lengths[letter] = length
            if length != (int(letter) if letter.isdigit() else int(factor or 1) * lengths.get(letter, -1)):
                return wrong_shape
        if finite and kind == "float" and not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))
            got = f"{len(bad)} NaN or infinite, first at {tuple(bad[0].tolist())}"
            return Defect(name=name, what="value", expected="finite numbers", got=got)
        return None


def check_unpacked_size(path: Path, limit: int) -> None:
    """Refuse a file that would unpack to more than `limit` bytes: a megabyte of deflated zeros may hold a terabyte.

    Raises:
        ValueError: the limit is exceeded. Other errors as `zipfile`; a file that is no ZIP archive passes.
    """
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > limit:
        raise ValueError(f"it would unpack to {unpacked} bytes, more than {limit}")
