"""Datasets in other programs' layouts: which recordings of which subjects they hold.

Known layouts are those of NeRSemble, Multiface, FaceScape and VHAP; in any other, each folder that a reader recognizes
is a recording: ROOT/SUBJECT/EXPRESSION, or ROOT/EXPRESSION of one subject.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.formats import multiface, nersemble, vhap
from registration.formats.registry import FORMATS, find_format

MAX_DEPTH = 3  # folders below the dataset's in which recordings are looked for
_NO_SUBJECTS = ("camera_params", "color_correction", "calibration", "annotations", "images", "masks", "tracked_mesh")


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One expression of one subject.

    Attributes:
        subject: name of the subject.
        expression: name of the expression, as the dataset has it.
        path: what a reader takes.
        format: name of the reader.
    """

    subject: str
    expression: str
    path: Path
    format: str


def find_recordings(root: Path, format: str | None = None) -> tuple[Recording, ...]:
    """Return the recordings in a dataset's folder, by subject and expression in natural order.

    Args:
        root: the folder.
        format: name of the only format that counts; None: any.

    Raises:
        InputError: there is no such folder, no such format, or no recording; a folder has the files of several formats;
            or two recordings are of one expression of one subject.
    """
    name = None if format is None else find_format(format).name
    if not root.is_dir():
        raise _error(root, "a dataset's folder", "a file" if root.exists() else "no such folder", "check the path")
    found = sorted(
        (recording for recording in _below(root, root, 0) if name is None or recording.format == name),
        key=lambda recording: (natural_key(recording.subject), natural_key(recording.expression)),
    )
    if not found:
        expected = (
            f"recordings of {name}" if name else "recordings that a reader recognizes; docs/formats.md lists them"
        )
        raise _error(root, expected, "none", "check the path, or import one capture with `gnmreg capture import`")
    for first, second in zip(found, found[1:], strict=False):
        if (first.subject, first.expression) == (second.subject, second.expression):
            got = f"{first.path} and {second.path}"
            raise _error(root, f"one recording of {first.expression} of {first.subject}", got, "rename one of them")
    return tuple(found)


def _error(root: Path, expected: str, got: str, fix: str) -> InputError:
    return InputError("The dataset cannot be imported", where=root, expected=expected, got=got, fix=fix)


def _below(root: Path, folder: Path, depth: int) -> Iterator[Recording]:
    """The recordings in a folder and below."""
    if (known := _known(folder)) is not None:
        yield from known
        return
    formats = [known.name for known in FORMATS if known.detect(folder)]
    if len(formats) > 1:
        raise _error(root, "folders with the files of one format", f"{', '.join(formats)} in {folder}", "say --format")
    if formats:
        yield _recording(root, folder, formats[0])
        return
    if depth < MAX_DEPTH:
        for below in sorted(folder.iterdir(), key=lambda path: natural_key(path.name)):
            if below.is_dir() and not below.name.startswith(".") and below.name not in _NO_SUBJECTS:
                yield from _below(root, below, depth + 1)


def _known(folder: Path) -> list[Recording] | None:
    """The recordings of a folder that holds all of a subject, None if it is none."""
    if multiface.is_entity(folder):
        subject = multiface.subject_of(folder)
        return [
            Recording(subject=subject, expression=segment.name, path=segment, format=multiface.FORMAT.name)
            for segment in multiface.segments(folder)
        ]
    sequences = nersemble.sequences(folder)
    if sequences and sequences != [folder] and nersemble.find_params(folder) is not None:
        return [
            Recording(subject=folder.resolve().name, expression=path.name, path=path, format=nersemble.FORMAT.name)
            for path in sequences
        ]
    return None


def _recording(root: Path, folder: Path, format: str) -> Recording:
    """The recording of a folder by its place and the format's own names."""
    parts = folder.resolve().relative_to(root.resolve()).parts
    subject = parts[-2] if len(parts) > 1 else root.resolve().name
    expression = parts[-1] if parts else "neutral"
    if format == vhap.FORMAT.name:
        subject, expression = vhap.names_of(folder)
    elif format == "facescape":
        expression = re.sub(r"^\d+_", "", expression)
    return Recording(subject=subject, expression=expression, path=folder, format=format)
