"""The first bytes of a file and the arrays of an NPZ file, to tell formats apart."""

from functools import partial
from pathlib import Path

from registration.errors import InputError
from registration.storage.npz import MAX_BYTES, NpzSchema
from registration.storage.reading import open_file

_ANY = NpzSchema(title="linear model", fix="give a model's file", fields={}, max_bytes=MAX_BYTES)
START_BYTES = 512
MATLAB_7_3 = b"MATLAB 7.3 MAT-file"  # then HDF5 from byte 512


def first_bytes(path: Path) -> bytes:
    """Return the first bytes of a regular file; none of a folder. Raises InputError if it cannot be read."""
    if path.is_dir():
        return b""
    refuse = partial(InputError.unreadable, "linear model", where=path, fix="give a model's file, as it was published")
    with open_file(path, refuse) as stream:
        return stream.read(START_BYTES)


def array_names(path: Path) -> frozenset[str]:
    """Return the names of the arrays of an NPZ file; none if it is another file. Raises InputError if it is damaged."""
    if not first_bytes(path).startswith(b"PK\x03\x04"):
        return frozenset()
    return frozenset(_ANY.names(path))
