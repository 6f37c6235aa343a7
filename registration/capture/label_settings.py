"""The table [segmentation] of `capture.toml`: what the indices or colours of label maps mean."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from registration.capture import class_names, label_tables
from registration.capture.class_names import UNLABELLED
from registration.errors import InputError
from registration.storage.reading import parse_toml, read_bytes
from registration.types import LabelCode

_KEYS = ("table", "classes", "palette", "left", "ignore", "mapping")
_SIDES = ("subject", "image")
_FIX = "see Classes in docs/formats.md"
_MAX_INDEX = 255
Colour = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class _Vocabulary:
    """What one [segmentation] says, names as they are spelt."""

    indices: Mapping[int, str]
    colours: Mapping[Colour, str]
    left: str | None  # "subject", "image", or as the table has it
    ignored: frozenset[str]
    table: label_tables.LabelTable | None


class _Refuse:
    """Makes the errors of one file."""

    def __init__(self, where: Path):
        self.where = where

    def __call__(self, what: str, expected: object, got: object, fix: str = _FIX) -> InputError:
        return InputError(what, where=self.where, expected=expected, got=got, fix=fix)


def read_labels_table(
    path: Path, segmentation: Mapping[str, Any], inside: Callable[[Path], Path]
) -> tuple[tuple[str, ...], LabelCode]:
    """Return the classes of a capture's label maps, each once, and what their pixels stand for.

    Args:
        path: of `capture.toml`; a `mapping` lies beside it.
        segmentation: the table.
        inside: returns a path that stays within the capture; raises InputError for others.

    Raises:
        InputError: a key, index, colour, table or class is unknown or malformed, or the mapping cannot be read.
    """
    refuse = _Refuse(path)
    if "mapping" in segmentation:
        refuse, segmentation = _mapping(refuse, segmentation, inside)
    return _resolved(refuse, _vocabulary(refuse, segmentation))


def _mapping(
    refuse: _Refuse, segmentation: Mapping[str, Any], inside: Callable[[Path], Path]
) -> tuple[_Refuse, Mapping[str, Any]]:
    """The keys of the file that `mapping` names, in place of those of capture.toml."""
    name = segmentation["mapping"]
    if not isinstance(name, str) or len(segmentation) > 1:
        got = name if not isinstance(name, str) else ", ".join(sorted(segmentation))
        raise refuse("The mapping of the labels is malformed", 'mapping = "FILE.toml" and no other key', got)
    path = inside(refuse.where.parent / name)
    refuse = _Refuse(path)
    unreadable = partial(refuse, "The mapping of the labels cannot be read")
    content = parse_toml(read_bytes(path, unreadable), unreadable)
    if "mapping" in content:
        raise refuse("The mapping of the labels is malformed", "no further mapping", content["mapping"])
    return refuse, content


def _vocabulary(refuse: _Refuse, segmentation: Mapping[str, Any]) -> _Vocabulary:
    unknown = sorted(set(segmentation) - set(_KEYS))
    if unknown:
        expected = f"keys {', '.join(_KEYS)}"
        raise refuse("[segmentation] has an unknown key", expected, ", ".join(f"{key} = ..." for key in unknown))
    given = [key for key in ("table", "classes") if key in segmentation]
    if len(given) == 2 or not (given or "palette" in segmentation or not segmentation):
        got = ", ".join(sorted(segmentation))
        raise refuse("[segmentation] lacks the class names", "one of table, classes, palette and mapping", got)
    table = _table(refuse, segmentation["table"]) if "table" in segmentation else None
    left = segmentation.get("left")
    if left is not None and left not in _SIDES:
        raise refuse("The side of the labels is unknown", 'left = "subject" or left = "image"', left)
    ignored = segmentation.get("ignore", [])
    if not _is_names(ignored):
        raise refuse("The ignored classes are malformed", 'ignore = ["name", ...]', ignored)
    indices = dict(enumerate(table.names)) if table else _indices(refuse, segmentation.get("classes", []))
    colours = dict(zip(table.colours, table.names, strict=False)) if table else {}
    colours |= _palette(refuse, segmentation.get("palette", {}))
    return _Vocabulary(indices=indices, colours=colours, left=left, ignored=frozenset(ignored), table=table)


def _table(refuse: _Refuse, name: object) -> label_tables.LabelTable:
    table = label_tables.find(name) if isinstance(name, str) else None
    if table is None:
        raise refuse("The label table is unknown", f"one of {label_tables.names()}", name)
    return table


def _is_names(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _indices(refuse: _Refuse, classes: object) -> dict[int, str]:
    """Index -> name, from a list in order of the index or a table."""
    if isinstance(classes, list) and _is_names(classes):
        plain = [name.strip().casefold() for name in classes]
        if len(set(plain)) != len(plain):
            raise refuse("A segmentation class is named twice", "unique names", ", ".join(classes))
        if len(classes) > _MAX_INDEX + 1:
            raise refuse("There are too many segmentation classes", f"at most {_MAX_INDEX + 1}", len(classes))
        return dict(enumerate(classes))
    if isinstance(classes, dict) and all(isinstance(name, str) for name in classes.values()):
        wrong = [key for key in classes if not (key.isascii() and key.isdecimal() and int(key[:4]) <= _MAX_INDEX)]
        if not wrong:
            return {int(key): name for key, name in classes.items()}
        raise refuse("A label index is malformed", f"0 to {_MAX_INDEX}", ", ".join(wrong))
    raise refuse("The segmentation classes are malformed", 'classes = ["background", ...]', classes)


def _palette(refuse: _Refuse, palette: object) -> dict[Colour, str]:
    """Colour -> name, from name = colour or name = [colours]."""
    if not isinstance(palette, dict):
        raise refuse("The palette is malformed", 'a table of name = "#rrggbb"', palette)
    colours: dict[Colour, str] = {}
    for name, value in palette.items():
        several = value if isinstance(value, list) and not all(type(item) is int for item in value) else [value]
        for item in several:
            colour = _colour(item)
            if colour is None:
                expected = 'a colour as "#rrggbb" or [red, green, blue], 0 to 255, or a list of these'
                raise refuse("A colour of the palette is malformed", expected, f"{name} = {value}")
            if colour in colours and colours[colour] != name:
                got = f"{colours[colour]} and {name} in {item}"
                raise refuse("Two classes have the same colour", "a colour of one class only", got)
            colours[colour] = name
    return colours


def _colour(value: object) -> Colour | None:
    if isinstance(value, str) and re.fullmatch(r"#[0-9a-fA-F]{6}", value):
        red, green, blue = bytes.fromhex(value[1:])
        return red, green, blue
    if isinstance(value, list) and len(value) == 3 and all(type(v) is int and 0 <= v <= 255 for v in value):
        return value[0], value[1], value[2]
    return None


def _resolved(refuse: _Refuse, vocabulary: _Vocabulary) -> tuple[tuple[str, ...], LabelCode]:
    """The classes of the names, each once, in order, and the code of the pixels."""
    spelt = list(dict.fromkeys([*vocabulary.indices.values(), *vocabulary.colours.values()]))
    found = _meanings(refuse, spelt, vocabulary)
    classes = tuple(dict.fromkeys([found[name] for name in spelt]))
    if vocabulary.colours and UNLABELLED not in classes:
        classes = (*classes, UNLABELLED)  # for the few pixels in no colour of the palette
    stored = [-1] * (max(vocabulary.indices, default=-1) + 1)
    for index, name in vocabulary.indices.items():
        stored[index] = classes.index(found[name])
    other = [name for name in spelt if not class_names.is_spelling(name, found[name])]
    told = () if vocabulary.table else tuple((name, found[name]) for name in other if name not in vocabulary.ignored)
    return classes, LabelCode(
        indices=() if stored == list(range(len(classes))) else tuple(stored),
        colours=tuple((*colour, classes.index(found[name])) for colour, name in vocabulary.colours.items()),
        renamed=told,
    )


def _meanings(refuse: _Refuse, spelt: Sequence[str], vocabulary: _Vocabulary) -> dict[str, str]:
    """What each name means, left and right the subject's. Raises InputError for names that nobody knows."""
    if missing := sorted(vocabulary.ignored - set(spelt)):
        raise refuse("An ignored class does not exist", f"some of {', '.join(spelt)}", ", ".join(missing))
    found = class_names.meanings([name for name in spelt if name not in vocabulary.ignored])
    unknown = [name for name, known in found.items() if known is None]
    if unknown:
        raise _unknown(refuse, unknown)
    left = vocabulary.left or (vocabulary.table.left if vocabulary.table else "subject")
    known = {name: value for name, value in found.items() if value is not None}
    if left == "image":
        known = {name: class_names.exchanged(value) for name, value in known.items()}
    return known | {name: f"ignored {name}" for name in vocabulary.ignored}


def _unknown(refuse: _Refuse, unknown: Sequence[str]) -> InputError:
    near = [(name, class_names.suggestion(name)) for name in unknown]
    hints = [f"rename {name} to {known}" for name, known in near if known is not None]
    rest = [name for name, known in near if known is None]
    if rest:
        hints.append(f"leave pixels out on purpose by ignore = {json.dumps(rest, ensure_ascii=False)}")
    return refuse(
        "A segmentation class is unknown",
        f"{', '.join(class_names.KNOWN)}, or what covers them (hair, cloth, glasses ...); or table = one of"
        f" {label_tables.names()}",
        ", ".join(unknown),
        "; ".join(hints),
    )
