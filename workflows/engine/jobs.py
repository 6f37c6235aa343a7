"""What workers may be asked to do: a job names a step of a fixed table and hands it small JSON arguments.

A job comes out of a database that others can write to, so nothing in it is trusted: `checked` is called before
anything runs.
"""

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from registration.errors import InputError

GPU, SUBJECTS, DRIVER, REBUILD = "gpu", "subjects", "driver", "rebuild"  # the queues
NEUTRAL_PRIORITY, EXPRESSION_PRIORITY, STABILIZE_PRIORITY = 5, 10, 3  # the lowest number goes first
MAX_BYTES = 512 * 1024  # of a job's arguments, and of a step's result, as JSON: arrays travel as files

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}(/[A-Za-z0-9][A-Za-z0-9._-]{0,99}){0,7}")
_SCHEMES = ("", "file", "s3")


@dataclass(frozen=True, kw_only=True)
class Step:
    """A row of the table of steps."""

    function: str  # "package.module:name", called in a child process with a job's arguments as keywords
    places: tuple[str, ...] = ()  # the arguments that are paths or URLs: they must lie below the worker's roots
    hard_s: float = 3 * 3600.0  # a job that takes longer is killed and not tried again


@dataclass(frozen=True, kw_only=True)
class Job:
    """One call of a step. Its id is also what keeps it from being done twice."""

    id: str  # RUN/..., e.g. RUN/it00/s0007/e03
    step: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    queue: str = GPU
    priority: int = EXPRESSION_PRIORITY

    def spec(self) -> dict[str, Any]:
        """What a worker is handed."""
        return {"step": self.step, "arguments": dict(self.arguments)}


@dataclass(frozen=True, kw_only=True)
class FlowJob:
    """One run of a flow: a function that makes jobs and waits for them, run by a coordinator."""

    id: str
    flow: str  # its name in the table of flows
    arguments: Mapping[str, Any] = field(default_factory=dict)
    queue: str = SUBJECTS
    priority: int = EXPRESSION_PRIORITY

    def spec(self) -> dict[str, Any]:
        """What a coordinator is handed."""
        return {"flow": self.flow, "arguments": dict(self.arguments)}


class Unusable(Exception):
    """What a step made is no good, and trying again would not change that. The message is the reason."""


STEPS: Mapping[str, Step] = {
    "register stored": Step(function="workflows.steps.register:register_stored", places=("capture", "model", "store")),
    "register": Step(
        function="workflows.steps.register:register_capture",
        places=("capture", "model", "out", "neutral", "subject_dir"),
    ),
    "collect": Step(function="workflows.steps.coregistration:register_subject", places=("subject_dir", "model", "out")),
    "hold out": Step(
        function="workflows.steps.coregistration:hold_out", places=("dataset", "registrations", "model", "out")
    ),
    "stabilize": Step(function="workflows.steps.coregistration:stabilize", places=("run", "model", "out")),
    "build": Step(
        function="workflows.steps.coregistration:build", places=("run", "steady", "dataset", "previous", "out")
    ),
    "evaluate": Step(function="workflows.steps.coregistration:evaluate", places=("models", "people", "out")),
    "end round": Step(function="workflows.steps.register:end_round", places=("plan",)),
}


def checked(spec: Any, steps: Mapping[str, Step], roots: Sequence[str]) -> tuple[Step, dict[str, Any]]:
    """The step and the arguments of a job that a worker took from the queue.

    Args:
        spec: as `Job.spec` makes it, but from anyone.
        steps: the table of steps.
        roots: folders and URLs below which all places must lie, as `resolved_roots` returns them.

    Raises:
        InputError: a spec of another form, a step that is not in the table, arguments that are too large, or a place
            outside the roots.
    """
    if not isinstance(spec, dict) or set(spec) != {"step", "arguments"}:
        raise _refused("a job's form", expected="an object of step and arguments", got=_shown(spec))
    name, arguments = spec["step"], spec["arguments"]
    if not isinstance(name, str) or name not in steps:
        raise _refused("step", expected=f"one of {', '.join(sorted(steps))}", got=_shown(name))
    if not isinstance(arguments, dict):
        raise _refused(name, expected="an object of arguments", got=type(arguments).__name__)
    if (size := len(json.dumps(arguments))) > MAX_BYTES:
        raise _refused(name, expected=f"arguments of at most {MAX_BYTES} bytes", got=f"{size} bytes")
    for key in steps[name].places:
        value = arguments.get(key)
        value = list(value.values()) if isinstance(value, dict) else value
        for place in value if isinstance(value, list) else [value]:
            if place is not None:
                check_place(place, roots, where=f"{name}: {key}")
    return steps[name], arguments


def check_place(place: Any, roots: Sequence[str], where: str) -> None:
    """Refuse a path or URL that is not below one of the roots, also by `..` or through a symbolic link.

    Raises:
        InputError: so it is, or the URL has another scheme than file or s3, or carries a user name or password.
    """
    if not isinstance(place, str) or not place or "\0" in place:
        raise _refused(where, expected="a path or URL", got=_shown(place))
    parts = urlsplit(place)
    if parts.scheme not in _SCHEMES:
        raise _refused(where, expected="a path, file:// or s3:// URL", got=_shown(redacted(place)))
    if "@" in parts.netloc:
        raise _refused(where, expected="a URL without credentials", got=_shown(redacted(place)))
    if ".." in Path(unquote(parts.path)).parts:
        raise _refused(where, expected='a place without ".."', got=_shown(place))
    found = _resolved(place)
    if not any(found == root or found.startswith(root.rstrip("/") + "/") for root in roots):
        raise _refused(where, expected=f"a place below {', '.join(roots) or 'a root'}", got=_shown(place))


def resolved_roots(roots: Iterable[str | Path]) -> tuple[str, ...]:
    """Roots in the form that `check_place` compares with: local ones absolute, without symbolic links."""
    return tuple(_resolved(str(root)) for root in roots)


def check_id(identity: str) -> str:
    """The id itself. Raises InputError if it is none: ids are also paths of logs and results."""
    if not isinstance(identity, str) or not _ID.fullmatch(identity):
        raise InputError(
            "The name of a run or job cannot be used",
            where="a job's id",
            expected="up to 8 parts of letters, digits, '.', '_' and '-', separated by '/', none starting with a dot",
            got=_shown(identity),
            fix="rename the run, the subject or the capture",
        )
    return identity


def redacted(text: str) -> str:
    """The text without the passwords of any URLs in it."""
    return re.sub(r"(://[^:/@\s'\"]*):[^/@\s'\"]+@", r"\1:***@", text)


def _resolved(place: str) -> str:
    """Comparable forms: /absolute/path, or s3://bucket/key."""
    parts = urlsplit(place)
    if parts.scheme == "s3":
        return f"s3://{parts.netloc}{parts.path}".rstrip("/")
    return os.path.realpath(unquote(parts.path) if parts.scheme == "file" else place)


def _refused(where: str, *, expected: str, got: str) -> InputError:
    return InputError(
        "The job is refused",
        where=where,
        expected=expected,
        got=got,
        fix="jobs are made by gnmreg; allow a place with `gnmreg worker --root`",
    )


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else text[:200] + "..."
