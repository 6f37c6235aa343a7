"""Local copies of captures and models, which are in folders or in object storage."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from registration.cranium.auxiliary_model import FILE as CRANIUM
from registration.errors import InputError
from registration.model.gnm_npz import extra_path
from registration.storage.cache import cache_folder, make_cache_folder
from workflows.ids import is_remote, redact, resolve_place

MAX_BYTES = 64 * 2**30  # of one capture: more than any has; limits the download of a hostile listing


def filesystem(place: str) -> tuple[Any, str]:
    """Return the file system of a place, as `resolve_place` returns it, and the place's path in it.

    The place is not parsed again.

    Raises:
        InputError: the library for object storage is not installed.
    """
    if not is_remote(place):
        return LocalFileSystem(), place
    try:
        # A listing must show what other machines wrote meanwhile.
        return fsspec.filesystem("s3", use_listings_cache=False), place.removeprefix("s3://")
    except (ValueError, ImportError) as error:
        raise InputError(
            "Object storage cannot be used",
            where=place,
            expected="the optional package s3fs",
            got=redact(str(error)),
            fix="pip install 'gnm-registration[s3]'",
        ) from None


@contextmanager
def fetch_capture(location: str) -> Iterator[Path]:
    """Yield a capture's folder as a local path; a downloaded copy is deleted at the end.

    Raises:
        InputError: the remote folder is missing, too large, or names files outside itself.
    """
    place = resolve_place(location, "capture")
    if not is_remote(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="gnmreg-capture-") as name:
        folder = Path(name) / PurePosixPath(place).name
        fetch_folder(place, folder)
        yield folder


def fetch_folder(location: str, folder: Path) -> None:
    """Download all files below a URL into a folder. Raises InputError as `fetch_capture`."""
    fs, root = filesystem(resolve_place(location, "capture"))
    files = fs.find(root, detail=True)
    if not files:
        raise _input_error(location, expected="files below this URL", got="none")
    if (total := sum(int(info["size"] or 0) for info in files.values())) > MAX_BYTES:
        raise _input_error(location, expected=f"at most {MAX_BYTES} bytes", got=total)
    for path in files:
        name = PurePosixPath(path.removeprefix(root).lstrip("/"))
        if name.is_absolute() or ".." in name.parts or "\0" in str(name):
            raise _input_error(location, expected="names inside the folder", got=repr(str(name)))
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        fs.get_file(path, str(target))


def fetch_model(location: str) -> Path:
    """Return a model's file as a local path, with its second file, landmark schemes and auxiliary model beside it.

    Downloads are cached.

    Raises:
        InputError: there is no such file.
    """
    place = resolve_place(location, "model")
    if not is_remote(place):
        return Path(place)
    fs, path = filesystem(place)
    folder, _, name = path.rpartition("/")
    own = (path, str(extra_path(PurePosixPath(path))))
    try:
        infos = {p: i for p, i in fs.find(folder, maxdepth=1, detail=True).items() if p in own or _is_scheme(p)}
    except FileNotFoundError:
        infos = {}
    if path not in infos:
        raise _input_error(location, expected="a model's NPZ file", got="no such file")
    versions = {p: [str(i.get(k)) for k in ("size", "ETag", "etag", "LastModified", "mtime")] for p, i in infos.items()}
    cache = cache_folder() / "fetched"
    cached = cache / hashlib.sha256(json.dumps([place, versions], sort_keys=True).encode()).hexdigest()[:32]
    if not cached.is_dir():
        make_cache_folder(cache)
        temporary = Path(tempfile.mkdtemp(prefix=".fetch-", dir=cache))
        try:
            for remote in infos:
                fs.get_file(remote, str(temporary / PurePosixPath(remote).name))
            if not cached.is_dir():
                temporary.rename(cached)
        except OSError:
            if not cached.is_dir():  # another worker was not faster
                raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return cached / name


def _is_scheme(path: str) -> bool:
    name = PurePosixPath(path).name
    return (name.startswith("head_sparse_") and name.endswith(".txt")) or name == CRANIUM


def _input_error(location: str, *, expected: Any, got: Any) -> InputError:
    return InputError(
        "The input cannot be fetched", where=redact(location), expected=expected, got=got, fix="check the URL's files"
    )
