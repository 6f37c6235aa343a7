"""Files of OpenCV's FileStorage in YAML, read with limits: a hostile one neither crashes its parser nor fills memory.

Matrices are made from their numbers, never allocated from the size that the file declares.
"""

import math
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from registration.errors import InputError
from registration.formats.fields import Fields
from registration.storage.reading import read_text

_MAX_BYTES = 4 * 2**20
_MAX_DEPTH = 32  # of brackets, and of indentation in pairs of spaces
_HEADER = "%YAML:1.0\n---\n"
_TITLE = "calibration file"
_FIX = "write it with OpenCV's FileStorage, or see docs/formats.md"


def read_file_storage(file: Path) -> Fields:
    """Read a YAML file of OpenCV's FileStorage; matrices become arrays.

    Raises:
        InputError: it is missing, larger than 4 MiB, nested too deeply, or cannot be parsed.
    """
    refuse = partial(InputError, f"The {_TITLE} cannot be read", where=file, fix=_FIX)
    text = read_text(file, refuse, max_bytes=_MAX_BYTES)
    if defect := _too_deep(text):
        raise refuse(expected=f"at most {_MAX_DEPTH} levels", got=defect)
    if not text.startswith("%YAML"):
        text = _HEADER + text.removeprefix("---\n")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        values = {name: _value(root.getNode(name)) for name in root.keys()} if root.isMap() else {}
        storage.release()
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        got = str(error).strip().splitlines()[0][-160:] if isinstance(error, cv2.error) else "text that is none"
        raise refuse(expected="YAML as OpenCV writes it", got=got) from None
    except (ValueError, TypeError) as error:
        raise refuse(expected="matrices with as many numbers as rows x cols", got=error) from None
    return Fields(values=values, where=str(file), title=_TITLE, fix=_FIX)


def _too_deep(text: str) -> str | None:
    letters = np.frombuffer(text.encode("utf-8"), np.uint8)
    opened = np.isin(letters, list(b"[{")).astype(np.int64) - np.isin(letters, list(b"]}"))
    if len(letters) and (depth := int(np.cumsum(opened).max())) > _MAX_DEPTH:
        return f"{depth} brackets within one another"
    indented = max((len(line) - len(line.lstrip(" -")) for line in text.splitlines()), default=0)
    return f"lines indented by {indented}" if indented > 8 * _MAX_DEPTH else None


def _value(node: Any) -> Any:
    if node.isMap():
        parts = {name: _value(node.getNode(name)) for name in node.keys()}
        if {"rows", "cols", "data"} <= parts.keys():
            return _matrix(parts["data"], (parts["rows"], parts["cols"]))
        return _matrix(parts["data"], parts["sizes"]) if {"sizes", "data"} <= parts.keys() else parts
    if node.isSeq():
        return [_value(node.at(index)) for index in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real() if node.isReal() else int(node.real())
    return node.string() if node.isString() else None


def _matrix(data: Any, sizes: Any) -> np.ndarray:
    """A matrix, or an array of more or fewer axes, of one or several channels."""
    numbers = np.asarray(data, np.float64)
    shape = tuple(int(size) for size in sizes)
    count = math.prod(shape)
    if numbers.ndim != 1 or min(shape, default=0) < 1 or not numbers.size or numbers.size % count:
        raise ValueError(f"{' x '.join(map(str, shape))} and {numbers.size} numbers")
    return numbers.reshape(shape) if numbers.size == count else numbers.reshape(*shape, -1)
