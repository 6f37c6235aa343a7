"""What workers may be asked to do: a job names a step of a fixed table and hands it small JSON arguments.

A job comes out of a database that others can write to, so nothing in it is trusted: `checked` is called before
anything runs.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from workflows.ids import check_location, job_refused, shortened

GPU, SUBJECTS, DRIVER, REBUILD = "gpu", "subjects", "driver", "rebuild"  # the queues
NEUTRAL_PRIORITY, EXPRESSION_PRIORITY, STABILIZE_PRIORITY = 5, 10, 3  # the lowest number goes first
MAX_BYTES = 512 * 1024  # of a job's arguments, and of a step's result, as JSON: arrays travel as files


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


class PermanentStepError(Exception):
    """What a step made is no good, and trying again would not change that. The message is the reason."""


def checked(spec: Any, steps: Mapping[str, Step], roots: Sequence[str]) -> tuple[Step, dict[str, Any]]:
    """The step and the arguments of a job that a worker took from the queue.

    Args:
        spec: as `Job.spec` makes it, but from anyone.
        steps: the table of steps.
        roots: folders and URLs below which all places must lie, as `resolve_roots` returns them.

    Raises:
        InputError: a spec of another form, a step that is not in the table, arguments that are too large, or a place
            outside the roots.
    """
    if not isinstance(spec, dict) or set(spec) != {"step", "arguments"}:
        raise job_refused("a job's form", expected="an object of step and arguments", got=shortened(spec))
    name, arguments = spec["step"], spec["arguments"]
    if not isinstance(name, str) or name not in steps:
        raise job_refused("step", expected=f"one of {', '.join(sorted(steps))}", got=shortened(name))
    if not isinstance(arguments, dict):
        raise job_refused(name, expected="an object of arguments", got=type(arguments).__name__)
    if (size := len(json.dumps(arguments))) > MAX_BYTES:
        raise job_refused(name, expected=f"arguments of at most {MAX_BYTES} bytes", got=f"{size} bytes")
    for key in steps[name].places:
        value = arguments.get(key)
        value = list(value.values()) if isinstance(value, dict) else value
        for place in value if isinstance(value, list) else [value]:
            if place is not None:
                check_location(place, roots, where=f"{name}: {key}")
    return steps[name], arguments
