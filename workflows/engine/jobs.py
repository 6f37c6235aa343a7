"""Jobs of the queue: a job names a step of a fixed table and gives it small JSON arguments.

Others can write to the queue's database, so nothing in a job is trusted: `validate_arguments` is called before anything
runs.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from workflows.ids import check_location, job_refused, shortened

VERSION = "wf-4"  # change it only with the structure of a workflow: workers take jobs of their own version only
GPU, SUBJECTS, DRIVER, REBUILD = "gpu", "subjects", "driver", "rebuild"  # the queues
NEUTRAL_PRIORITY, EXPRESSION_PRIORITY, STABILIZE_PRIORITY = 5, 10, 3  # the lowest number first
MAX_BYTES = 512 * 1024  # of a job's arguments and of a step's result, as JSON: arrays are passed as files


@dataclass(frozen=True, kw_only=True)
class Step:
    """An entry of the table of steps."""

    function: str  # "package.module:name", called in a child process with a job's arguments as keywords
    path_arguments: tuple[str, ...] = ()  # arguments that are paths or URLs: they must lie below the worker's roots
    timeout_s: float = 3 * 3600.0  # a job that takes longer is killed and not repeated


@dataclass(frozen=True, kw_only=True)
class Job:
    """One call of a step. The queue runs each id once."""

    id: str  # RUN/..., e.g. RUN/it00/s0007/e03
    step: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    queue: str = GPU
    priority: int = EXPRESSION_PRIORITY

    def spec(self) -> dict[str, Any]:
        """Return what a worker receives."""
        return {"step": self.step, "arguments": dict(self.arguments)}


@dataclass(frozen=True, kw_only=True)
class FlowJob:
    """One execution of a flow, a function that submits jobs and waits for them, by a coordinator."""

    id: str
    flow: str  # its name in the table of flows
    arguments: Mapping[str, Any] = field(default_factory=dict)
    queue: str = SUBJECTS
    priority: int = EXPRESSION_PRIORITY

    def spec(self) -> dict[str, Any]:
        """Return what a coordinator receives."""
        return {"flow": self.flow, "arguments": dict(self.arguments)}


class PermanentStepError(Exception):
    """A step's result is unusable, and repeating the step would not change that. The message is the reason."""


def validate_arguments(spec: Any, steps: Mapping[str, Step], roots: Sequence[str]) -> tuple[Step, dict[str, Any]]:
    """Return the step and the arguments of a job that a worker took from the queue, with paths as they are opened.

    Args:
        spec: as `Job.spec` returns it, but from an untrusted source.
        steps: the table of steps.
        roots: folders and URLs below which all paths and URLs must lie, as `resolve_roots` returns them.

    Raises:
        InputError: the spec has another form, the step is not in the table, the arguments are too large, or a path or
            URL lies outside the roots.
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
    places = {
        key: _checked(arguments[key], roots, where=f"{name}: {key}")
        for key in steps[name].path_arguments
        if arguments.get(key) is not None
    }
    return steps[name], {**arguments, **places}


def _checked(value: Any, roots: Sequence[str], where: str) -> Any:
    """The places that an argument names: one, or some in a list or an object."""
    if isinstance(value, dict):
        return {key: _checked(item, roots, where) for key, item in value.items()}
    if isinstance(value, list):
        return [_checked(item, roots, where) for item in value]
    return check_location(value, roots, where)
