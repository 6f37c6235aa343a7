"""Text of messages about a capture's files."""

from collections.abc import Sequence


def listed(items: Sequence[object], most: int = 10) -> str:
    """Return the first items, separated by commas, and how many more there are."""
    shown = ", ".join(map(str, items[:most]))
    return shown if len(items) <= most else f"{shown} and {len(items) - most} more"
