"""Kinds of failures: many jobs that failed for one reason are one line, whatever their paths are."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from workflows.engine.reader import FAILED, JobTimes

_QUOTED = re.compile(r"""(["'])(?:(?!\1).)*\1""")
_PATH = re.compile(r"\b[a-z0-9+]+://\S+|(?<![\w.])\.{0,2}(?:/[^\s/:;,()'\"]+)+/?")
_NUMBER = re.compile(r"\b0x[0-9a-f]+\b|\b\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class FailureKind:
    """Failed jobs of one kind."""

    kind: str  # "status: what is wrong", without paths and numbers
    jobs: tuple[str, ...]  # their ids
    reason: str  # of the first, whole
    fix: str  # how to mend it, if the failure says so


def failure_kinds(rows: Iterable[JobTimes]) -> list[FailureKind]:
    """Return the kinds of the failed ones of these jobs, the most frequent first."""
    by_kind: dict[str, list[JobTimes]] = {}
    for row in rows:
        if row.state == FAILED and row.failure is not None:
            by_kind.setdefault(kind_of(row.failure), []).append(row)
    kinds = [
        FailureKind(
            kind=kind,
            jobs=tuple(row.id for row in same),
            reason=str((same[0].failure or {}).get("reason", "")),
            fix=str((same[0].failure or {}).get("fix", "")),
        )
        for kind, same in by_kind.items()
    ]
    return sorted(kinds, key=lambda kind: (-len(kind.jobs), kind.kind))


def kind_of(failure: Mapping[str, Any]) -> str:
    """Return the kind of a failure's record: what its step named, or its reason without paths, names and numbers."""
    what = failure.get("what")
    if not isinstance(what, str) or not what:
        what = general(str(failure.get("reason", "")))
    return f"{failure.get('status')}: {what}"


def general(text: str) -> str:
    """Return a message without what differs from job to job: quoted text, paths, URLs and numbers."""
    text = _NUMBER.sub("N", _PATH.sub("PATH", _QUOTED.sub("...", text)))
    return " ".join(text.split())[:300]
