"""Pickles that hold numbers: an interpreter of its own for the few operations that NumPy arrays need.

A pickle is a program. This one never imports what it names, never calls anything but the functions of the table below,
and never makes an object of a class that is not defined here: arrays, sparse matrices and chumpy's arrays become inert
holders, of which only shapes, types and bytes are read, and checked. Everything else is refused.
"""

import io
import pickletools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from registration.storage.pickle_values import (
    CALLABLE,
    PickledArray,
    PickledGlobal,
    PickledObject,
    RefusedPickle,
    build,
    known_global,
    make_instance,
    plain_key,
)
from registration.storage.reading import Refuse, read_bytes

MAX_BYTES = 2**30  # of a file: ten times the largest published head model
_MAX_OPERATIONS = 2**17  # a hundred times those of a head model
_MAX_GROWTH, _SMALL_BYTES = 4, 2**20  # arrays may take so many times the file, if it is larger than this
_MAX_INTEGER_BYTES = 16
_MAX_DENSE = 2**27  # numbers of a sparse matrix, written out
_MAX_WRAPPERS = 4  # arrays within objects within one another


def read_pickled_arrays(file: Path, refuse: Refuse, *, max_bytes: int = MAX_BYTES) -> dict[str, object]:
    """Read the mapping in a pickle of protocol 0 to 5, also of Python 2, without running anything of it.

    Args:
        file: its path.
        refuse: makes the error.
        max_bytes: the largest size of the file.

    Returns:
        What the pickle has under each name; `as_array` makes arrays of the values.

    Raises:
        InputError: the file cannot be read, is no such pickle, or wants to import or call anything else.
    """
    content = read_bytes(file, refuse, max_bytes=max_bytes)
    expected = "a pickle of a mapping of arrays, which calls nothing else"
    try:
        value = _Machine().run(content)
    except RefusedPickle as error:
        raise refuse(expected=expected, got=error) from None
    except Exception as error:  # pickletools raises nearly anything for damaged files
        raise refuse(expected=expected, got=f"{type(error).__name__}: {error}") from None
    if not isinstance(value, dict):
        raise refuse(expected=expected, got=f"a {type(value).__name__.strip('_').lower()}")
    return {str(name): item for name, item in value.items()}


def as_array(value: object) -> np.ndarray:
    """Return the array that a pickle's value is: an array, chumpy's object around one, or a sparse matrix, written out.

    Raises:
        ValueError: it is none, or contradicts itself.
    """
    for _ in range(_MAX_WRAPPERS):
        if isinstance(value, PickledArray):
            if value.array is None:
                raise ValueError("an array of Python objects, or one without content")
            return value.array
        if not isinstance(value, PickledObject):
            break
        if value.kind in ("csc", "csr", "coo"):
            return _dense(value)
        if "x" not in value.state:
            raise ValueError(f"an object of the class {value.kind}, which has no values of its own")
        value = value.state["x"]
    if isinstance(value, list | tuple):
        raise ValueError("a list")
    raise ValueError(f"a {type(value).__name__.strip('_').lower()}")


def _dense(matrix: PickledObject) -> np.ndarray:
    from scipy import sparse

    state = matrix.state
    shape = state.get("_shape", state.get("shape"))
    if not (isinstance(shape, tuple) and len(shape) == 2 and all(isinstance(n, int) and 0 < n for n in shape)):
        raise ValueError("a sparse matrix without a shape")
    rows, columns = shape
    if rows * columns > _MAX_DENSE:
        raise ValueError(f"a sparse matrix of {rows} x {columns} numbers")
    data = as_array(state.get("data"))
    if data.dtype.kind not in "fiub" or data.ndim != 1:
        raise ValueError("a sparse matrix of no numbers")
    if matrix.kind == "coo":
        coordinates = state.get("coords")
        pair = coordinates if isinstance(coordinates, tuple) else (state.get("row"), state.get("col"))
        if len(pair) != 2:
            raise ValueError("a sparse matrix without coordinates")
        i, j = _indices(as_array(pair[0]), rows), _indices(as_array(pair[1]), columns)
    else:
        lines, across = (columns, rows) if matrix.kind == "csc" else (rows, columns)
        ends, inner = as_array(state.get("indptr")), _indices(as_array(state.get("indices")), across)
        ends = _indices(ends, len(inner) + 1)
        if len(ends) != lines + 1 or ends[0] != 0 or ends[-1] != len(inner) or (np.diff(ends) < 0).any():
            raise ValueError("a sparse matrix whose rows do not belong to its numbers")
        outer = np.repeat(np.arange(lines), np.diff(ends))
        i, j = (inner, outer) if matrix.kind == "csc" else (outer, inner)
    if not len(i) == len(j) == len(data):
        raise ValueError("a sparse matrix whose indices do not belong to its numbers")
    return sparse.coo_matrix((data.astype(np.float64), (i, j)), shape=(rows, columns)).toarray()


def _indices(array: np.ndarray, count: int) -> np.ndarray:
    if array.dtype.kind not in "iu" or array.ndim != 1 or (array.size and not 0 <= array.min() <= array.max() < count):
        raise ValueError(f"a sparse matrix with other indices than 0 to {count - 1}")
    return array.astype(np.int64)


class _Mark:
    """The stack's mark."""


_CONSTANTS: Mapping[str, object] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_VALUES = frozenset(
    """INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE
    SHORT_BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8""".split()
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_NOTHING = frozenset({"PROTO", "FRAME"})


class _Machine:
    """Runs the operations of a pickle on a stack and a memo."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}
        self._budget = 0

    def run(self, content: bytes) -> object:
        """Return the value that the pickle leaves."""
        self._budget = _MAX_GROWTH * max(len(content), _SMALL_BYTES)
        for count, (operation, argument, _) in enumerate(pickletools.genops(io.BytesIO(content))):
            if count > _MAX_OPERATIONS:
                raise RefusedPickle(f"more than {_MAX_OPERATIONS} operations")
            name = operation.name
            if name == "STOP":
                return self._pop()
            if name in _VALUES:
                self._stack.append(self._value(argument))
            elif name in _CONSTANTS:
                self._stack.append(_CONSTANTS[name])
            elif name in _TUPLES:
                self._stack.append(tuple(self._take(_TUPLES[name])))
            elif name not in _NOTHING:
                method = getattr(self, f"_op_{name.lower()}", None)
                if method is None:
                    raise RefusedPickle(f"the operation {name}, which arrays do not need")
                method(argument)
        raise RefusedPickle("no end")

    @staticmethod
    def _value(value: object) -> object:
        if isinstance(value, int) and value.bit_length() > 8 * _MAX_INTEGER_BYTES:
            raise RefusedPickle("an integer of many digits")
        return value

    def _paid(self, made: object) -> object:
        """Count what is made of the same bytes again and again."""
        if isinstance(made, PickledArray) and made.array is not None:
            self._budget -= made.array.nbytes
        elif isinstance(made, bytes):
            self._budget -= len(made)
        if self._budget < 0:
            raise RefusedPickle("arrays that are many times larger than the file")
        return made

    def _pop(self) -> Any:
        if not self._stack or self._stack[-1] is _Mark:
            raise RefusedPickle("an empty stack")
        return self._stack.pop()

    def _take(self, count: int) -> list[Any]:
        taken = [self._pop() for _ in range(count)]
        return taken[::-1]

    def _marked(self) -> list[Any]:
        """What lies above the last mark, which is removed as well."""
        place = len(self._stack) - 1
        while place >= 0 and self._stack[place] is not _Mark:
            place -= 1
        if place < 0:
            raise RefusedPickle("no mark")
        above = self._stack[place + 1 :]
        del self._stack[place:]
        return above

    def _top(self, kind: type) -> Any:
        if not self._stack or not isinstance(self._stack[-1], kind):
            raise RefusedPickle(f"no {kind.__name__} to fill")
        return self._stack[-1]

    def _set(self, items: list[Any]) -> None:
        if len(items) % 2:
            raise RefusedPickle("a name without a value")
        mapping = self._top(dict)
        for name, value in zip(items[::2], items[1::2], strict=True):
            mapping[plain_key(name)] = value

    def _op_mark(self, _: object) -> None:
        self._stack.append(_Mark)

    def _op_pop(self, _: object) -> None:
        if not self._stack:
            raise RefusedPickle("an empty stack")
        self._stack.pop()

    def _op_pop_mark(self, _: object) -> None:
        self._marked()

    def _op_tuple(self, _: object) -> None:
        self._stack.append(tuple(self._marked()))

    def _op_empty_list(self, _: object) -> None:
        self._stack.append([])

    def _op_list(self, _: object) -> None:
        self._stack.append(self._marked())

    def _op_append(self, _: object) -> None:
        value = self._pop()
        self._top(list).append(value)

    def _op_appends(self, _: object) -> None:
        values = self._marked()
        self._top(list).extend(values)

    def _op_empty_dict(self, _: object) -> None:
        self._stack.append({})

    def _op_dict(self, _: object) -> None:
        items = self._marked()
        self._stack.append({})
        self._set(items)

    def _op_setitem(self, _: object) -> None:
        self._set(self._take(2))

    def _op_setitems(self, _: object) -> None:
        self._set(self._marked())

    def _op_put(self, place: int) -> None:
        if not self._stack:
            raise RefusedPickle("an empty stack")
        self._memo[place] = self._stack[-1]

    _op_binput = _op_long_binput = _op_put

    def _op_memoize(self, _: object) -> None:
        self._op_put(len(self._memo))

    def _op_get(self, place: int) -> None:
        if place not in self._memo:
            raise RefusedPickle("a reference to nothing")
        self._stack.append(self._memo[place])

    _op_binget = _op_long_binget = _op_get

    def _op_global(self, names: str) -> None:
        self._stack.append(known_global(*names.split(" ", 1)))

    def _op_stack_global(self, _: object) -> None:
        self._stack.append(known_global(*self._take(2)))

    def _op_reduce(self, _: object) -> None:
        called, arguments = self._take(2)
        function = CALLABLE.get(called) if isinstance(called, PickledGlobal) else None
        if function is None or not isinstance(arguments, tuple):
            raise RefusedPickle(f"a call of {called if isinstance(called, PickledGlobal) else 'no function'}")
        self._stack.append(self._paid(function(*arguments)))

    def _op_newobj(self, _: object) -> None:
        cls, _arguments = self._take(2)
        self._stack.append(make_instance(cls))

    def _op_build(self, _: object) -> None:
        state = self._pop()
        if not self._stack:
            raise RefusedPickle("an empty stack")
        build(self._stack[-1], state)
        self._paid(self._stack[-1])
