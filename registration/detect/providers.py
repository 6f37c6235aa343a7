"""The landmark providers that users name."""

from collections.abc import Callable

from registration.detect.face478 import SCHEME, Face478Provider
from registration.detect.provider import LandmarkProvider
from registration.import_paths import load_named

PROVIDERS: dict[str, Callable[[], LandmarkProvider]] = {SCHEME: Face478Provider}


def load_provider(name: str) -> LandmarkProvider:
    """Return a landmark provider.

    Args:
        name: a key of `PROVIDERS`, or `module:function`, the import path of a function without parameters that returns
            a `LandmarkProvider`, looked up in the working directory too.

    Raises:
        InputError: an unknown name, or a module or function that cannot be imported, fails or returns no provider.
    """
    return load_named(name, PROVIDERS, LandmarkProvider, title="landmark provider")  # type: ignore[type-abstract]
