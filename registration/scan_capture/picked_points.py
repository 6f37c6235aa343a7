"""Read landmarks that were picked on a scan: menpo's .ljson, MeshLab's .pp, .json, .txt and .npz."""

import xml.parsers.expat
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.storage.npz import NpzSchema
from registration.storage.reading import Refuse, read_bytes, read_json, read_text

SUFFIXES = (".ljson", ".pp", ".json", ".txt", ".npz")
DEFAULT_SCHEME = "68"
_MAX_POINTS = 10_000
_FIX = 'see "Scans without photographs" in docs/formats.md'
_NPZ = NpzSchema(
    title="landmark file",
    fix="np.savez(path, points=...) with float (L, 3) points in the scan's frame, NaN where there is none",
    fields={"points": ("float", "L 3")},
    finite=False,
    max_bytes=2**20,
)


@dataclass(frozen=True, kw_only=True)
class PickedPoints:
    """Landmarks in a scan's own unit and axes."""

    scheme: str
    points: Float[np.ndarray, "L 3"]  # NaN where a point was not picked


def read_picked_points(file: Path, scheme: str | None, lengths: Mapping[str, int]) -> PickedPoints:
    """Read the landmarks of a scan.

    Args:
        file: of a suffix in `SUFFIXES`, in any case.
        scheme: that the file has; None: the one that it names itself, else 68.
        lengths: number of points of each scheme of the model.

    Raises:
        InputError: the file cannot be read, or has other points than a scheme of the model.
    """
    refuse = partial(InputError, "The landmarks of the scan cannot be read", where=file, fix=_FIX)
    suffix = file.suffix.lower()
    named: str | None = None
    if suffix == ".pp":
        wanted = lengths.get(scheme or DEFAULT_SCHEME, 0)
        points = _pp(read_bytes(file, refuse), wanted, refuse)
    elif suffix == ".npz":
        points = _NPZ.read(file)["points"].astype(np.float64)
    elif suffix == ".txt":
        points = _txt(read_text(file, refuse), refuse)
    elif suffix in (".json", ".ljson"):
        named, points = _json(read_json(file, refuse, finite=False), lengths, refuse)
    else:
        raise refuse(expected=f"a file that ends in {', '.join(SUFFIXES)}", got=file.name)
    chosen = scheme or named or DEFAULT_SCHEME
    if chosen not in lengths:
        got = f"scheme {chosen}"
        raise refuse(expected=f"a scheme that the model has: {', '.join(lengths) or 'it has none'}", got=got)
    if len(points) != lengths[chosen]:
        expected = f"{lengths[chosen]} points of scheme {chosen}, with nan or null for those that are not given"
        raise refuse(expected=expected, got=f"{len(points)} points")
    half = np.isnan(points).any(1) & ~np.isnan(points).all(1)
    if half.any() or np.isinf(points).any():
        raise refuse(expected="finite points, or nan in all three places", got=f"row {int(np.argmax(half))}")
    return PickedPoints(scheme=chosen, points=points)


def _txt(text: str, refuse: Refuse) -> Float[np.ndarray, "L 3"]:
    """Rows of three numbers, separated by spaces or commas; # begins a comment."""
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise refuse(expected="rows of three numbers", got=f"{line[:60]!r} in line {number}") from None
        if len(words) != 3:
            raise refuse(expected="rows of three numbers", got=f"{len(words)} in line {number}")
    return _array(rows, refuse)


def _json(value: Any, lengths: Mapping[str, int], refuse: Refuse) -> tuple[str | None, Float[np.ndarray, "L 3"]]:
    """Points of a JSON value, and the scheme that it names: menpo's LJSON, a mapping from schemes, or plain rows."""
    if isinstance(value, list):
        return None, _array(value, refuse)
    if not isinstance(value, dict):
        raise refuse(expected="rows of points, or an object", got=type(value).__name__)
    groups = value.get("groups")
    if isinstance(groups, dict) and groups:  # LJSON, version 3
        value = next(iter(groups.values()))
    elif isinstance(groups, list) and groups:  # LJSON, version 1
        members = [item for group in groups if isinstance(group, dict) for item in group.get("landmarks", [])]
        return None, _array([item.get("point") if isinstance(item, dict) else item for item in members], refuse)
    if isinstance(value, dict) and isinstance(inner := value.get("landmarks"), dict):  # LJSON, version 2
        value = inner
    if isinstance(value, dict):
        schemes = [name for name in lengths if isinstance(value.get(name), list)]
        for name in (*schemes, "points", "landmarks"):
            if isinstance(value.get(name), list):
                return name if name in schemes else None, _array(value[name], refuse)
    raise refuse(expected='"points", or the name of a scheme', got="neither")


def _array(rows: list[Any], refuse: Refuse) -> Float[np.ndarray, "L 3"]:
    if len(rows) > _MAX_POINTS:
        raise refuse(expected=f"at most {_MAX_POINTS} points", got=len(rows))
    nothing = [np.nan] * 3
    filled = [nothing if row is None or (isinstance(row, list) and None in row) else row for row in rows]
    try:
        points = np.array(filled, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise refuse(expected="three numbers a point", got=error) from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise refuse(expected="three numbers a point", got=f"an array of shape {points.shape}")
    return points


def _pp(content: bytes, wanted: int, refuse: Refuse) -> Float[np.ndarray, "L 3"]:
    """MeshLab's picked points. Names that are numbers are the points' places; inactive points are not given."""
    found: list[tuple[str, list[float]]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "point":
            try:
                place = [float(attributes[axis]) for axis in "xyz"]
            except (KeyError, ValueError):
                raise refuse(expected="points with x, y and z", got=str(attributes)[:80]) from None
            active = attributes.get("active", "1") != "0"
            found.append((attributes.get("name", ""), place if active else [np.nan] * 3))

    def forbid(*_: object) -> None:
        raise refuse(expected="plain XML", got="entity declarations")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.EntityDeclHandler = start, forbid
    try:
        parser.Parse(content, True)
    except xml.parsers.expat.ExpatError as error:
        raise refuse(expected="MeshLab's XML", got=error) from None
    if len(found) > _MAX_POINTS:
        raise refuse(expected=f"at most {_MAX_POINTS} points", got=len(found))
    numbers = [int(name) if name.strip().isdecimal() and len(name) < 6 else -1 for name, _ in found]
    if not found or min(numbers) < 0 or len(set(numbers)) < len(numbers):
        return _array([place for _, place in found], refuse)
    first = 1 if min(numbers) > 0 and max(numbers) == wanted else 0  # counted from 1
    size = max(wanted, max(numbers) - first + 1)
    points = np.full((size, 3), np.nan)
    points[np.array(numbers) - first] = [place for _, place in found]
    return points
