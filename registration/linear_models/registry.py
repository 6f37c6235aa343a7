"""The formats of linear models, told apart by what is in a file, and the reader of any of them."""

from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models import basel, flame, gnm, ict, mat_models, plain_npz
from registration.linear_models.data import LinearModelData, check
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.model.wrong_files import describe_wrong_file

FORMATS: dict[str, ModelFormat] = {
    known.name: known
    for known in (gnm.FORMAT, flame.FORMAT, basel.FORMAT, mat_models.FORMAT, ict.FORMAT, plain_npz.FORMAT)
}


def read(path: Path, options: ReadOptions | None = None) -> LinearModelData:
    """Read a linear model of heads, of any format of `FORMATS`, into metres, +Y up, +Z out of the face.

    No code of the file is run: pickles are interpreted for arrays only.

    Args:
        path: the file, or the folder of ICT FaceKit.
        options: what the file does not state; None: defaults.

    Raises:
        InputError: it is missing, none of the formats, damaged, or its arrays do not belong together.
    """
    path = Path(path)
    known = detect_format(path)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        model = known.read(path, options or ReadOptions())
    check(model, path)
    return model


def detect_format(path: Path) -> ModelFormat:
    """Return the format of a model's file or folder by its content.

    Raises:
        InputError: it cannot be read, or is none of them.
    """
    path = Path(path)
    for known in FORMATS.values():
        if known.detect(path):
            return known
    what = describe_wrong_file(path) if path.is_file() else "a folder without a model's files"
    raise InputError(
        "The linear model cannot be read",
        where=path,
        expected=", ".join(known.title for known in FORMATS.values()),
        got=what or "a file of another kind",
        fix="give a model's file as it was published, or write its arrays as a plain NPZ (docs/other_models.md)",
    )


def other_format(path: Path) -> ModelFormat | None:
    """Return the format of a model that is not GNM's; None of GNM files and of what cannot be told."""
    try:
        found = detect_format(path)
    except InputError:
        return None
    return None if found is gnm.FORMAT else found
