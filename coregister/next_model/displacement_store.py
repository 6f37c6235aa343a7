"""Meshes kept on disk between passes: as many as there are, in the memory of a few."""

import tempfile
from collections.abc import Iterator
from types import TracebackType

import numpy as np
from jaxtyping import Float

_BLOCK = 64  # meshes read at once


class Spool:
    """Displacements of one topology in a temporary file, float32; written once, read several times.

    A context manager: the file is gone afterwards. It takes 12 bytes a vertex and mesh.
    """

    def __init__(self, vertices: int):
        self._shape = (vertices, 3)
        self._file = tempfile.TemporaryFile(prefix="gnmreg-")
        self.count = 0

    def __enter__(self) -> "Spool":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()

    def append(self, displacement: Float[np.ndarray, "V 3"]) -> None:
        if displacement.shape != self._shape:
            raise ValueError(f"{displacement.shape} in a spool of {self._shape}")
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(displacement, np.float32).tobytes())
        self.count += 1

    def __iter__(self) -> Iterator[Float[np.ndarray, "V 3"]]:
        size = 4 * self._shape[0] * 3
        for first in range(0, self.count, _BLOCK):
            self._file.seek(first * size)
            block = self._file.read(min(_BLOCK, self.count - first) * size)
            yield from np.frombuffer(block, np.float32).reshape(-1, *self._shape)
