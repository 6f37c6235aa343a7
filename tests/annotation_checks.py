"""Checks of the library's annotations at run time, quick enough for the whole suite.

jaxtyping's import hook decorates every function. Its own decorator binds the arguments of each call, then checks them
twice by stand-ins of the function. This one lets beartype check the function itself, and opens a scope of axis sizes
only where an annotation names an array.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, ForwardRef, TypeVar, get_args

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._storage import pop_shape_memo, push_shape_memo

# An int is accepted for a float, as in PEP 484; errors are those that jaxtyping would raise.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeError))
_thorough = functools.partial(jaxtyping.jaxtyped, typechecker=_beartype)


def install(packages: Sequence[str]) -> None:
    """Check every call into these packages; before they are imported.

    Args:
        packages: names of packages.
    """
    jaxtyping.jaxtyped = _decorator  # the name that the hook's decorators have
    jaxtyping.install_import_hook(packages, "beartype.beartype")


def _decorator(*, typechecker: object) -> Callable[[Any], Any]:
    return _checked


def _checked(item: Any) -> Any:
    """A function, method or class that checks its annotations; a dataclass checks those of its fields."""
    if inspect.isclass(item):
        if dataclasses.is_dataclass(item) and "__init__" in vars(item):
            item.__init__ = _checked(item.__init__)
        return item
    if not inspect.isfunction(item) or _needs_arguments(item):
        return _thorough(item)
    if not item.__annotations__:
        return item
    checked = _beartype(item)
    return _in_scope(item, checked) if any(map(_names_array, item.__annotations__.values())) else checked


def _needs_arguments(function: Any) -> bool:
    """Whether beartype alone cannot check it: a generator, an annotation in a string, a size of arguments."""
    annotations = function.__annotations__.values()
    postponed = any(isinstance(annotation, str) for annotation in annotations)
    return postponed or inspect.isgeneratorfunction(function) or "{" in "".join(map(str, annotations))


def _names_array(annotation: Any) -> bool:
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    parts = annotation if isinstance(annotation, list | tuple) else get_args(annotation)
    return isinstance(annotation, TypeVar | ForwardRef | str) or any(map(_names_array, parts))


def _in_scope(function: Any, checked: Any) -> Any:
    """A call in which an axis has one size in all annotations."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        push_shape_memo({})
        try:
            return checked(*args, **kwargs)
        finally:
            pop_shape_memo()

    return call
