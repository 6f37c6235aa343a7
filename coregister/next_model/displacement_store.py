"""Displacements on disk between passes: any number of meshes in the memory of a few."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Float


class DisplacementStore:
    """Displacements of one topology in a temporary NPY file, float32; appended, and read any number of times.

    A context manager that deletes the file on exit. The file has 12 bytes a vertex and mesh.
    """

    def __init__(self, capacity: int, vertices: int):
        """Reserve the file.

        Args:
            capacity: number of meshes, at most.
            vertices: of every mesh.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="gnmreg-")
        file = Path(self._folder.name) / "displacements.npy"
        shape = (max(capacity, 1), vertices, 3)  # an empty file cannot be mapped
        self._array = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
        self.count = 0

    def __enter__(self) -> "DisplacementStore":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        del self._array
        self._folder.cleanup()

    def append(self, displacement: Float[np.ndarray, "V 3"]) -> None:
        """Add one mesh, metres.

        Raises:
            ValueError: another number of vertices, or more meshes than the capacity.
        """
        if displacement.shape != self._array.shape[1:] or self.count == len(self._array):
            raise ValueError(f"{displacement.shape} as number {self.count} in a store of {self._array.shape}")
        self._array[self.count] = displacement
        self.count += 1

    def __iter__(self) -> Iterator[Float[np.ndarray, "V 3"]]:
        yield from self._array[: self.count]
