"""The log of decisions about components of the stabilization, as `gnmreg stabilize review` writes it: JSON lines."""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from getpass import getuser
from pathlib import Path

from registration.errors import InputError
from registration.stabilize.decisions import ACTIONS, Decision
from registration.storage.files import atomic_write_text


def read_decisions(file: Path, dataset: str) -> list[Decision]:
    """A log's decisions, in order; those of one component may be several, the last one counts.

    Raises InputError for a file that is no log, and for decisions about another dataset.
    """
    try:
        entries = [json.loads(line) for line in Path(file).read_text("utf-8").splitlines() if line.strip()]
        if unknown := [e["action"] for e in entries if e["action"] not in ACTIONS]:
            raise ValueError(f"the action {unknown[0]!r}")
        decisions = [
            Decision(
                region=str(e["region"]), component=int(e["component"]), action=e["action"], reason=str(e["reason"])
            )
            for e in entries
        ]
        datasets = {str(e["dataset"]) for e in entries}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "The decisions cannot be read",
            where=file,
            expected="a log as `gnmreg stabilize review` writes it",
            got=f"{type(error).__name__}: {error}",
            fix="check the path, or review again",
        ) from error
    if datasets - {dataset}:
        raise InputError(
            "The decisions are about another dataset",
            where=file,
            expected=f"dataset {dataset[:16]}",
            got=", ".join(sorted(other[:16] for other in datasets - {dataset})),
            fix="review this dataset: components differ wherever registrations, model or settings do",
        )
    return decisions


def append_decisions(file: Path, dataset: str, decisions: Sequence[Decision]) -> None:
    """Add dated decisions to the log, which appears whole or not at all; what is in it stays."""
    file = Path(file)
    former = file.read_text("utf-8") if file.is_file() else ""
    if former:
        read_decisions(file, dataset)
    head = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "by": _user(), "dataset": dataset}
    lines = [
        json.dumps({**head, "region": d.region, "component": d.component, "action": d.action, "reason": d.reason})
        for d in decisions
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(file, former + "".join(f"{line}\n" for line in lines))


def _user() -> str:
    try:
        return getuser()
    except (OSError, KeyError):  # a container's user without a name
        return "unknown"
