"""The one way in for files that somebody else may have written: regular files only, of bounded size, strictly parsed.

Every reader says with a `Refuse` how its error is worded; whatever the system or a parser raises becomes that error.
Nothing is read, nor allocated for, before the kind and the size of the file are known. The formats have their own
limits: NPZ in `npz`, images in `image_files`.
"""

import codecs
import json
import math
import os
import stat
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BufferedReader
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from registration.errors import InputError

MAX_TEXT_BYTES = 64 * 2**20  # of a JSON, TOML or text file: many times the largest that this project writes
_CHUNK_BYTES = 2**20  # read at once of a file that is longer than it said
MAX_LINE_BYTES = 16 * 2**20  # of a line in a file of any size
MAX_DEPTH = 64  # of lists and objects within one another
MAX_ITEMS = 2**22  # values in a JSON file, which take up to 100 bytes each in memory
MAX_INTEGER = 2**63 - 1  # of either sign, as databases and NumPy hold them
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4095  # of a file's name and path on Linux


@runtime_checkable
class Refuse(Protocol):
    """Makes the error of a file that cannot be used."""

    def __call__(self, *, expected: object, got: object) -> InputError: ...


def open_file(file: Path, refuse: Refuse, *, max_bytes: int | None = None) -> BufferedReader:
    """Open a regular file for reading.

    Args:
        file: its path.
        refuse: makes the error.
        max_bytes: largest size that is accepted; None: any.

    Raises:
        InputError: it is missing, larger, must not be read, or no regular file: opening a named pipe would wait for a
            writer, and a device may do anything.
    """
    try:
        status = os.stat(file)
        if (kind := irregular(status.st_mode)) is not None:
            raise refuse(expected="a regular file", got=kind)
        stream = os.fdopen(os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except (OSError, ValueError) as error:
        raise refuse(expected="a readable file", got=system_reason(error)) from None
    status = os.fstat(stream.fileno())
    if (kind := irregular(status.st_mode)) is not None:  # it was replaced in between
        stream.close()
        raise refuse(expected="a regular file", got=kind)
    if max_bytes is not None and status.st_size > max_bytes:
        stream.close()
        raise refuse(expected=f"at most {max_bytes} bytes", got=f"{status.st_size} bytes")
    return stream


def irregular(mode: int) -> str | None:
    """What a file is by its mode if it is no regular file, in words; else None."""
    kinds = (
        (stat.S_ISREG, None),
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISFIFO, "a named pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    return next((name for matches, name in kinds if matches(mode)), "a device")


def system_reason(error: OSError | ValueError) -> str:
    """Why a file cannot be opened, in words and without its path."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, UnicodeError):
        return "a name that is no UTF-8"
    if isinstance(error, OSError):
        return error.strerror or type(error).__name__
    return "a name with a NUL character" if "null" in str(error) else str(error)


def path_defect(path: str) -> str | None:
    """What makes a path unusable on any file system: NUL, no UTF-8, too long; None if nothing does."""
    try:
        encoded = path.encode("utf-8")
    except UnicodeEncodeError:
        return "a name that is no UTF-8"
    if b"\0" in encoded:
        return "a name with a NUL character"
    longest = max(map(len, encoded.split(b"/")))
    if longest > MAX_NAME_BYTES:
        return f"a name of {longest} bytes, more than {MAX_NAME_BYTES}"
    return f"a path of {len(encoded)} bytes, more than {MAX_PATH_BYTES}" if len(encoded) > MAX_PATH_BYTES else None


def read_bytes(file: Path, refuse: Refuse, *, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Read a whole regular file of at most `max_bytes`. Raises InputError as `open_file`."""
    with open_file(file, refuse, max_bytes=max_bytes) as stream:
        try:
            # Asked for as much as the file has: the buffer is allocated before it is filled.
            content = stream.read(min(os.fstat(stream.fileno()).st_size, max_bytes) + 1)
            while len(content) <= max_bytes and (more := stream.read(min(_CHUNK_BYTES, max_bytes + 1 - len(content)))):
                content += more
        except OSError as error:
            raise refuse(expected="a readable file", got=system_reason(error)) from None
    if len(content) > max_bytes:  # it grew meanwhile, or has no size, as the files in /proc
        raise refuse(expected=f"at most {max_bytes} bytes", got="more")
    return content


def decode_text(content: bytes, refuse: Refuse) -> str:
    """Return the text of a UTF-8 file, without its byte order mark. Raises InputError for other bytes and for NUL."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        got = "UTF-16, according to its byte order mark; save the file as UTF-8"
        raise refuse(expected="a text file in UTF-8", got=got)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        got = f"byte 0x{content[error.start]:02x} in line {line}"
        raise refuse(expected="a text file in UTF-8", got=got) from None
    if (position := text.find("\0")) >= 0:
        got = f"a NUL character in line {text.count(chr(10), 0, position) + 1}"
        raise refuse(expected="a text file in UTF-8", got=got)
    return text


def read_text(file: Path, refuse: Refuse, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file, with or without a byte order mark. Raises as `read_bytes` and `decode_text`."""
    return decode_text(read_bytes(file, refuse, max_bytes=max_bytes), refuse)


def read_list(file: Path, refuse: Refuse, *, max_bytes: int = MAX_TEXT_BYTES) -> list[str]:
    """Read a list of names or paths, one on each line; blank lines and spaces around entries are dropped.

    Raises:
        InputError: as `read_text`; an entry can be no path.
    """
    entries = [line.strip() for line in read_text(file, refuse, max_bytes=max_bytes).splitlines()]
    for number, entry in enumerate(entries, 1):
        if defect := path_defect(entry):
            raise refuse(expected="names or paths", got=f"{defect} in line {number}")
    return [entry for entry in entries if entry]


def raw_lines(file: Path, refuse: Refuse) -> Iterator[bytes]:
    """Yield the lines of a text file of any size, undecoded, without their ends and without a byte order mark.

    Only LF, CR LF and CR end a line: other separators may be part of names.

    Raises:
        InputError: as `open_file`; a line has more than `MAX_LINE_BYTES`, or NUL.
    """
    with open_file(file, refuse) as stream:
        number = 0
        while line := stream.readline(MAX_LINE_BYTES + 1):
            if not number:
                line = line.removeprefix(codecs.BOM_UTF8)
            for part in line.removesuffix(b"\n").removesuffix(b"\r").split(b"\r"):
                number += 1
                if len(part) > MAX_LINE_BYTES:
                    raise refuse(expected=f"lines of at most {MAX_LINE_BYTES} bytes", got=f"a longer line {number}")
                if b"\0" in part:
                    raise refuse(expected="a text file in UTF-8", got=f"a NUL character in line {number}")
                yield part


def read_json(file: Path, refuse: Refuse, *, max_bytes: int = MAX_TEXT_BYTES, finite: bool = True) -> Any:
    """Read the value in a JSON file. Raises InputError as `read_bytes` and `parse_json`."""
    return parse_json(read_bytes(file, refuse, max_bytes=max_bytes), refuse, finite=finite)


def parse_json(content: str | bytes, refuse: Refuse, *, finite: bool = True) -> Any:
    """Return the value of a JSON text.

    Args:
        content: the text, or the bytes of its file.
        refuse: makes the error.
        finite: refuse NaN and infinities, which are no JSON; a reader that names their place accepts them here.

    Raises:
        InputError: it is no JSON in UTF-8; two names of an object are equal; numbers are not finite or have more than
            64 bits; texts hold NUL or halves of surrogate pairs; it is nested too deeply or has too many values.
    """
    text = decode_text(content, refuse) if isinstance(content, bytes) else content
    items = text.count(",") + text.count("[") + text.count("{")
    if items > MAX_ITEMS:
        raise refuse(expected=f"JSON of at most {MAX_ITEMS} values", got=f"about {items}")
    try:
        value = json.loads(
            text,
            parse_int=_integer,
            parse_float=_real if finite else float,
            parse_constant=_refuse_constant if finite else float,
            object_pairs_hook=_object,
        )
    except RecursionError:
        raise refuse(expected=f"JSON of at most {MAX_DEPTH} levels", got="more") from None
    except ValueError as error:
        raise refuse(expected="a JSON object", got=f"no JSON: {error}") from None
    if defect := value_defect(value, finite=finite):
        raise refuse(expected="a JSON object", got=defect)
    return value


def parse_toml(content: bytes, refuse: Refuse) -> dict[str, Any]:
    """Return the table of a TOML text. Raises InputError as `parse_json`."""
    try:
        value = tomllib.loads(decode_text(content, refuse))
    except RecursionError:
        raise refuse(expected=f"TOML of at most {MAX_DEPTH} levels", got="more") from None
    except ValueError as error:  # tomllib.TOMLDecodeError, and those of numbers and dates
        raise refuse(expected="TOML", got=error) from None
    if defect := value_defect(value):
        raise refuse(expected="TOML", got=defect)
    return value


def value_defect(value: Any, *, finite: bool = True) -> str | None:
    """What makes a parsed value unusable, None if nothing does: see `parse_json`."""
    pending = [(value, 1)]
    while pending:
        item, depth = pending.pop()
        if isinstance(item, str):
            if defect := _text_defect(item):
                return defect
        elif isinstance(item, float):
            if finite and not math.isfinite(item):
                return f"the number {item}"
        elif isinstance(item, int):
            if abs(item) > MAX_INTEGER:
                return "a number of more than 64 bits"
        elif isinstance(item, Mapping | list):
            if depth > MAX_DEPTH:
                return f"more than {MAX_DEPTH} levels"
            parts = [*item.keys(), *item.values()] if isinstance(item, Mapping) else item
            pending += [(part, depth + 1) for part in parts]
    return None


def _text_defect(text: str) -> str | None:
    if "\0" in text:
        return "a text with a NUL character"
    if text.isascii():
        return None
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return "a text with half of a surrogate pair"
    return None


def _integer(digits: str) -> int:
    if len(digits) > 20 or abs(number := int(digits)) > MAX_INTEGER:
        raise ValueError(f"the number {digits[:20]}... has more than 64 bits")
    return number


def _real(digits: str) -> float:
    if not math.isfinite(number := float(digits)):
        raise ValueError(f"the number {digits[:20]} is too large")
    return number


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the name {name[:60]!r} occurs twice")
    return value
