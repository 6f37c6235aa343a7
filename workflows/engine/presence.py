"""What the processes of a farm say of themselves, for `gnmreg status`. Imports no SQLAlchemy."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from workflows.engine.alive import ended_processes
from workflows.engine.database import driver_errors, reading, table

WORKERS = "gnmreg_workers"  # a table beside those of DBOS: name of the process -> JSON


@dataclass(frozen=True, kw_only=True)
class Presence:
    """A process that lives."""

    name: str
    queues: tuple[str, ...]
    left: frozenset[str]  # waiting jobs outside its roots


def has_workers_table(url: str) -> bool:
    """Return whether the queue has the table of processes."""
    try:
        with reading(url) as ask:
            ask(f"SELECT 1 FROM {table(url, WORKERS)} LIMIT 1", {})
    except driver_errors(url):
        return False
    return True


def living_processes(url: str) -> list[Presence]:
    """Return the processes that live, by name; none if the queue is an earlier release's."""
    try:
        with reading(url) as ask:
            rows = ask(f"SELECT name, about FROM {table(url, WORKERS)} ORDER BY name", {})
    except driver_errors(url):
        return []
    ended = ended_processes(url, [str(name) for name, _ in rows])
    return [_presence(str(name), about) for name, about in rows if name not in ended]


def uncovered(processes: Sequence[Presence], waiting: Mapping[str, str | None]) -> list[str]:
    """Return the ids of waiting jobs that every worker of their queue leaves to others.

    Args:
        processes: that live.
        waiting: id -> queue.
    """
    found = []
    for identity, queue in waiting.items():
        listening = [process for process in processes if queue in process.queues]
        if listening and all(identity in process.left for process in listening):
            found.append(identity)
    return found


def _presence(name: str, about: object) -> Presence:
    """What is in a row; others can write to the database, too."""
    try:
        value = json.loads(about) if isinstance(about, str) else {}
    except (ValueError, RecursionError):
        value = {}
    value = value if isinstance(value, dict) else {}
    queues, left = (value.get(key) for key in ("queues", "left"))
    return Presence(
        name=name,
        queues=tuple(map(str, queues)) if isinstance(queues, list) else (),
        left=frozenset(map(str, left)) if isinstance(left, list) else frozenset(),
    )
