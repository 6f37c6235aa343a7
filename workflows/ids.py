"""Names and locations that may come from anywhere: ids of jobs, paths and URLs below a worker's roots, URLs without
passwords."""

import difflib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from registration.errors import InputError

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}(/[A-Za-z0-9][A-Za-z0-9._-]{0,99}){0,7}")
_SCHEMES = ("", "file", "s3")


def check_id(identity: str) -> str:
    """Return the id of a run, a job or an artifact if it can be used as a path of logs and results.

    Raises:
        InputError: it is not an id, or not a string.
    """
    if not isinstance(identity, str) or not _ID.fullmatch(identity):
        raise InputError(
            "The name of a run or job cannot be used",
            where="a job's id",
            expected="up to 8 parts of letters, digits, '.', '_' and '-', separated by '/', none starting with a dot",
            got=shortened(identity),
            fix="rename the run, the subject or the capture",
        )
    return identity


def id_part(name: str, length: int = 100) -> str:
    """Return a folder's name as a part of an id: other characters than those of ids become "_"."""
    part = re.sub(r"[^A-Za-z0-9._-]", "_", name)[:length]
    return part if part[:1].isalnum() else f"x{part}"


def check_location(location: Any, roots: Sequence[str], where: str) -> None:
    """Refuse a path or URL that is not below one of the roots, also by `..` or through a symbolic link.

    Args:
        location: from a job, thus of any type.
        roots: as `resolve_roots` returns them.
        where: the name of the argument, for the message.

    Raises:
        InputError: the location is outside the roots, or its URL has another scheme than file or s3, or credentials.
    """
    if not isinstance(location, str) or not location or "\0" in location:
        raise job_refused(where, expected="a path or URL", got=shortened(location))
    parts = urlsplit(location)
    if parts.scheme not in _SCHEMES:
        raise job_refused(where, expected="a path, file:// or s3:// URL", got=shortened(redact(location)))
    if "@" in parts.netloc:
        raise job_refused(where, expected="a URL without credentials", got=shortened(redact(location)))
    if ".." in Path(unquote(parts.path)).parts:
        raise job_refused(where, expected='a path or URL without ".."', got=shortened(location))
    resolved = _resolve(location)
    if not any(resolved == root or resolved.startswith(root.rstrip("/") + "/") for root in roots):
        raise job_refused(
            where, expected=f"a path or URL below {', '.join(roots) or 'a root'}", got=shortened(location)
        )


def resolve_roots(roots: Iterable[str | Path]) -> tuple[str, ...]:
    """Return roots in the form that `check_location` compares with: local ones absolute, without symbolic links."""
    return tuple(_resolve(str(root)) for root in roots)


def nearest(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return the known names that are most like one that is not known: for messages."""
    return difflib.get_close_matches(name, known, n=count, cutoff=0.5)


def redact(text: str) -> str:
    """Return the text without the passwords of any URLs in it."""
    return re.sub(r"(://[^:/@\s'\"]*):[^/@\s'\"]+@", r"\1:***@", text)


def job_refused(where: str, *, expected: str, got: str) -> InputError:
    """The error of a job that is not run."""
    return InputError(
        "The job is refused",
        where=where,
        expected=expected,
        got=got,
        fix="jobs are made by gnmreg; allow a location with `gnmreg worker --root`",
    )


def shortened(value: Any) -> str:
    """A value as text for a message, of at most 200 characters."""
    text = repr(value)
    return text if len(text) <= 200 else text[:200] + "..."


def _resolve(location: str) -> str:
    """Comparable forms: /absolute/path, or s3://bucket/key."""
    parts = urlsplit(location)
    if parts.scheme == "s3":
        return f"s3://{parts.netloc}{parts.path}".rstrip("/")
    return os.path.realpath(unquote(parts.path) if parts.scheme == "file" else location)
