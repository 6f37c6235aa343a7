"""Read the landmarks of one view."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.storage.reading import read_json

_FORMAT = 'write {"<scheme>": [[x_px, y_px, confidence], ...]}'
MAX_COORDINATE_PX = 1e9  # far beyond any image; squares of larger numbers overflow
_NOT_SEEN = [0.0, 0.0, 0.0]


def read_landmarks(path: Path) -> dict[str, Float[np.ndarray, "L 3"]]:
    """Read the landmark schemes of one view. A point that is null, or whose coordinates are null, is not seen.

    Returns:
        Scheme -> rows (x_px, y_px, confidence), in pixels of the distorted image; points that are not seen are zeros.

    Raises:
        InputError: the file is malformed.
    """

    def refuse(expected: object, got: object, fix: str = _FORMAT) -> InputError:
        return InputError("The landmark file is malformed", where=path, expected=expected, got=got, fix=fix)

    content = read_json(path, refuse, finite=False)  # the place of a number that is not finite is named below
    if not isinstance(content, dict):
        raise refuse("an object of schemes", type(content).__name__)
    landmarks = {}
    for scheme, rows in content.items():
        rows = [_NOT_SEEN if _is_null(row) else row for row in rows] if isinstance(rows, list) else rows
        try:
            points = np.array(rows, np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise refuse(f'three numbers a point in scheme "{scheme}"', error) from None
        if points.ndim == 2 and points.shape[1] == 2:
            fix = "add a confidence as third number: 1 where a point is seen, 0 where it is not"
            raise refuse(f'three numbers a point in scheme "{scheme}"', f"an array of shape {points.shape}", fix)
        if points.ndim != 2 or points.shape[1] != 3:
            raise refuse(f'three numbers a point in scheme "{scheme}"', f"an array of shape {points.shape}")
        usable = np.abs(points) < MAX_COORDINATE_PX  # false for NaN
        if not usable.all():
            broken = int(np.argwhere(~usable)[0, 0])
            raise refuse(f'finite numbers in scheme "{scheme}"', f"point {broken}: {rows[broken]}")
        landmarks[scheme] = points
    return landmarks


def _is_null(row: object) -> bool:
    return row is None or (isinstance(row, list) and None in row[:2])
