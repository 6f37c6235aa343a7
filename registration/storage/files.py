"""Atomic writes of files and folders, and checks of output folders: a reader sees the old state or the new one.

A process that is killed leaves at most a hidden sibling whose name ends in `.tmp`; the target is never half written.
"""

import ctypes
import errno
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.storage.jsonable import to_jsonable
from registration.storage.reading import read_json

FULL = (errno.ENOSPC, errno.EDQUOT)  # numbers of the system's errors
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


class DiskFull(OSError):
    """A disk is full, or the user's share of it; names the file and the disk."""


@contextmanager
def naming_full_disk(file: Path) -> Iterator[None]:
    """Raise `DiskFull` for an error of a full disk in the block, which is about to write a file or folder."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL or isinstance(error, DiskFull):
            raise
        raise disk_full(file, error) from error


def disk_full(file: Path, error: OSError) -> DiskFull:
    """Return the error of a full disk with the names of the file and the disk, which the system leaves out.

    Args:
        file: that was being written; if the folder of temporary files has less space, that is the full one.
        error: as the system raised it.
    """
    places = [Path(error.filename)] if error.filename else [Path(file).absolute(), Path(tempfile.gettempdir())]
    place = min(places, key=lambda path: shutil.disk_usage(_existing(path)).free)
    disk = _existing(place)
    usage = shutil.disk_usage(disk)
    while not disk.is_mount() and disk != disk.parent:
        disk = disk.parent
    space = f"{usage.free / 1e9:.1f} of {usage.total / 1e9:.1f} GB free"
    return DiskFull(error.errno, f"{os.strerror(error.errno or 0)}: the disk mounted at {disk}, {space}", str(place))


def _existing(path: Path) -> Path:
    return next(folder for folder in (path, *path.parents) if folder.exists())


@contextmanager
def atomic_file(file: Path) -> Iterator[Path]:
    """Yield the path of a temporary sibling of `file` that replaces it when the block ends without an error.

    The temporary name keeps the suffix, from which some writers derive the format. The folder must exist.
    """
    file = Path(file)
    temporary = file.with_name(f".{file.stem}.{secrets.token_hex(4)}.tmp{file.suffix}")
    try:
        with naming_full_disk(file):
            yield temporary
            os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write_bytes(file: Path, content: bytes) -> None:
    """Write a file in one rename."""
    with atomic_file(file) as temporary:
        temporary.write_bytes(content)


def atomic_write_text(file: Path, text: str) -> None:
    """Write a UTF-8 text file in one rename."""
    atomic_write_bytes(file, text.encode("utf-8"))


def json_text(value: Any) -> str:
    """Return the text of a JSON file: `to_jsonable` values (non-finite numbers are null), indented, with a newline."""
    return json.dumps(to_jsonable(value), indent=1, allow_nan=False) + "\n"


def write_json(file: Path, value: Any) -> None:
    """Write `json_text` of a value in one rename."""
    atomic_write_text(file, json_text(value))


@contextmanager
def atomic_directory(out: Path) -> Iterator[Path]:
    """Yield an empty sibling folder that takes the place of `out` when the block ends without an error.

    After an error nothing is left of it and `out` is as before. Missing parents of `out` are created.
    """
    out = Path(out).resolve()
    temporary = out.with_name(f".{out.name}.{secrets.token_hex(4)}.tmp")
    with naming_full_disk(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
    try:
        with naming_full_disk(out):
            yield temporary
            exchange(temporary, out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def exchange(source: Path, out: Path) -> None:
    """Move the folder `source` to `out`.

    A non-empty folder at `out` is exchanged with it in one step and ends up at `source`; where the system cannot
    exchange folders, it is renamed and deleted instead, and `out` is missing for a moment.
    """
    if not out.exists() or not any(out.iterdir()):
        os.replace(source, out)
        return
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2  # os.replace cannot replace a non-empty folder
        done = rename(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(out), _RENAME_EXCHANGE) == 0
    except (AttributeError, OSError):
        done = False
    if not done:
        previous = out.with_name(f".{out.name}.{secrets.token_hex(4)}.old")
        os.replace(out, previous)
        os.replace(source, out)
        shutil.rmtree(previous, ignore_errors=True)


def refuse_foreign(
    out: Path, *, kind: str, command: str, manifest: str = "manifest.json", files: Sequence[str] | None = None
) -> None:
    """Refuse an output folder that `gnmreg COMMAND` did not write. A missing or empty folder is accepted.

    Args:
        out: the output folder.
        kind: the kind of the record that our folder holds.
        command: the command that writes such folders, for the message.
        manifest: the record's file name.
        files: the only names that may be in the folder; None: any.

    Raises:
        InputError: `out` is a file, holds no record of that kind, or holds a name that is not in `files`.
    """
    if not out.exists():
        return
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else ["a file"]
    foreign = [name for name in names if files is not None and name not in files]
    if foreign or (names and not has_kind(out / manifest, kind)):
        raise InputError.output_folder(
            out,
            expected=f"a new or empty folder, or one that `gnmreg {command}` wrote",
            got=", ".join((foreign or names)[:3]),
            fix="choose another output folder with --out",
        )


def check_output_file(file: Path) -> None:
    """Refuse, before any work, a file that cannot be written: a folder is in its place, or a file in its folder's.

    Raises:
        InputError: as above.
    """
    parents = [parent for parent in Path(file).absolute().parents if parent.exists()]
    got = "a folder" if file.is_dir() else None if parents[0].is_dir() else f"{parents[0]} is no folder"
    if got is not None:
        fix = "choose another file"
        raise InputError("The output file cannot be written", where=file, expected="a file's name", got=got, fix=fix)


def read_json_of_kind(file: Path, kind: str) -> dict[str, Any] | None:
    """Return the JSON object in a file if its `kind` is this one, of any schema version, else None."""
    try:
        value = read_json(Path(file), partial(InputError.unreadable, "record", where=file, fix="write it again"))
    except InputError:
        return None
    return value if isinstance(value, dict) and value.get("kind") == kind else None


def has_kind(file: Path, kind: str) -> bool:
    """Return whether a file is a JSON object with this `kind`, of any schema version."""
    return read_json_of_kind(file, kind) is not None
