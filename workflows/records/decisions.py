"""The log of decisions about components of the stabilization, `decisions.jsonl`: JSON lines, append-only."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from getpass import getuser
from pathlib import Path

from registration.errors import InputError
from registration.stabilize.decisions import Action, Decision
from registration.storage.files import atomic_write_text
from registration.storage.reading import read_text
from registration.storage.records import Record


@dataclass(frozen=True, kw_only=True)
class DecisionEntry(
    Record, title="log of decisions", fix="check the path, or review again with `gnmreg stabilize review`"
):
    """A line of the log."""

    time: str = ""  # UTC
    by: str = ""
    dataset: str  # id of the registrations, model and settings that the decision is about
    region: str
    component: int  # from 0
    action: Action
    reason: str


def read_decisions(file: Path, dataset: str) -> list[Decision]:
    """Read the decisions of a log, in order; of several about one component the last one applies.

    Args:
        file: the log.
        dataset: id of the dataset that the decisions must be about.

    Raises:
        InputError: the file cannot be read, a line is malformed, or decisions are about another dataset.
    """
    lines = read_text(Path(file), partial(DecisionEntry.invalid, file)).splitlines()
    entries = [
        DecisionEntry.from_text(line, where=f"{file}, line {number}")
        for number, line in enumerate(lines, 1)
        if line.strip()
    ]
    datasets = {entry.dataset for entry in entries}
    if datasets - {dataset}:
        raise InputError(
            "The decisions are about another dataset",
            where=file,
            expected=f"dataset {dataset[:16]}",
            got=", ".join(sorted(other[:16] for other in datasets - {dataset})),
            fix="review this dataset: its components differ with its registrations, model and settings",
        )
    return [
        Decision(region=entry.region, component=entry.component, action=entry.action, reason=entry.reason)
        for entry in entries
    ]


def append_decisions(file: Path, dataset: str, decisions: Sequence[Decision]) -> None:
    """Append decisions with time and user name to a log, in one rename.

    Raises:
        InputError: the log cannot be read, or is about another dataset.
    """
    file = Path(file)
    previous = read_text(file, partial(DecisionEntry.invalid, file)) if os.path.lexists(file) else ""
    if previous:
        read_decisions(file, dataset)
    time, user = datetime.now(UTC).isoformat(timespec="seconds"), user_name()
    entries = [DecisionEntry(time=time, by=user, dataset=dataset, **vars(decision)) for decision in decisions]
    lines = [json.dumps(entry.to_json()) for entry in entries]
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(file, previous + "".join(f"{line}\n" for line in lines))


def user_name() -> str:
    """Return the name of the user of this process, "unknown" if it has none."""
    try:
        return getuser()
    except (OSError, KeyError):  # a container's user without a name
        return "unknown"
