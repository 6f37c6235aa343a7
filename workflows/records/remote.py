"""Captures and models that lie in a folder or in object storage, brought to this machine."""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec

from registration.errors import InputError
from registration.storage.cache import cache_folder
from workflows.ids import redact

MAX_BYTES = 64 * 2**30  # of one capture: far beyond any, and what a hostile listing must not make us fetch


def is_remote(place: str) -> bool:
    return "://" in place and not place.startswith("file://")


def local_path(place: str) -> Path:
    """The path of a place that is not remote."""
    return Path(place.removeprefix("file://"))


@contextmanager
def fetch_capture(place: str) -> Iterator[Path]:
    """A capture's folder as a local path; what was fetched for it is deleted in the end.

    Raises:
        InputError: the remote folder is missing, too large, or names files outside itself.
    """
    if not is_remote(place):
        yield local_path(place)
        return
    with tempfile.TemporaryDirectory(prefix="gnmreg-capture-") as name:
        folder = Path(name) / PurePosixPath(place).name
        fetch_folder(place, folder)
        yield folder


def fetch_folder(place: str, folder: Path) -> None:
    """Copy all files below a URL into a folder. Raises InputError as `fetch_capture`."""
    fs, root = fsspec.core.url_to_fs(place)
    files = fs.find(root, detail=True)
    if not files:
        raise _unusable(place, expected="files below this URL", got="none")
    if (total := sum(int(info["size"] or 0) for info in files.values())) > MAX_BYTES:
        raise _unusable(place, expected=f"at most {MAX_BYTES} bytes", got=total)
    for path in files:
        name = PurePosixPath(path.removeprefix(root).lstrip("/"))
        if name.is_absolute() or ".." in name.parts or "\0" in str(name):
            raise _unusable(place, expected="names inside the folder", got=repr(str(name)))
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        fs.get_file(path, str(target))


def fetch_model(place: str) -> Path:
    """A model's file as a local path, with its landmark schemes beside it; fetched once and then found in the cache.

    Raises:
        InputError: there is no such file.
    """
    if not is_remote(place):
        return local_path(place)
    fs, path = fsspec.core.url_to_fs(place)
    folder, _, name = path.rpartition("/")
    try:
        infos = {p: i for p, i in fs.find(folder, maxdepth=1, detail=True).items() if p == path or _is_scheme(p)}
    except FileNotFoundError:
        infos = {}
    if path not in infos:
        raise _unusable(place, expected="a model's NPZ file", got="no such file")
    told = {p: [str(i.get(k)) for k in ("size", "ETag", "etag", "LastModified", "mtime")] for p, i in infos.items()}
    cache = cache_folder() / "fetched"
    cached = cache / hashlib.sha256(json.dumps([place, told], sort_keys=True).encode()).hexdigest()[:32]
    if not cached.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=".fetch-", dir=cache))
        try:
            for one in infos:
                fs.get_file(one, str(fresh / PurePosixPath(one).name))
            if not cached.is_dir():
                fresh.rename(cached)
        except OSError:
            if not cached.is_dir():  # unless another worker was faster
                raise
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    return cached / name


def _is_scheme(path: str) -> bool:
    name = PurePosixPath(path).name
    return name.startswith("head_sparse_") and name.endswith(".txt")


def _unusable(place: str, *, expected: Any, got: Any) -> InputError:
    return InputError(
        "The input cannot be fetched", where=redact(place), expected=expected, got=got, fix="check the URL's files"
    )
