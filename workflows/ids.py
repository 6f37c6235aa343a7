"""Names and locations that may come from anywhere: ids of jobs, paths and URLs below a worker's roots, URLs without
passwords."""

import difflib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from registration.errors import InputError

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}(/[A-Za-z0-9][A-Za-z0-9._-]{0,99}){0,7}")
_BUCKET = re.compile(r"[A-Za-z0-9._-]{1,255}|arn:.+")
SECRET_NAME = re.compile(r"\w*(?:passw|secret|token|credential|signature|access_?key)\w*", re.IGNORECASE)
_REFUSED_FIX = "jobs are made by gnmreg; allow a location with `gnmreg worker --root`"
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://|file:", re.IGNORECASE)


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


def resolve_place(location: Any, where: str) -> str:
    """Return what a path or URL names, in the one form in which it is checked and opened.

    That is an absolute path without "..", symbolic links or escapes, or `s3://bucket/key`. A path is taken literally:
    only what begins with `scheme://` or `file:` is a URL. Open nothing but the result: libraries read more into a
    location than a path, such as chains ("a::b"), queries and home folders.

    Args:
        location: from anywhere, thus of any type.
        where: the name of the argument, for the message.

    Raises:
        InputError: the location is empty or no text; its URL has another scheme than file or s3, a query, a fragment,
            credentials, or another host's file.
    """
    if not isinstance(location, str) or not location or "\0" in location:
        raise _no_place(where, expected="a path or URL", got=shortened(location))
    url = _URL.match(location)
    if url is None:
        return _absolute(location, where)
    scheme, rest = (url[1] or "file").lower(), location[url.end() :]
    if scheme not in ("file", "s3"):
        raise _no_place(where, expected="a path, file:// or s3:// URL", got=f"a URL of the scheme {scheme}")
    host, slash, path = rest.partition("/")
    if "@" in host or (scheme == "s3" and ":" in host and not host.startswith("arn:")):
        raise _no_place(where, expected="a URL without credentials", got="one with credentials")
    if found := next((c for c in location if c in "?#" or not c.isprintable()), None):
        raise _no_place(where, expected="a URL without query, fragment or control characters", got=repr(found))
    if scheme == "s3":
        if not _BUCKET.fullmatch(host) or {".", ".."} & set(path.split("/")):
            raise _no_place(where, expected='s3://bucket/key without ".."', got=shortened(location))
        return f"s3://{host}/{path}".rstrip("/")
    if not slash or host.lower() not in ("", "localhost") or (host and url[1] is None):
        raise _no_place(where, expected="file:///path of this machine", got=shortened(location))
    try:
        return _absolute("/" + unquote(path, errors="strict"), where)
    except UnicodeDecodeError:
        raise _no_place(where, expected="escapes of UTF-8 text", got=shortened(location)) from None


def is_remote(place: str) -> bool:
    """Return whether a place, as `resolve_place` returns it, is in object storage."""
    return place.startswith("s3://")


def check_location(location: Any, roots: Sequence[str], where: str) -> str:
    """Return what a path or URL names, as `resolve_place`, if that is below one of the roots; open nothing else.

    Args:
        location: from a job, thus of any type.
        roots: as `resolve_roots` returns them.
        where: the name of the argument, for the message.

    Raises:
        OutsideRoots: the place is outside the roots.
        InputError: as `resolve_place`.
    """
    place = resolve_place(location, where)
    if not any(place == root or place.startswith(root.rstrip("/") + "/") for root in roots):
        allowed = ", ".join(roots) or "a root"
        raise OutsideRoots(where, expected=f"a path or URL below {allowed}", got=shortened(location))
    return place


def resolve_roots(roots: Iterable[str | Path]) -> tuple[str, ...]:
    """Return roots in the form that `check_location` compares with. Raises InputError as `resolve_place`."""
    return tuple(resolve_place(str(root), "--root") for root in roots)


def check_name(name: Any, where: str) -> str:
    """Return the name of a folder or file if it is one, not a path. Raises InputError."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\0" in name:
        raise job_refused(where, expected="names of folders, not paths", got=shortened(name))
    return name


def nearest(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return the known names that are most like one that is not known: for messages."""
    return difflib.get_close_matches(name, known, n=count, cutoff=0.5)


def redact(text: str) -> str:
    """Return the text without passwords and keys: of URLs, up to the last "@", of their queries, of settings."""
    text = re.sub(r"(://[^:/@\s]*):(?:(?!://)\S)*@", r"\1:***@", text)
    return re.sub(rf"({SECRET_NAME.pattern}=)('[^']*'|[^&#\s'\"]+)", r"\1***", text, flags=re.IGNORECASE)


class OutsideRoots(InputError):
    """A job's place is not below the roots of this worker: another one may take the job."""

    def __init__(self, where: str, *, expected: str, got: str) -> None:
        super().__init__("The job is refused", where=where, expected=expected, got=got, fix=_REFUSED_FIX)


def job_refused(where: str, *, expected: str, got: str) -> InputError:
    """The error of a job that is not run."""
    return InputError("The job is refused", where=where, expected=expected, got=got, fix=_REFUSED_FIX)


def shortened(value: Any) -> str:
    """A value as text for a message, of at most 200 characters."""
    text = repr(value)
    return text if len(text) <= 200 else text[:200] + "..."


def _absolute(path: str, where: str) -> str:
    try:
        os.fsencode(path)
        return "/" + os.path.realpath(path).lstrip("/")  # "//x" is another name of "/x"
    except (OSError, ValueError):
        raise _no_place(where, expected="a path", got=shortened(path)) from None


def _no_place(where: str, *, expected: str, got: str) -> InputError:
    return InputError(
        "The path or URL cannot be used",
        where=where,
        expected=expected,
        got=got,
        fix="give a path, or s3://bucket/key; keys of object storage come from the environment",
    )
