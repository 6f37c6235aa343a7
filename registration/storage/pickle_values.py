"""What a pickle of arrays may name and call, and the inert objects that it may make and fill."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_DTYPE = re.compile(r"[<>|=]?(?:f[248]|[iu][1248]|b1)")
_SPARSE = re.compile(r"scipy\.sparse(?:\._?(?:csc|csr|coo))?")
_SPARSE_CLASSES = {f"{kind}_{form}": kind for kind in ("csc", "csr", "coo") for form in ("matrix", "array")}


class RefusedPickle(Exception):
    """What the pickle wants and must not have."""


@dataclass(frozen=True, slots=True)
class PickledGlobal:
    """A name that the pickle imports; never imported."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"[:120]


@dataclass(slots=True, eq=False)
class PickledDtype:
    """A dtype before its byte order is known."""

    code: str
    order: str = "="


@dataclass(slots=True, eq=False)
class PickledArray:
    """An array before its content is known; None: never usable, as an array of objects."""

    array: np.ndarray | None = None


@dataclass(slots=True, eq=False)
class PickledObject:
    """An object of a class that is not loaded: the class' name and what the pickle says of its attributes."""

    kind: str
    state: dict[str, object] = field(default_factory=dict)


def _reconstructor(cls: object, base: object, state: object) -> object:
    return make_instance(cls)


def make_instance(cls: object) -> object:
    """An inert object of a class that may be named."""
    if isinstance(cls, PickledGlobal):
        if _SPARSE.fullmatch(cls.module) and cls.name in _SPARSE_CLASSES:
            return PickledObject(_SPARSE_CLASSES[cls.name])
        if cls.module == "chumpy" or cls.module.startswith("chumpy."):
            return PickledObject(str(cls))
        if cls == PickledGlobal("collections", "OrderedDict"):
            return {}
        if cls == PickledGlobal("numpy", "ndarray"):
            return PickledArray()
    raise RefusedPickle(f"an object of {cls if isinstance(cls, PickledGlobal) else 'no class'}")


def _empty_array(cls: object, shape: object, code: object) -> PickledArray:
    return PickledArray()


def _dtype(code: object, *_: object) -> PickledDtype:
    text = code.decode("latin-1") if isinstance(code, bytes) else code
    if isinstance(text, str) and (_DTYPE.fullmatch(text) or re.fullmatch(r"\|?O\d?", text)):
        return PickledDtype(text.lstrip("<>|="), text[0] if text[0] in "<>|" else "=")
    raise RefusedPickle(f"an array of the type {str(text)[:40]!r}")


def _scalar(dtype: object, content: object) -> object:
    return _numbers(dtype, (), content, False).item()


def _from_buffer(content: object, dtype: object, shape: object, order: object) -> PickledArray:
    return PickledArray(_numbers(dtype, shape, content, order in ("F", b"F")))


def _encode(text: object, encoding: object = "latin1") -> bytes:
    """How Python 3 writes bytes for Python 2."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise RefusedPickle("_codecs.encode of something else than bytes")
    return text.encode("latin-1")


def _no_bytes(*arguments: object) -> bytes:
    if arguments:
        raise RefusedPickle("bytes of something")
    return b""


def _ordered(*pairs: object) -> dict[str, object]:
    made: dict[str, object] = {}
    for pair in pairs[0] if pairs and isinstance(pairs[0], list | tuple) else ():
        if not (isinstance(pair, list | tuple) and len(pair) == 2):
            raise RefusedPickle("an OrderedDict of no pairs")
        made[plain_key(pair[0])] = pair[1]
    return made


_NUMPY = ("numpy.core", "numpy._core")
CALLABLE: dict[PickledGlobal, Callable[..., object]] = {
    **{PickledGlobal(f"{core}.multiarray", "_reconstruct"): _empty_array for core in _NUMPY},
    **{PickledGlobal(f"{core}.multiarray", "scalar"): _scalar for core in _NUMPY},
    **{PickledGlobal(f"{core}.numeric", "_frombuffer"): _from_buffer for core in _NUMPY},
    PickledGlobal("numpy", "dtype"): _dtype,
    **{PickledGlobal(module, "_reconstructor"): _reconstructor for module in ("copy_reg", "copyreg")},
    PickledGlobal("_codecs", "encode"): _encode,
    **{PickledGlobal(module, "bytes"): _no_bytes for module in ("__builtin__", "builtins")},
    PickledGlobal("collections", "OrderedDict"): _ordered,
}
_NAMED = {
    PickledGlobal("numpy", "ndarray"),
    *(PickledGlobal(module, "object") for module in ("__builtin__", "builtins")),
}


def known_global(module: object, name: object) -> PickledGlobal:
    """A name that may be used, as a callable, a class, or an argument of these."""
    if not (isinstance(module, str) and isinstance(name, str)):
        raise RefusedPickle("a name that is no text")
    found = PickledGlobal(module, name)
    if found not in CALLABLE and found not in _NAMED:
        try:
            make_instance(found)
        except RefusedPickle:
            raise RefusedPickle(f"a pickle that wants to run {found}") from None
    return found


def _numbers(dtype: object, shape: object, content: object, fortran: bool) -> np.ndarray:
    """An array of bytes whose number is what shape and type need."""
    if not isinstance(dtype, PickledDtype) or dtype.code.startswith("O"):
        raise RefusedPickle("numbers without a type")
    if not (isinstance(shape, tuple) and len(shape) <= 8 and all(type(n) is int and 0 <= n < 2**40 for n in shape)):
        raise RefusedPickle("an array without a shape")
    raw = content.encode("latin-1") if isinstance(content, str) else content
    if not isinstance(raw, bytes | bytearray):
        raise RefusedPickle("an array without bytes")
    kind = np.dtype(f"{dtype.order}{dtype.code}")
    needed = kind.itemsize
    for length in shape:
        needed *= length
    if needed != len(raw):
        raise RefusedPickle(
            f"an array of type {kind} and shape {shape}, which needs {needed} bytes, of {len(raw)} bytes"
        )
    array = np.frombuffer(bytes(raw), kind).reshape(shape, order="F" if fortran else "C")
    return array.astype(kind.newbyteorder("="))


def build(target: object, state: object) -> None:
    """Give an inert object its state; nothing but those objects can be given one."""
    if isinstance(target, PickledDtype):
        order = state[1] if isinstance(state, tuple) and len(state) >= 5 else None
        order = order.decode("latin-1") if isinstance(order, bytes) else order
        if not isinstance(order, str) or order not in "<>|=" or any(part is not None for part in state[2:5]):  # type: ignore[index]
            raise RefusedPickle("an array of records or of an unknown byte order")
        target.order = order
    elif isinstance(target, PickledArray):
        if not (isinstance(state, tuple) and len(state) == 5):
            raise RefusedPickle("an array without a state")
        _, shape, dtype, fortran, content = state
        if isinstance(dtype, PickledDtype) and dtype.code.startswith("O"):
            return
        target.array = _numbers(dtype, shape, content, bool(fortran))
    elif isinstance(target, PickledObject):
        if isinstance(state, tuple) and len(state) == 2 and state[1] is None:
            state = state[0]
        if not isinstance(state, dict):
            raise RefusedPickle("an object without attributes")
        target.state.update(state)
    else:
        raise RefusedPickle("a pickle that changes something else than arrays")


def plain_key(value: object) -> Any:
    """Only plain keys: hashing nested ones would recurse without limit."""
    if value is None or isinstance(value, str | bytes | int | float):
        return value
    raise RefusedPickle("a mapping whose names are no texts")
