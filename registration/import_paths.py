"""Objects that users name: by a key of a table, or by the import path of their own function."""

import importlib
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from registration.errors import InputError

T = TypeVar("T")


def load_named(wanted: str | T, table: Mapping[str, Callable[[], T]], type_: type[T], *, title: str) -> T:
    """Return the object of a name or import path: settings, a provider.

    Args:
        wanted: a key of `table`; `module:function`, the import path of a function without parameters that returns
            the object, looked up in the working directory too; or the object, which is returned as it is.
        table: name -> function.
        type_: of the object.
        title: what messages call them.

    Raises:
        InputError: an unknown name, a module or function that cannot be imported or fails, or a result of another
            type; or what the function itself raises.
    """
    if isinstance(wanted, type_):
        return wanted
    name = str(wanted)
    if name in table:
        return table[name]()
    invalid = partial(
        InputError,
        f"There is no such {title}",
        where=title,
        expected=f"{', '.join(table)}, or module:function of a function that returns a {type_.__name__}",
        fix="choose one by name, or correct the import path",
    )
    module, _, function = name.partition(":")
    if not (module and function):
        raise invalid(got=f"the name {name}")
    try:
        loaded = _import(module, function)()
    except InputError:
        raise  # says itself what is wrong, as with a recipe's number out of range
    except (Exception, SystemExit) as error:  # the module is the user's: anything may go wrong
        raise invalid(got=f"{type(error).__name__}: {error}") from error
    if not isinstance(loaded, type_):
        raise invalid(got=f"a function that returns {type(loaded).__name__}")
    return loaded


def _import(module: str, function: str) -> Callable[[], Any]:
    """The function of a module, which may lie in the working directory."""
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        result: Callable[[], Any] = getattr(importlib.import_module(module), function)
    finally:
        sys.path.remove(folder)
    return result
