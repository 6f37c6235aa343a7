"""The landmark providers that users name."""

from collections.abc import Callable
from pathlib import Path

from registration.detect.face478 import SCHEME, Face478Provider
from registration.detect.landmark_folder import LandmarkFolder
from registration.detect.provider import LandmarkProvider
from registration.import_paths import load_named

PROVIDERS: dict[str, Callable[[], LandmarkProvider]] = {SCHEME: Face478Provider}
FILES = "files:"


def load_provider(name: str) -> LandmarkProvider:
    """Return a landmark provider.

    Args:
        name: a key of `PROVIDERS`, or `module:function`, the import path of a function without parameters that returns
            a `LandmarkProvider`, looked up in the working directory too.

    Raises:
        InputError: an unknown name, or a module or function that cannot be imported, fails or returns no provider.
    """
    return load_named(name, PROVIDERS, LandmarkProvider, title="landmark provider")  # type: ignore[type-abstract]


def load_source(name: str) -> LandmarkProvider | LandmarkFolder:
    """Return a provider, or `files:FOLDER` and `files:FOLDER:SCHEME`: landmark files in place of one.

    Raises:
        InputError: as `load_provider`.
    """
    if not name.startswith(FILES):
        return load_provider(name)
    folder = name.removeprefix(FILES)
    if Path(folder).is_dir():
        return LandmarkFolder(Path(folder))
    before, _, scheme = folder.rpartition(":")
    return LandmarkFolder(Path(before or folder), scheme if before else "")
