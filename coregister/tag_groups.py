"""Groups of subjects by a tag's value."""

import math
from typing import Any


def tag_group(value: Any) -> str:
    """Return the group of a tag's value: numbers by tens ("20-29"), since most ages occur once; else the value as text.

    Args:
        value: a JSON value.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        low = int(value // 10 * 10)
        return f"{low}-{low + 9}"
    return str(value)
