"""Flows of test steps with the structure of the real flows."""

from typing import Any

from workflows.engine.jobs import EXPRESSION_PRIORITY, NEUTRAL_PRIORITY, STABILIZE_PRIORITY, FlowJob, Job
from workflows.engine.scope import FlowScope
from workflows.farm.flows import batch


async def graph(scope: FlowScope, *, subjects: int, expressions: int, folder: str, seconds: float) -> dict[str, Any]:
    """Run a flow per subject (neutral, expressions, stabilization), then a rebuild."""
    flows = [
        FlowJob(
            id=f"{scope.id}/s{number:04d}",
            flow="subject",
            arguments={"expressions": expressions, "folder": folder, "seconds": seconds},
        )
        for number in range(subjects)
    ]
    results = await scope.run(flows)
    rebuilt = await scope.run([_work(f"{scope.id}/rebuild", folder, seconds, queue="rebuild")])
    return {"subjects": len(results), "rebuilt": len(rebuilt)}


async def subject(scope: FlowScope, *, expressions: int, folder: str, seconds: float) -> dict[str, Any]:
    await scope.run([_work(f"{scope.id}/neutral", folder, seconds, priority=NEUTRAL_PRIORITY)])
    jobs = [_work(f"{scope.id}/e{n:02d}", folder, seconds, priority=EXPRESSION_PRIORITY) for n in range(expressions)]
    done = await scope.run(jobs)
    await scope.run([_work(f"{scope.id}/stab", folder, seconds, priority=STABILIZE_PRIORITY)])
    return {"expressions": len(done)}


def _work(identity: str, folder: str, seconds: float, **settings: Any) -> Job:
    arguments = {"store": f"{folder}/store", "key": identity, "seconds": seconds, "trace": f"{folder}/trace.txt"}
    return Job(id=identity, step="work", arguments=arguments, **settings)


FLOWS = {"graph": graph, "subject": subject, "batch": batch}
