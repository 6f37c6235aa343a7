"""Safetensors files: named arrays behind a JSON header. Nothing in them is executed."""

from pathlib import Path

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from registration.storage.files import atomic_file
from registration.storage.reading import Refuse, read_bytes

MAX_BYTES = 256 * 2**20
_KINDS = "fiub"  # of arrays


def read_tensors(file: Path, refuse: Refuse, *, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read the arrays of a file, by name.

    Args:
        file: its path.
        refuse: makes the error.
        max_bytes: largest size that is accepted; arrays take no more memory than the file.

    Raises:
        InputError: it cannot be read, is larger, is no safetensors file, or an array has a type that NumPy lacks or
            values that are not finite.
    """
    expected = "an undamaged safetensors file"
    content = read_bytes(file, refuse, max_bytes=max_bytes)
    try:
        arrays = safetensors.numpy.load(content)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, OverflowError, MemoryError) as error:
        raise refuse(expected=expected, got=f"{type(error).__name__}: {error}") from None
    for name, array in arrays.items():
        if array.dtype.kind not in _KINDS:
            raise refuse(expected="arrays of numbers", got=f"{name}: {array.dtype}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise refuse(expected="finite numbers", got=f"{name}: {int((~np.isfinite(array)).sum())} others")
    return dict(arrays)


def write_tensors(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays by name, in one rename. Equal arrays make equal files."""
    ordered = {name: np.ascontiguousarray(arrays[name]) for name in sorted(arrays)}
    with atomic_file(file) as temporary:
        temporary.write_bytes(safetensors.numpy.save(ordered))
