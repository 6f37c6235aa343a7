"""Read and write the landmarks of one view."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.storage.reading import read_json

_FORMAT = 'write {"<scheme>": [[x_px, y_px, confidence], ...]}, and the spread in px as fourth number if it is known'
MAX_COORDINATE_PX = 1e9  # far beyond any image; squares of larger numbers overflow
_NOT_SEEN = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewLandmarks:
    """The landmarks of one view, in pixels of the distorted image."""

    points: Mapping[str, Float[np.ndarray, "L 3"]]  # scheme -> x_px y_px confidence
    spread_px: Mapping[str, Float[np.ndarray, "_"]]  # scheme -> standard deviation along each axis; not of all schemes


def read_landmarks(path: Path) -> ViewLandmarks:
    """Read the landmark schemes of one view. A point that is null, or whose coordinates are null, is not seen.

    Returns:
        The landmarks; points that are not seen are zeros.

    Raises:
        InputError: the file is malformed.
    """

    def refuse(expected: object, got: object, fix: str = _FORMAT) -> InputError:
        return InputError("The landmark file is malformed", where=path, expected=expected, got=got, fix=fix)

    content = read_json(path, refuse, finite=False)  # the place of a number that is not finite is named below
    if not isinstance(content, dict):
        raise refuse("an object of schemes", type(content).__name__)
    landmarks, spreads = {}, {}
    for scheme, given in content.items():
        expected, columns = f'three or four numbers a point in scheme "{scheme}"', _columns(given)
        rows = [_NOT_SEEN[:columns] if _is_null(row) else row for row in given] if isinstance(given, list) else given
        try:
            points = np.array(rows, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise refuse(expected, error) from None
        if points.ndim == 2 and points.shape[1] == 2:
            fix = "add a confidence as third number: 1 where a point is seen, 0 where it is not"
            raise refuse(expected, f"an array of shape {points.shape}", fix)
        if points.ndim != 2 or points.shape[1] not in (3, 4):
            raise refuse(expected, f"an array of shape {points.shape}")
        usable = np.abs(points) < MAX_COORDINATE_PX  # false for NaN
        if not usable.all():
            broken = int(np.argwhere(~usable)[0, 0])
            raise refuse(f'finite numbers in scheme "{scheme}"', f"point {broken}: {rows[broken]}")
        if points.shape[1] == 4:
            spreads[scheme] = points[:, 3].copy()
            if not (spreads[scheme] > 0).all():
                broken = int(np.argmin(spreads[scheme]))
                fix = "write the standard deviation of the point's position along each axis, px, as fourth number"
                raise refuse(f'spreads above 0 in scheme "{scheme}"', f"point {broken}: {rows[broken]}", fix)
        landmarks[scheme] = points[:, :3].copy()
    return ViewLandmarks(points=landmarks, spread_px=spreads)


def write_landmarks(
    path: Path,
    points: Mapping[str, Float[np.ndarray, "L 3"]],
    spread_px: Mapping[str, Float[np.ndarray, "_"]],
) -> None:
    """Write the landmarks of one view, and the folder that holds the file.

    Args:
        path: the file.
        points: scheme -> x_px y_px confidence.
        spread_px: scheme -> standard deviation along each axis, px; of the schemes whose spread is known.
    """
    rows = {
        scheme: np.column_stack([values, spread_px[scheme]]) if scheme in spread_px else values
        for scheme, values in points.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({scheme: values.tolist() for scheme, values in rows.items()}), "utf-8")


def moved_spread(
    move: Callable[[Float[np.ndarray, "L 3"]], Float[np.ndarray, "L 3"]],
    points: Float[np.ndarray, "L 3"],
    spread_px: Float[np.ndarray, "L"],
) -> Float[np.ndarray, "L"]:
    """Return the spread of landmarks after a map of their coordinates, which may also reorder them.

    It is the root mean square of the map's change over a standard deviation along x and one along y.

    Args:
        move: the map of rows (x_px, y_px, confidence).
        points: before it.
        spread_px: before it.
    """
    start = move(points)[:, :2]
    squares = [
        np.square(move(points + np.column_stack([spread_px * x, spread_px * y, 0 * spread_px]))[:, :2] - start).sum(1)
        for x, y in ((1, 0), (0, 1))
    ]
    return np.sqrt(np.maximum(np.mean(squares, axis=0), 1e-12))


def _columns(rows: object) -> int:
    """How many numbers the points of a scheme have, by the first that is seen."""
    seen = [row for row in rows if not _is_null(row)] if isinstance(rows, list) else []
    return 4 if seen and isinstance(seen[0], list) and len(seen[0]) == 4 else 3


def _is_null(row: object) -> bool:
    return row is None or (isinstance(row, list) and None in row[:2])
