"""Read PLY files as scanners and mesh programs write them: text or binary, any properties, elements in any order.

The header's counts are compared with the file's size before anything is read: a damaged file is refused at once.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

MAX_HEADER_BYTES = 2**20
_ASCII = "ascii"
_FORMATS = {_ASCII: "", "binary_little_endian": "<", "binary_big_endian": ">"}  # of the header -> byte order
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"long": "i8", "ulong": "u8", "float": "f4", "double": "f8"},
    **{f"int{bits}": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    **{"float32": "f4", "float64": "f8"},
}
_INDICES = ("vertex_indices", "vertex_index")
_NO_NUMBER = re.compile(rb"[-+]?(nan|1\.#)", re.IGNORECASE)  # as C runtimes print what is not a number


@dataclass(frozen=True, kw_only=True)
class PlyMesh:
    """The geometry of a PLY file."""

    vertices: Float[np.ndarray, "V 3"]  # in the file's unit and order; may hold NaN
    triangles: Int[np.ndarray, "F 3"]  # polygons are split into fans
    faces: int  # in the file, of any number of corners
    unread: Mapping[str, int]  # element that is neither vertices nor faces -> its count
    colours: Float[np.ndarray, "V 3"] | None = None  # of the vertices, sRGB in [0, 1]


@dataclass(frozen=True, kw_only=True)
class _Property:
    name: str
    type: np.dtype
    count_type: np.dtype | None = None  # of a list's length; None: no list


@dataclass(frozen=True, kw_only=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def place(self, name: str) -> int | None:
        """The position of a property, whatever the case of its name."""
        return next((k for k, p in enumerate(self.properties) if p.name.lower() == name), None)


def read_ply(path: Path) -> PlyMesh:
    """Read vertices and faces. Other elements and properties are ignored.

    Raises:
        ValueError: the file is no PLY file, or damaged; the message says what was wrong.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        order, elements, start = _read_header(file.read(MAX_HEADER_BYTES))
    named = {element.name: element for element in reversed(elements)}  # the first of each name
    if "vertex" not in named:
        raise ValueError('no element "vertex"')
    vertex, face = named["vertex"], named.get("face")
    columns = [vertex.place(axis) for axis in "xyz"]
    if None in columns or any(vertex.properties[k].count_type for k in columns if k is not None):
        raise ValueError("vertices without the properties x, y and z")
    corners = None if face is None else _index_list(face)
    body = _Body.of(path, start, order)
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    tints = [vertex.place(name) for name in ("red", "green", "blue")]
    coloured = all(k is not None and not vertex.properties[k].count_type for k in tints)
    columns += tints if coloured else []
    wanted = {"vertex", "face"} if face is not None and corners is not None else {"vertex"}
    for element in elements:
        if not wanted:
            break
        body.require(element)
        if element is vertex:
            vertices = body.read_columns(element, [k for k in columns if k is not None])
        elif element is face and corners is not None:
            triangles = _fans(body.read_lists(element, corners))
        else:
            body.skip(element)
        wanted.discard(element.name)
    read = (vertex, face) if corners is not None else (vertex,)
    return PlyMesh(
        vertices=vertices[:, :3],
        colours=_in_unit_range(vertices[:, 3:]) if coloured and len(vertices) else None,
        triangles=triangles,
        faces=face.count if face is not None and corners is not None else 0,
        unread={element.name: element.count for element in elements if not any(element is one for one in read)},
    )


def _in_unit_range(colours: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
    """Colours in [0, 1] of those in [0, 1], in bytes or in words of two bytes."""
    colours = np.nan_to_num(colours)
    top = next((top for top in (1.0, 255.0) if colours.max() <= top), 65535.0)
    return np.clip(colours / top, 0, 1)


def _index_list(face: _Element) -> int | None:
    """Which property lists a face's corners: one of the usual name, or the only list of integers."""
    usual = [k for name in _INDICES if (k := face.place(name)) is not None]
    lists = [k for k, p in enumerate(face.properties) if p.count_type is not None]
    integers = [k for k in lists if face.properties[k].type.kind in "iu"]
    return next((k for k in usual if k in lists), integers[0] if len(integers) == 1 else None)


def _read_header(data: bytes) -> tuple[str, list[_Element], int]:
    """The byte order (empty: text), the elements, and where the body starts."""
    if not re.match(rb"ply\s", data, re.IGNORECASE):
        raise ValueError(f"no PLY file: it starts with {data[:8]!r}")
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)?", data)
    if end is None:
        raise ValueError("no end_header: the header is cut short")
    # A lone CR ends a line only where all lines end so; the LF that follows would be the first byte of the body.
    only_cr = re.match(rb"ply[ \t]*\r(?!\n)", data, re.IGNORECASE) is not None
    start = end.end() - (1 if only_cr and end[1] == b"\r\n" else 0)
    order: str | None = None
    elements: list[_Element] = []
    for line in re.split(r"\r\n|\n|\r", data[: end.start()].decode("latin-1"))[1:]:
        match line.split():
            case ["format", name, *_]:
                if name not in _FORMATS:
                    raise ValueError(f"an unknown format: {line!r}")
                order = _FORMATS[name]
            case ["element", name, count]:
                if not re.fullmatch(r"[0-9]{1,40}", count):
                    raise ValueError(f"no count of an element: {line!r}")
                elements.append(_Element(name=name, count=int(count)))
            case ["property", *words]:
                if not elements:
                    raise ValueError(f"a property without an element: {line!r}")
                elements[-1].properties.append(_property(line, words, order or ""))
            case _:  # comments, obj_info, and the second lines of comments
                pass
    if order is None:
        raise ValueError('no line "format" in the header')
    return order, elements, start


def _property(line: str, words: Sequence[str], order: str) -> _Property:
    match words:
        case ["list", count, kind, name] if {count, kind} <= _TYPES.keys() and _TYPES[count][0] != "f":
            count_type = np.dtype(order + _TYPES[count])
            return _Property(name=name, type=np.dtype(order + _TYPES[kind]), count_type=count_type)
        case [kind, name] if kind in _TYPES:
            return _Property(name=name, type=np.dtype(order + _TYPES[kind]))
    raise ValueError(f"an unknown property: {line!r}")


@dataclass(kw_only=True)
class _Body:
    """The part of a file after its header, and how far it was read.

    It is a list of cells: of bytes in a binary file, of numbers in a text file, where each value takes one.
    """

    cells: np.ndarray
    text: bool
    at: int = 0  # the next cell

    @classmethod
    def of(cls, path: Path, start: int, order: str) -> "_Body":
        data = np.memmap(path, np.uint8, "r", start) if path.stat().st_size > start else np.zeros(0, np.uint8)
        return cls(cells=data if order else _numbers(data.tobytes()), text=not order)

    def require(self, element: _Element) -> None:
        """Raise ValueError if the file is too short for an element, even if all its lists were empty."""
        least = sum(self._width(p.count_type or p.type) for p in element.properties)
        self._require(element, element.count * least)

    def read_columns(self, element: _Element, columns: Sequence[int]) -> Float[np.ndarray, "N C"]:
        """Read the values of some properties that are no lists, and pass on to the next element."""
        starts = self._starts(element)
        values = [self._values(starts[k], element.properties[k].type)[:, 0] for k in columns]
        with np.errstate(invalid="ignore"):  # some NaNs
            return np.stack(values, -1, dtype=np.float64)

    def read_lists(self, element: _Element, place: int) -> list[tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_ _"]]]:
        """Read a list property and pass on: for each length, the element's numbers and their lists."""
        kind = element.properties[place]
        assert kind.count_type is not None
        starts = self._starts(element)[place]
        lengths = self._lengths(starts, kind)
        groups, before = [], self._width(kind.count_type)
        for length in np.unique(lengths).tolist():
            rows = np.flatnonzero(lengths == length)
            of_these = starts if len(rows) == len(lengths) else np.asarray(starts)[rows]
            groups.append((rows, _integers(self._values(of_these, kind.type, before, length))))
        return groups

    def skip(self, element: _Element) -> None:
        """Pass on to the next element."""
        if any(p.count_type for p in element.properties):
            self._starts(element)
        else:
            self.at += element.count * sum(self._width(p.type) for p in element.properties)

    def _width(self, kind: np.dtype) -> int:
        return 1 if self.text else kind.itemsize

    def _require(self, element: _Element, count: int) -> None:
        if (left := len(self.cells) - self.at) < count:
            unit = "numbers" if self.text else "bytes"
            need = f"{element.count} of element {element.name!r} need {count} {unit} or more"
            raise ValueError(f"the file is cut short, or its length is wrong: {need}, {left} are left")

    def _starts(self, element: _Element) -> "list[_Starts]":
        """The first cell of each property of each row; passes on to the next element."""
        if not element.count:
            return [range(0) for _ in element.properties]
        lengths = self._first_lengths(element)
        widths = [self._span(p, length) for p, length in zip(element.properties, lengths, strict=False)]
        step = sum(widths)
        if len(lengths) == len(element.properties) and self.at + step * element.count <= len(self.cells):
            places = np.cumsum([self.at, *widths]).tolist()
            starts = [range(place, place + step * element.count, step) for place in places[:-1]]
            lists = [k for k, p in enumerate(element.properties) if p.count_type]
            if all((self._lengths(starts[k], element.properties[k]) == lengths[k]).all() for k in lists):
                self.at += step * element.count
                return [*starts]
        return self._walk(element)

    def _first_lengths(self, element: _Element) -> list[int]:
        """The lengths of the first row's properties, 1 for those that are no lists; fewer if the file ends before."""
        lengths: list[int] = []
        cell = self.at
        for p in element.properties:
            length = 1
            if p.count_type:
                if cell + self._width(p.count_type) > len(self.cells):
                    break
                length = int(self._lengths(range(cell, cell + 1), p)[0])
            lengths.append(length)
            cell += self._span(p, length)
        return lengths

    def _span(self, p: _Property, length: int) -> int:
        """The number of cells of a property of this length."""
        return self._width(p.type) * length + (self._width(p.count_type) if p.count_type else 0)

    def _walk(self, element: _Element) -> "list[_Starts]":
        """As `_starts`, where the lengths of lists vary: row by row."""
        starts = np.empty((element.count, len(element.properties)), np.int64)
        cells, at, total = np.ascontiguousarray(self.cells).data, self.at, len(self.cells)
        steps = [(self._width(p.type), p.count_type and self._width(p.count_type), p) for p in element.properties]
        for row in range(element.count):
            for column, (width, size, p) in enumerate(steps):
                starts[row, column] = at
                length = 1
                if size:
                    if at + size > total:
                        self._require(element, total + 1 - self.at)
                    # A byte, or a number of a text file, is the length itself; the usual case must be fast.
                    one = size == 1 and (self.text or p.count_type == np.uint8)
                    length = int(cells[at]) if one else int(self._lengths(range(at, at + 1), p)[0])
                    if length < 0:
                        raise ValueError(f"a list of element {element.name!r} has the length {length}")
                    at += size
                at += width * length
            if at > total:
                self._require(element, at - self.at)
        self.at = at
        return [*starts.T]

    def _lengths(self, starts: "_Starts", p: _Property) -> Int[np.ndarray, "N"]:
        """The lengths of lists that begin at these cells. Raises ValueError for a negative one."""
        assert p.count_type is not None
        lengths = _integers(self._values(starts, p.count_type))[:, 0]
        if (lengths < 0).any():
            raise ValueError(f"a list {p.name!r} has the length {lengths.min()}")
        return lengths

    def _values(
        self, starts: "_Starts", kind: np.dtype, before: int = 0, length: int = 1
    ) -> Shaped[np.ndarray, "N {length}"]:
        """The `length` values that follow each of these cells and the `before` cells after it."""
        span = self._width(kind) * length
        if not len(starts) or not span:
            return np.zeros((len(starts), length), kind)
        if isinstance(starts, range):
            first, cell = self.cells[starts[0] + before :], self.cells.itemsize
            cells = np.lib.stride_tricks.as_strided(first, (len(starts), span), (starts.step * cell, cell))
        else:
            cells = self.cells[starts[:, None] + np.arange(before, before + span)]
        return cells if self.text else np.ascontiguousarray(cells).view(kind)


_Starts = range | np.ndarray  # cells: evenly spaced, or (N,) integers


def _integers(values: Shaped[np.ndarray, "N K"]) -> Int[np.ndarray, "N K"]:
    if values.dtype.kind == "f" and not ((np.abs(values) < 2**53) & (values == np.round(values))).all():
        raise ValueError("an index, or the length of a list, is not an integer")
    return values.astype(np.int64)


def _numbers(data: bytes) -> Float[np.ndarray, "C"]:
    """The numbers of a text file; NaN for those that a C runtime printed as such."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's, where it meets what is not a number
        try:
            return np.fromstring(data, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return np.array([_number(word) for word in data.split()], np.float64)


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        if _NO_NUMBER.match(word):
            return float("nan")
        raise ValueError(f"{word[:40].decode('latin-1')!r} is not a number") from None


def _fans(groups: Sequence[tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_ _"]]]) -> Int[np.ndarray, "F 3"]:
    """Split polygons into triangles around their first corner, in the order of the faces."""
    rows, triangles = [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for faces, corners in groups:
        if (count := corners.shape[1] - 2) > 0:
            rows.append(np.repeat(faces, count))
            first = np.repeat(corners[:, :1], count, 1)
            triangles.append(np.stack([first, corners[:, 1:-1], corners[:, 2:]], -1).reshape(-1, 3))
    return np.concatenate(triangles)[np.argsort(np.concatenate(rows), kind="stable")]
