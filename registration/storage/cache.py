"""The cache folder: downloaded and built models, and the libLLVM that was tested on this machine."""

import errno
import os
from pathlib import Path

import platformdirs

from registration.errors import InputError


def cache_folder() -> Path:
    """Return `gnm-registration` in the user's cache folder, which may not exist yet.

    On Linux `$XDG_CACHE_HOME` or `~/.cache`, elsewhere the system's own folder.

    Raises:
        RuntimeError: the user has no home folder.
    """
    folder = platformdirs.user_cache_path("gnm-registration", appauthor=False)
    if not folder.is_absolute():
        raise RuntimeError("the user has no home folder")
    return folder


def make_cache_folder(folder: Path) -> None:
    """Make a folder in the cache, and its parents.

    Raises:
        InputError: this user cannot write there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise InputError(
            "The cache folder cannot be written",
            where=folder,
            expected="a folder that this user can make and write",
            got=error.strerror or error,
            fix="correct its permissions, or set XDG_CACHE_HOME to a folder that can be written",
        ) from error
