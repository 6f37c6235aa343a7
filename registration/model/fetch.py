"""Download the official GNM weights into the cache folder."""

import http.client
import shutil
import urllib.request
from pathlib import Path

from registration.errors import InputError
from registration.model import gnm_npz
from registration.storage.cache import cache_folder, make_cache_folder
from registration.storage.files import atomic_file

BASE_URL = "https://huggingface.co/google/gnm-v3/resolve/main"
FILE = "v3_0/gnm_head.npz"
_TIMEOUT_S = 30


def cached_path() -> Path:
    """Return the path of the official file in the cache. It may not be there yet."""
    return cache_folder() / FILE


def fetch(base_url: str = BASE_URL) -> Path:
    """Return the official model file; the first call downloads and checks it, later calls take it from the cache.

    An interrupted download leaves nothing behind.

    Raises:
        InputError: the file cannot be downloaded, or is not a GNM model. The message names the path where it can be
            placed by hand.
    """
    path, url = cached_path(), f"{base_url}/{FILE}"
    if path.is_file():
        return path
    make_cache_folder(path.parent)
    with atomic_file(path) as temporary:
        _download(url, temporary, path)
        gnm_npz.read(temporary)
    return path


def _download(url: str, to: Path, final: Path) -> None:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as response, to.open("wb") as file:
            shutil.copyfileobj(response, file)
            expected = response.headers.get("Content-Length")
        if expected is not None and to.stat().st_size != int(expected):
            raise ConnectionError(f"{to.stat().st_size} of {expected} bytes arrived")
    except (OSError, http.client.HTTPException) as error:
        raise InputError(
            "The official model cannot be downloaded",
            where=url,
            expected="a connection to the model's page",
            got=f"{type(error).__name__}: {error}",
            fix=f"download that address on another machine and place the file at {final}",
        ) from error
