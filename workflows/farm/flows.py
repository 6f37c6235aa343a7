"""The order of jobs on a farm: batches, subjects, and the coregistration loop. A coordinator executes them durably.

A flow is a function of a `FlowScope` and small JSON arguments. It submits jobs and waits; it computes nothing, and all
its data come from steps, so that it is deterministic when it is restarted.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from coregister.stopping_rule import StoppingVerdict
from registration.storage.records import structure, to_json
from workflows.engine.jobs import (
    EXPRESSION_PRIORITY,
    GPU,
    NEUTRAL_PRIORITY,
    REBUILD,
    STABILIZE_PRIORITY,
    FlowJob,
    Job,
)
from workflows.ids import id_part
from workflows.records.coregistration import CoregistrationPlan, RoundProducts
from workflows.records.round_files import FIRST_MODEL, PLAN, model_name
from workflows.records.step_results import BuildResult, EvaluateResult, GateResult, HoldOutResult, StabilizeResult
from workflows.steps import table

if TYPE_CHECKING:
    from workflows.engine.scope import FlowScope

NAME_LENGTH = 60  # of subjects' and captures' names in ids, which begin with their numbers


async def batch(scope: "FlowScope") -> dict[str, int]:
    """Wait for the jobs of a batch, which are already in the queue. Returns state -> number of jobs."""
    return await scope.wait_below(scope.id)


async def subject(
    scope: "FlowScope",
    *,
    subject_dir: str,
    captures: Sequence[str],
    model: str,
    out: str,
    options: Mapping[str, Any],
) -> dict[str, int]:
    """Register a subject: the neutral, then each expression from it, then the record of all.

    A capture that fails does not affect the others, except that without a neutral nothing is registered.

    Args:
        scope: of the flow.
        subject_dir: folder of the captures.
        captures: names of their folders, the neutral's first.
        model: file of the model.
        out: folder of the registrations.
        options: a `RegisterOptions` as JSON.

    Returns:
        Numbers of usable and failed captures.
    """
    neutral, *others = captures
    shared = {"model": model, "options": dict(options)}

    neutral_id = "neutral" if neutral == "neutral" else f"neutral-{id_part(neutral, NAME_LENGTH)}"

    def job(number: int, name: str) -> Job:
        kind = f"e{number:03d}-{id_part(name, NAME_LENGTH)}" if number else neutral_id
        arguments = {"capture": f"{subject_dir}/{name}", "out": f"{out}/{name}", **shared}
        arguments |= {"neutral": f"{out}/{neutral}"} if number else {"subject_dir": subject_dir}
        priority = NEUTRAL_PRIORITY if number == 0 else EXPRESSION_PRIORITY
        return Job(id=f"{scope.id}/{kind}", step=table.REGISTER, arguments=arguments, priority=priority)

    jobs = {name: job(number, name) for number, name in enumerate(captures)}
    done = await scope.run([jobs[neutral]])
    if done:
        done |= await scope.run([jobs[name] for name in others])
    failures = await scope.failures([jobs[name] for name in (captures if done else [neutral])])
    leave = {name: failures[job.id] for name, job in jobs.items() if job.id in failures}
    if not done:
        leave |= {name: f"the neutral failed: {leave[neutral]}" for name in others}
    arguments = {"subject_dir": subject_dir, "out": out, "leave": leave, **shared}
    identity = _unique_id(f"{scope.id}/collect", arguments)
    await scope.run([Job(id=identity, step=table.COLLECT, arguments=arguments, priority=STABILIZE_PRIORITY)])
    return {"usable": len(done), "failed": len(captures) - len(done)}


async def coregister(scope: "FlowScope", *, plan: str) -> dict[str, Any]:
    """Execute the rounds of a plan: register, stabilize, build, evaluate, apply the stopping rule.

    Args:
        scope: of the flow.
        plan: the file `plan.json`.

    Returns:
        The number of rounds, the last model's file and the reason of the end.
    """
    record = CoregistrationPlan.from_json(await scope.read(_checked_plan(scope, plan)), where=plan)
    if PurePosixPath(plan).parent != PurePosixPath(record.out):
        raise scope.park(f"the plan is that of another folder than {PurePosixPath(plan).parent}")
    training, model = list(record.split.training), str(record.model)
    held_out = await _hold_out(scope, record)
    models, rounds = {FIRST_MODEL: model}, list[RoundProducts]()
    for number in range(record.rule.max_rounds):
        name = f"it{number:02d}"
        folder = f"{record.out}/{name}"
        run = f"{folder}/registrations"
        await _register(scope, name, record, training, run, model)
        gated, gate = await _gate(scope, name, record, training, run)
        stabilized = StabilizeResult.from_json(
            await _run_step(
                scope,
                f"{name}/stab",
                table.STABILIZE,
                run=run,
                names=training,
                model=model,
                out=f"{run}/stabilized",
                **gate,
            ),
            where=f"{name}/stab",
        )
        built = BuildResult.from_json(
            await _run_step(
                scope,
                f"{name}/build",
                table.BUILD,
                run=run,
                names=training,
                made=gate | {"first": str(record.model)} | _if_any("stabilized", stabilized.out),
                dataset=str(record.dataset),
                previous=model,
                out=f"{folder}/model",
                recipe=record.model_recipe.to_json() | (_anatomy(record) if number == 0 else {}),
            ),
            where=f"{name}/build",
        )
        model = built.model
        models[model_name(number + 1)] = model
        evaluated = EvaluateResult.from_json(
            await _run_step(
                scope,
                f"{name}/evaluate",
                table.EVALUATE,
                models=models,
                held_out=held_out.file,
                out=f"{folder}/evaluation",
                components=list(record.components),
                samples=record.samples,
                seed=record.seed,
            ),
            where=f"{name}/evaluate",
        )
        rounds.append(RoundProducts(name=name, gate=gated, stabilize=stabilized, build=built, evaluate=evaluated))
        verdict = await _end_round(scope, name, plan, held_out, rounds)
        if not verdict.proceed:
            break
    return {"rounds": len(rounds), "model": model, "reason": verdict.reason}


def _checked_plan(scope: "FlowScope", plan: str) -> str:
    """The path of a plan, from a row that others can write: no other file of this machine is read."""
    if PurePosixPath(plan).name != PLAN or not PurePosixPath(plan).is_absolute():
        raise scope.park(f"no path of a {PLAN}")
    return plan


async def _gate(
    scope: "FlowScope", name: str, plan: CoregistrationPlan, names: Sequence[str], run: str
) -> tuple[GateResult | None, dict[str, str]]:
    """The gate's result, and the folder of its record as an argument of the steps that use the registrations.

    If registrations wait for a person, and the policy asks for decisions, the step fails and the run is parked.
    """
    if plan.gate is None:
        return None, {}
    folder = f"{plan.out}/{name}/gate"
    value = await _run_step(
        scope,
        f"{name}/gate",
        table.GATE,
        run=run,
        names=list(names),
        policy=plan.gate.policy,
        thresholds=dict(plan.gate.thresholds),
        decisions=None if plan.gate.decisions is None else str(plan.gate.decisions),
        out=folder,
    )
    gated = GateResult.from_json(value, where=f"{name}/gate")
    return gated, {"gate": folder}


async def _end_round(
    scope: "FlowScope", name: str, plan: str, held_out: HoldOutResult, rounds: Sequence[RoundProducts]
) -> StoppingVerdict:
    """The stopping rule's verdict, in the record."""
    arguments = {"plan": plan, "held_out": held_out.to_json(), "rounds": to_json(rounds)}
    value = await _run_step(scope, f"{name}/decide", table.END_ROUND, **arguments)
    verdict: StoppingVerdict = structure(value, StoppingVerdict, where=f"{name}/decide", title="verdict")
    return verdict


def _if_any(kind: str, folder: str | None) -> dict[str, str]:
    return {} if folder is None else {kind: folder}


def _anatomy(record: CoregistrationPlan) -> dict[str, Any]:
    """What the first round's build regenerates, as an entry of its recipe."""
    return {"anatomy": {"parts": list(record.anatomy), "seed": record.seed}} if record.anatomy else {}


async def _hold_out(scope: "FlowScope", plan: CoregistrationPlan) -> HoldOutResult:
    """The held-out subjects; those without true meshes are registered with the first model."""
    folder = f"{plan.out}/held_out"
    run = f"{folder}/registrations"
    if plan.without_truth:
        await _register(scope, "held", plan, plan.without_truth, run, str(plan.model))
    value = await _run_step(
        scope,
        "hold_out",
        table.HOLD_OUT,
        dataset=str(plan.dataset),
        names=list(plan.split.held_out),
        registrations=run,
        model=str(plan.model),
        out=folder,
    )
    return HoldOutResult.from_json(value, where="hold_out")


async def _register(
    scope: "FlowScope", part: str, plan: CoregistrationPlan, names: Sequence[str], run: str, model: str
) -> None:
    """Register subjects, each in a flow. If too many captures fail, the run is parked for manual inspection."""
    options = to_json(plan.options)
    flows = [
        FlowJob(
            id=f"{scope.id}/{part}/s{number:05d}-{id_part(name, NAME_LENGTH)}",
            flow="subject",
            arguments={
                "subject_dir": f"{plan.dataset}/{name}",
                "captures": list(plan.captures[name]),
                "model": model,
                "out": f"{run}/{name}",
                "options": options,
            },
        )
        for number, name in enumerate(names)
    ]
    done = await scope.run(flows)
    total = sum(len(plan.captures[name]) for name in names)
    failed = total - sum(result["usable"] for result in done.values())
    if failed > plan.rule.max_failure_rate * total:
        raise scope.park(f"{part}: {failed} of {total} captures failed; inspect them, then `gnmreg retry`")


async def _run_step(scope: "FlowScope", part: str, step: str, **arguments: Any) -> dict[str, Any]:
    """The result of one job; the run is parked if it fails."""
    queue = GPU if step == table.END_ROUND else REBUILD
    identity = _unique_id(f"{scope.id}/{part}", arguments)
    job = Job(id=identity, step=step, arguments=arguments, queue=queue, priority=STABILIZE_PRIORITY)
    done = await scope.run([job])
    if job.id not in done:
        failures = await scope.failures([job])
        raise scope.park(f"{part}: {failures.get(job.id, 'cancelled')}")
    result: dict[str, Any] = done[job.id]
    return result


def _unique_id(identity: str, arguments: Mapping[str, Any]) -> str:
    """An id for these arguments: a retried run may submit the job with others, and the queue runs each id once."""
    digest = hashlib.sha256(json.dumps(arguments, sort_keys=True).encode()).hexdigest()
    return f"{identity}-{digest[:8]}"


FLOWS: Mapping[str, Any] = {"batch": batch, "subject": subject, "coregister": coregister}
