"""Values of parsed files by name and type; what is missing or of another type is an error that names the entry."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registration.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Fields:
    """An object of a parsed JSON, YAML or similar file.

    Attributes:
        values: name -> value.
        where: the file and the entry, for messages.
        title: what messages call the file, after "The".
        fix: what to do about an error.
    """

    values: Mapping[str, Any]
    where: str
    title: str
    fix: str = "export it again, or see docs/formats.md"

    def error(self, name: str, expected: object, got: object) -> InputError:
        """Return the error of one value."""
        where = f"{self.where}: {name}" if name else self.where
        what = f"The {self.title} cannot be used"
        return InputError(what, where=where, expected=expected, got=got, fix=self.fix)

    def __contains__(self, name: str) -> bool:
        return self.values.get(name) is not None

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number. Raises InputError if it is none, or missing without a default."""
        value = self._value(name, "a number", default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self.error(name, "a finite number", value)
        return float(value)

    def size(self, name: str) -> int:
        """Return a number of pixels from 1 to 65535. Raises InputError."""
        value = self.number(name)
        if value != int(value) or not 0 < value < 2**16:
            raise self.error(name, "a whole number of pixels from 1 to 65535", value)
        return int(value)

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text. Raises InputError."""
        value = self._value(name, "a text", default)
        if not isinstance(value, str):
            raise self.error(name, "a text", value)
        return value

    def array(self, name: str, *shapes: tuple[int, ...]) -> np.ndarray:
        """Return float64 numbers of one of these shapes; -1 is any length. Raises InputError."""
        return number_array(self._value(name, "numbers", None), shapes, lambda want, got: self.error(name, want, got))

    def objects(self, name: str) -> list["Fields"]:
        """Return a list of objects. Raises InputError."""
        value = self._value(name, "a list of objects", None)
        if not isinstance(value, Sequence) or isinstance(value, str) or not all(isinstance(v, Mapping) for v in value):
            raise self.error(name, "a list of objects", type(value).__name__)
        return [
            Fields(values=item, where=f"{self.where}: {name}[{index}]", title=self.title, fix=self.fix)
            for index, item in enumerate(value)
        ]

    def _value(self, name: str, expected: str, default: Any) -> Any:
        value = self.values.get(name)
        if value is None:
            value = default
        if value is None:
            raise self.error(name, expected, "nothing")
        return value


def number_array(value: Any, shapes: Sequence[tuple[int, ...]], refuse: Any) -> np.ndarray:
    """Return a value as float64 numbers of one of some shapes; -1 is any length.

    Raises:
        InputError: made by `refuse(expected, got)`: it holds other things, or numbers that are not finite.
    """
    wanted = " or ".join(" x ".join("N" if length < 0 else str(length) for length in shape) for shape in shapes)
    try:
        array = np.asarray(value)
    except ValueError:
        raise refuse(f"{wanted} numbers", "rows of different lengths") from None
    if array.dtype.kind not in "iuf":
        raise refuse(f"{wanted} numbers", f"{value!r:.80}")
    fits = any(
        array.ndim == len(shape) and all(n < 0 or n == m for n, m in zip(shape, array.shape, strict=True))
        for shape in shapes
    )
    if not fits:
        raise refuse(f"{wanted} numbers", f"an array of shape {array.shape}")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise refuse("finite numbers", f"{array[~np.isfinite(array)][0]}")
    return array


def read_object(file: Path, title: str) -> Fields:
    """Read a JSON file that is one object. Raises InputError as `registration.storage.reading.read_json`."""
    from registration.storage.reading import read_json

    fields = Fields(values={}, where=str(file), title=title)

    def refuse(expected: object, got: object) -> InputError:
        return fields.error("", expected, got)

    value = read_json(file, refuse)
    if not isinstance(value, dict):
        raise refuse("an object", type(value).__name__)
    return Fields(values=value, where=str(file), title=title)
