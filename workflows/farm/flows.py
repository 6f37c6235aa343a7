"""The order of jobs on a farm: batches, subjects, and the coregistration loop. A coordinator runs them, durably.

A flow is a function of a `FlowScope` and small JSON arguments. It submits jobs and waits; it computes nothing, and all
its data come from steps, so that it is deterministic when it is restarted.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from workflows.engine.jobs import EXPRESSION_PRIORITY, GPU, NEUTRAL_PRIORITY, REBUILD, STABILIZE_PRIORITY, FlowJob, Job
from workflows.records.coregistration import FIRST
from workflows.steps import table

if TYPE_CHECKING:
    from workflows.engine.scope import FlowScope


async def batch(scope: "FlowScope") -> dict[str, int]:
    """Wait for the jobs of a batch, which lie in the queue already. Returns state -> how many."""
    return await scope.wait_below(scope.id)


async def subject(
    scope: "FlowScope",
    *,
    subject_dir: str,
    captures: Sequence[str],
    model: str,
    out: str,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """A subject: the neutral, then each expression from it, then the record of all.

    A capture that cannot be registered takes no other along; only without a neutral nothing is registered. `captures`
    are the names of their folders, the neutral's first.
    """
    neutral, *others = captures
    place = {"model": model, **settings}

    def job(number: int, name: str) -> Job:
        kind = "neutral" if number == 0 else f"e{number:03d}"
        arguments = {"capture": f"{subject_dir}/{name}", "out": f"{out}/{name}", **place}
        arguments |= {"neutral": f"{out}/{neutral}"} if number else {"subject_dir": subject_dir}
        priority = NEUTRAL_PRIORITY if number == 0 else EXPRESSION_PRIORITY
        return Job(id=f"{scope.id}/{kind}", step=table.REGISTER, arguments=arguments, priority=priority)

    jobs = {name: job(number, name) for number, name in enumerate(captures)}
    done = await scope.run([jobs[neutral]])
    if done:
        done |= await scope.run([jobs[name] for name in others])
    failures = await scope.failures([jobs[name] for name in (captures if done else [neutral])])
    leave = {name: failures[one.id] for name, one in jobs.items() if one.id in failures}
    if not done:
        leave |= {name: f"the neutral failed: {leave[neutral]}" for name in others}
    arguments = {"subject_dir": subject_dir, "out": out, "leave": leave, **_without(place, "variant")}
    identity = _named(f"{scope.id}/collect", arguments)
    await scope.run([Job(id=identity, step=table.COLLECT, arguments=arguments, priority=STABILIZE_PRIORITY)])
    return {"usable": len(done), "failed": len(captures) - len(done)}


async def coregister(scope: "FlowScope", *, plan: str, variant: str = "llvm") -> dict[str, Any]:
    """Rounds of registering all, stabilizing, building, evaluating and deciding (`coregistration.py` as a flow)."""
    told = await scope.read(plan)
    out, model, rule = told["out"], told["model"], told["rule"]
    settings = {"recipe": told["recipe"], "views": told["views"], "seed": told["seed"], "variant": variant}
    people = await _hold_out(scope, told, settings)
    models, rounds = {FIRST: model}, list[dict[str, Any]]()
    for number in range(rule["rounds"]):
        name = f"it{number:02d}"
        run = f"{out}/{name}/registrations"
        await _register(scope, name, told, told["split"]["training"], run, model, settings)
        steady = f"{run}/stabilized"
        names = told["split"]["training"]
        still = await _one(scope, f"{name}/stab", table.STABILIZE, run=run, names=names, model=model, out=steady)
        built = await _one(
            scope,
            f"{name}/build",
            table.BUILD,
            run=run,
            names=names,
            steady=still["out"],
            dataset=told["dataset"],
            previous=model,
            out=f"{out}/{name}/model",
            recipe=told["model_recipe"],
        )
        model = built["model"]
        models[f"model {number + 1}"] = model
        measured = await _one(
            scope,
            f"{name}/evaluate",
            table.EVALUATE,
            models=models,
            people=people["people"],
            out=f"{out}/{name}/evaluation",
            components=told["components"],
            samples=told["samples"],
            seed=told["seed"],
        )
        rounds.append({"name": name, "stabilize": still, "build": built, "evaluate": measured})
        verdict = await _one(scope, f"{name}/decide", table.END_ROUND, plan=plan, people=people, rounds=rounds)
        if not verdict["go_on"]:
            break
    return {"rounds": len(rounds), "model": model, "reason": verdict["reason"]}


async def _hold_out(scope: "FlowScope", told: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """What models are measured on; who has no truth is registered with the first model."""
    run = f"{told['out']}/held_out/registrations"
    if told["bare"]:
        await _register(scope, "held", told, told["bare"], run, told["model"], settings)
    return await _one(
        scope,
        "hold_out",
        table.HOLD_OUT,
        dataset=told["dataset"],
        names=told["split"]["held_out"],
        registrations=run,
        model=told["model"],
        out=f"{told['out']}/held_out",
    )


async def _register(
    scope: "FlowScope",
    part: str,
    told: Mapping[str, Any],
    names: Sequence[str],
    run: str,
    model: str,
    settings: Mapping[str, Any],
) -> None:
    """All subjects, each a flow. Parks the run if too many captures fail: a person shall look before it goes on."""
    flows = [
        FlowJob(
            id=f"{scope.id}/{part}/s{number:05d}",
            flow="subject",
            arguments={
                "subject_dir": f"{told['dataset']}/{name}",
                "captures": told["captures"][name],
                "model": model,
                "out": f"{run}/{name}",
                "settings": dict(settings),
            },
        )
        for number, name in enumerate(names)
    ]
    done = await scope.run(flows)
    total = sum(len(told["captures"][name]) for name in names)
    usable = sum(one["usable"] for one in done.values())
    if total - usable > told["rule"]["failures"] * total:
        raise scope.park(f"{part}: {total - usable} of {total} captures failed; look into them, then `gnmreg retry`")


async def _one(scope: "FlowScope", part: str, step: str, **arguments: Any) -> dict[str, Any]:
    """One job's result; the run is parked if it fails."""
    queue = GPU if step == table.END_ROUND else REBUILD
    identity = _named(f"{scope.id}/{part}", arguments)
    job = Job(id=identity, step=step, arguments=arguments, queue=queue, priority=STABILIZE_PRIORITY)
    done = await scope.run([job])
    if job.id not in done:
        failures = await scope.failures([job])
        raise scope.park(f"{part}: {failures.get(job.id, 'cancelled')}")
    result: dict[str, Any] = done[job.id]
    return result


def _named(identity: str, arguments: Mapping[str, Any]) -> str:
    """An id of these very arguments: a retried run may come here with others, and what is there is left as it is."""
    digest = hashlib.sha256(json.dumps(arguments, sort_keys=True).encode()).hexdigest()
    return f"{identity}-{digest[:8]}"


def _without(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key != name}


FLOWS: Mapping[str, Any] = {"batch": batch, "subject": subject, "coregister": coregister}
