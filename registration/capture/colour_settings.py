"""The table [colour] of `capture.toml`: what the values of the images mean, for all views and for some."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from registration.capture.colour import ENCODINGS
from registration.errors import InputError
from registration.types import Colour

_KEYS = ("encoding", "matrix", "matrix_space", "gain")
_MAX_NUMBER = 1e4  # of a matrix


@dataclass(frozen=True, kw_only=True)
class ColourSettings:
    """The colours of a capture's views."""

    everywhere: Colour = Colour()
    views: Mapping[str, Colour] = field(default_factory=dict)  # those that differ

    def of(self, view: str) -> Colour:
        """The colour of a view."""
        return self.views.get(view, self.everywhere)

    def require_views(self, path: Path, names: Iterable[str]) -> None:
        """Refuse colours of views that do not exist. Raises InputError."""
        known = set(names)
        if unknown := sorted(set(self.views) - known):
            raise InputError(
                "Colours are given for views that do not exist",
                where=path,
                expected=f"[colour.views] of {', '.join(sorted(known))}",
                got=", ".join(unknown),
                fix="name views by their images without suffix",
            )


def read_colours(path: Path, table: object) -> ColourSettings:
    """Return the colours that [colour] states.

    Args:
        path: of `capture.toml`, for messages.
        table: the value of `colour`.

    Raises:
        InputError: a key, an encoding, a matrix or a gain is unknown or malformed.
    """
    if not isinstance(table, dict):
        raise _error(path, "[colour] is malformed", "a table; a tag needs another name", table)
    views = table.get("views", {})
    if not isinstance(views, dict) or not all(isinstance(values, dict) for values in views.values()):
        raise _error(path, "[colour.views] is malformed", "a table for each view", views)
    everywhere = _colour(path, "colour", {k: v for k, v in table.items() if k != "views"}, Colour())
    return ColourSettings(
        everywhere=everywhere,
        views={name: _colour(path, f"colour.views.{name}", values, everywhere) for name, values in views.items()},
    )


def colours_to_toml(colours: Mapping[str, Colour]) -> list[str]:
    """Return the lines of [colour] that give views their colours; none if all are sRGB.

    Args:
        colours: view's name -> colour.
    """
    lines: list[str] = []
    for name, colour in colours.items():
        if colour == Colour():
            continue
        lines += ["", f"[colour.views.{json.dumps(name, ensure_ascii=False)}]"]
        given = {key: getattr(colour, key) for key in _KEYS if getattr(colour, key) != getattr(Colour(), key)}
        lines += [f"{key} = {json.dumps(value)}" for key, value in given.items()]
    return lines


def _error(path: Path, what: str, expected: object, got: object) -> InputError:
    return InputError(what, where=path, expected=expected, got=got, fix="see Colour in docs/formats.md")


def _colour(path: Path, table: str, values: Mapping[str, Any], default: Colour) -> Colour:
    if unknown := sorted(set(values) - set(_KEYS)):
        raise _error(path, f"[{table}] has an unknown key", ", ".join(_KEYS), ", ".join(unknown))
    colour = default
    if "encoding" in values:
        encoding = values["encoding"]
        if not isinstance(encoding, str) or encoding not in ENCODINGS:
            raise _error(path, f"The encoding of [{table}] is unknown", f"one of {', '.join(ENCODINGS)}", encoding)
        colour = replace(colour, encoding=encoding)
    if "matrix" in values:
        colour = replace(colour, matrix=_matrix(path, table, values["matrix"]))
    if "matrix_space" in values:
        space = values["matrix_space"]
        if space not in ("encoded", "linear"):
            raise _error(path, f"The matrix_space of [{table}] is unknown", '"encoded" or "linear"', space)
        colour = replace(colour, matrix_space=space)
    if "gain" in values:
        gain = values["gain"]
        if isinstance(gain, bool) or not isinstance(gain, (int, float)) or not 0 < gain < math.inf:
            raise _error(path, f"The gain of [{table}] is malformed", "a number above 0", gain)
        colour = replace(colour, gain=float(gain))
    return colour


def _matrix(path: Path, table: str, value: object) -> tuple[tuple[float, ...], ...]:
    rows = value if isinstance(value, list) and len(value) == 3 else []
    widths = {len(row) if isinstance(row, list) else 0 for row in rows}
    if widths not in ({3}, {4}) or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < _MAX_NUMBER for row in rows for v in row
    ):
        expected = "3 rows of 3 numbers, or of 4 with an offset"
        raise _error(path, f"The matrix of [{table}] is malformed", expected, value)
    return tuple(tuple(float(v) for v in row) for row in rows)
