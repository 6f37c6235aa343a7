"""The official GNM weights, from their home on the web into a cache folder."""

import http.client
import os
import shutil
import urllib.request
from pathlib import Path

from registration.errors import InputError
from registration.model import gnm_npz

BASE_URL = "https://huggingface.co/google/gnm-v3/resolve/main"
FILE = "v3_0/gnm_head.npz"
_TIMEOUT_S = 30


def cache_folder() -> Path:
    """Where models, and what they are made from, are kept on this machine."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "gnm-registration"


def cached_path() -> Path:
    """Where the official file lies, or will lie, on this machine."""
    return cache_folder() / FILE


def fetch(base_url: str = BASE_URL) -> Path:
    """The official model file, downloaded and checked on the first call; later calls find it in the cache.

    A download that stops halfway leaves nothing behind. Raises InputError, telling where to place the file by hand,
    if it cannot be had, and if what came is not a GNM model.
    """
    path, url = cached_path(), f"{base_url}/{FILE}"
    if path.is_file():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        _download(url, beside, path)
        gnm_npz.read(beside)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
    return path


def _download(url: str, to: Path, final: Path) -> None:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as response, to.open("wb") as file:
            shutil.copyfileobj(response, file)
            promised = response.headers.get("Content-Length")
        if promised is not None and to.stat().st_size != int(promised):
            raise ConnectionError(f"{to.stat().st_size} of {promised} bytes came")
    except (OSError, http.client.HTTPException) as error:
        raise InputError(
            "the official model cannot be downloaded",
            where=url,
            expected="a connection to the model's page",
            got=f"{type(error).__name__}: {error}",
            fix=f"download that address on another machine and place the file at {final}",
        ) from error
