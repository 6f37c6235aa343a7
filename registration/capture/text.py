"""Text in and out: of a capture's files, with or without a byte-order mark, and of messages about them."""

import codecs
from collections.abc import Sequence
from pathlib import Path

_MARKS = {codecs.BOM_UTF16_LE: "UTF-16", codecs.BOM_UTF16_BE: "UTF-16"}


def read_text(path: Path) -> str:
    """Read UTF-8 text; a byte-order mark, as some editors write it, is left out.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not UTF-8; says which encoding its byte-order mark names.
    """
    content = path.read_bytes()
    for mark, encoding in _MARKS.items():
        if content.startswith(mark):
            raise ValueError(f"{encoding}, according to its byte-order mark; save the file as UTF-8")
    return content.removeprefix(codecs.BOM_UTF8).decode("utf-8")


def listed(items: Sequence[object], most: int = 10) -> str:
    """Return the first items, separated by commas, and how many more there are."""
    shown = ", ".join(map(str, items[:most]))
    return shown if len(items) <= most else f"{shown} and {len(items) - most} more"
