"""Flows without a queue: a scope that runs each job immediately in this process."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from registration.errors import InputError
from workflows.engine.child import function_of
from workflows.engine.jobs import FlowJob, Job, PermanentStepError, validate_arguments
from workflows.engine.serialization import JobFailed
from workflows.farm.flows import FLOWS
from workflows.ids import check_id, resolve_roots
from workflows.steps.table import STEPS


class Inline:
    """Stand-in for a `FlowScope`; `step` returns a job's result or raises."""

    def __init__(self, identity: str, step: Callable[[Job], Any], log: list[Job]) -> None:
        self.id, self._step, self.log = identity, step, log
        self._reasons: dict[str, str] = {}

    async def run(self, jobs: Sequence[Job | FlowJob]) -> dict[str, Any]:
        done = {}
        for job in sorted(jobs, key=lambda item: item.priority):
            try:
                if isinstance(job, FlowJob):
                    child = Inline(check_id(job.id), self._step, self.log)
                    done[job.id] = await FLOWS[job.flow](child, **json.loads(json.dumps(job.arguments)))
                else:
                    assert job.step in STEPS and json.dumps(job.spec())
                    self.log.append(job)
                    done[check_id(job.id)] = self._step(job)
            except JobFailed as error:
                self._reasons[job.id] = str(error)
        return done

    async def failures(self, jobs: Sequence[Job]) -> dict[str, str]:
        return {job.id: self._reasons[job.id] for job in jobs if job.id in self._reasons}

    async def read(self, file: str) -> Any:
        return json.loads(Path(file).read_text())

    def park(self, reason: str) -> JobFailed:
        return JobFailed({"status": "parked", "reason": reason})


def run_step(roots: Sequence[Path]) -> Callable[[Job], Any]:
    """Return a `step` for `Inline` that runs jobs as workers do, with arguments and results passed as JSON."""

    def step(job: Job) -> Any:
        entry, arguments = validate_arguments(json.loads(json.dumps(job.spec())), STEPS, resolve_roots(roots))
        try:
            return json.loads(json.dumps(function_of(entry.function)(**arguments)))
        except InputError as error:
            raise JobFailed({"status": "bad input", "reason": error.line}) from None
        except PermanentStepError as error:
            raise JobFailed({"status": "unusable", "reason": str(error)}) from None
        except Exception as error:
            raise JobFailed({"status": "failed", "reason": f"{type(error).__name__}: {error}"}) from None

    return step
