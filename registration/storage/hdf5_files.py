"""HDF5 files that somebody else may have written: their plain arrays, read from memory.

The library is given bytes instead of a path, so that links to other files and external storage lead nowhere; types and
sizes of arrays are checked before they are read.
"""

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from registration.errors import InputError
from registration.storage.reading import Refuse, decode_text, read_bytes

MAX_BYTES = 64 * 2**20  # of a file
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_USER_BLOCKS = (0, 512)  # where the signature may lie: MATLAB puts a header of its own before it
_KINDS = {"f": "floats", "iu": "integers", "fiu": "numbers"}
_MAX_VALUES = 2**26  # of an array
_MAX_RATIO = 1000  # of an array's size to that of the file: HDF5 may compress
_MAX_TEXT = 2**22  # characters of an attribute


class Hdf5:
    """An open file, whose parts are named by paths."""

    def __init__(self, file: h5py.File, size: int, refuse: Refuse) -> None:
        self._file, self._size, self._refuse = file, size, refuse

    def has(self, path: str) -> bool:
        """Whether there is a dataset of this path, reached by no link to elsewhere."""
        try:
            self._dataset(path)
        except InputError:
            return False
        return True

    def array(self, path: str, *, kinds: str = "f") -> np.ndarray:
        """Read a dataset of finite numbers.

        Args:
            path: of the dataset.
            kinds: of its numbers, as NumPy's letters: "f" floats, "iu" integers.

        Raises:
            InputError: there is none, it lies behind a soft or external link, is virtual or stored elsewhere, is no
                array of these numbers, is too large, is damaged, or holds values that are not finite.
        """
        dataset = self._dataset(path)
        try:
            shape, dtype = dataset.shape, dataset.dtype
            plain = dataset.external is None and not dataset.is_virtual and dtype.kind in kinds and shape is not None
        except Exception as error:  # a damaged file makes the library raise nearly anything
            raise self._damaged(path, error) from None
        if not plain:
            raise self._refuse(
                expected=f"{path}: an array of {_KINDS.get(kinds, kinds)} in this file", got="something else"
            )
        if math.prod(shape) > _MAX_VALUES or math.prod(shape) * dtype.itemsize > _MAX_RATIO * self._size:
            raise self._refuse(expected=f"{path}: at most {_MAX_VALUES} values", got=f"shape {shape}")
        try:
            values = np.asarray(dataset[()])
        except Exception as error:  # as above
            raise self._damaged(path, error) from None
        if not np.isfinite(values).all():
            raise self._refuse(expected=f"{path}: finite numbers", got="others")
        return values

    def text_attribute(self, name: str) -> str:
        """Read a text attribute of the file. Raises InputError: there is none, or it is no text of a sensible size."""
        try:
            value = self._file.attrs[name]
        except Exception as error:  # as above
            raise self._damaged(name, error) from None
        text = decode_text(value, self._refuse) if isinstance(value, bytes) else value
        if not isinstance(text, str) or len(text) > _MAX_TEXT:
            raise self._refuse(expected=f"{name}: a text", got=type(value).__name__)
        return text

    def _dataset(self, path: str) -> h5py.Dataset:
        node = self._file
        try:
            for name in path.split("/"):
                link = node.get(name, getlink=True)
                if not isinstance(link, h5py.HardLink):
                    raise self._refuse(expected=f"{path} in this file", got="a link, or nothing")
                node = node[name]
        except (KeyError, OSError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise self._damaged(path, error) from None
        if not isinstance(node, h5py.Dataset):
            raise self._refuse(expected=f"{path}: an array", got=type(node).__name__)
        return node

    def _damaged(self, path: str, error: Exception) -> Exception:
        return self._refuse(expected=f"an undamaged HDF5 file with {path}", got=f"{type(error).__name__}: {error}")


@contextmanager
def open_hdf5(file: Path, refuse: Refuse, *, max_bytes: int = MAX_BYTES) -> Iterator[Hdf5]:
    """Open an HDF5 file.

    Args:
        file: its path.
        refuse: makes the error.
        max_bytes: largest size that is accepted; it is read into memory.

    Raises:
        InputError: it cannot be read, is larger, or is no HDF5 file.
    """
    content = read_bytes(file, refuse, max_bytes=max_bytes)
    if not any(content.startswith(_SIGNATURE, at) for at in _USER_BLOCKS):
        raise refuse(expected="an HDF5 file", got="a file without its signature")
    try:
        opened = h5py.File(io.BytesIO(content), "r")
    except Exception as error:  # as above
        raise refuse(expected="an undamaged HDF5 file", got=f"{type(error).__name__}: {error}") from None
    with opened:
        yield Hdf5(opened, len(content), refuse)
