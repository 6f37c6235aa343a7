"""The cache folder: downloaded and built models, and the libLLVM that was tested on this machine."""

from pathlib import Path

import platformdirs


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
