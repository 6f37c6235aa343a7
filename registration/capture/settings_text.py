"""Edits of the text of `capture.toml`: everything that is not replaced stays as the user wrote it."""

import re
from collections.abc import Collection
from functools import partial
from pathlib import Path

from registration.errors import InputError
from registration.storage.reading import parse_toml

_BLOCKS = re.compile(r"(?m)^(?=[ \t]*\[+[^,\[\]]+\]+[ \t]*(?:#.*)?$)")


def without_tables(source: Path, settings: str, names: Collection[str]) -> str:
    """Return the text of a `capture.toml` without some of its tables and their sub-tables.

    Args:
        source: the file, for messages.
        settings: its text.
        names: of the tables.

    Raises:
        InputError: one of them is written as a value, such as `colour = { ... }`.
    """
    if not names:
        return settings
    own = re.compile(rf"\s*\[\s*(?:{'|'.join(sorted(names))})\s*[.\]]")
    kept = "".join(block for block in _BLOCKS.split(settings) if not own.match(block)).rstrip() + "\n"
    fix = f"write {' and '.join(sorted(names))} as tables of their own"
    refuse = partial(InputError, "capture.toml cannot be rewritten", where=source, fix=fix)
    for name in sorted(names & parse_toml(kept.encode(), refuse).keys()):
        raise refuse(expected=f"[{name}] as a table", got=f"{name} = ...")
    return kept
