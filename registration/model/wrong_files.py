"""What a file is that is no GNM model of this version: told from its first bytes and from the names in it."""

import re
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

_FIRST_BYTES: tuple[tuple[bytes, str], ...] = (
    (b"GNMW", "a GNMW container for the web, which has no joints, vertex groups or texture coordinates"),
    (b"version https://git-lfs", "a Git LFS pointer: the model itself was not downloaded (`git lfs pull`)"),
    (b"\x93NUMPY", "a single NumPy array"),
    (b"\x89HDF", "an HDF5 file, such as the semantic samplers of GNM or the Basel Face Model"),
    (b"glTF", "a binary glTF scene"),
    (b"\x1f\x8b", "a gzip archive: unpack it first"),
    (b"solid ", "a mesh"),
    (b"ply", "a mesh"),
)
_MARKUP = (b"<!doctype", b"<html", b"<?xml")
_PICKLE = re.compile(rb"\x80[\x02-\x05]|\(dp|ccopy_reg|cnumpy")
_OTHER_ARRAYS: tuple[tuple[frozenset[str], str], ...] = (
    (frozenset({"shapedirs", "v_template"}), "a model of the FLAME or SMPL family"),
    (frozenset({"exp_dirs", "v_template"}), "a model of the FLAME family"),
    (frozenset({"identity", "expression", "vertices", "offsets"}), "a registration, not a head model"),
    (frozenset({"subjects", "labels", "vertices"}), "a file of held-out meshes, not a head model"),
    (frozenset({"names", "mean", "covariance"}), "the coefficient statistics beside a built model"),
    (frozenset({"w_shape", "mu_shape"}), "a Basel Face Model"),
)


def describe_wrong_file(file: Path) -> str | None:
    """Return what a file that cannot be read as a NPZ model is, or None if that cannot be told.

    Args:
        file: a regular file; only its first bytes and its table of contents are read.
    """
    with open(file, "rb") as stream:
        start = stream.read(4096)
        size = stream.seek(0, 2)
    if not start:
        return "an empty file"
    for first, what in _FIRST_BYTES:
        if start.startswith(first):
            return what
    if start.lstrip()[:16].lower().startswith(_MARKUP):
        return "a web page, not the file that it offers"
    if _PICKLE.match(start):
        return "a Python pickle, such as a model of the FLAME or SMPL family; pickles are never loaded"
    if start.startswith(b"PK\x03\x04") and not zipfile.is_zipfile(file):
        return f"a ZIP archive without its end, {size} bytes: cut short, as by an interrupted download or copy"
    return None


def describe_wrong_names(names: Collection[str]) -> str | None:
    """Return what an archive with these array names is, or None if that cannot be told."""
    for known, what in _OTHER_ARRAYS:
        if known.issubset(names):
            return what
    if any(name.endswith(("/data.pkl", "/byteorder")) for name in names):
        return "a PyTorch checkpoint, whose pickles are never loaded"
    return None


def older_version(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Return the version that a model states if it is older than 3, else None."""
    match = re.match(r"v?(\d+)(\.\d+)*$", str(arrays["version"]))
    return match[0] if match and int(match[1]) < 3 else None
