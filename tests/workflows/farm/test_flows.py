"""The order of jobs in flows; a stand-in returns fixed results for the steps."""

import asyncio
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from coregister.next_model.recipes import few_registrations
from coregister.stopping_rule import StoppingRule
from registration.errors import InputError
from registration.options import RegisterOptions
from tests.workflows.farm.inline import Inline
from workflows.engine.jobs import Job
from workflows.engine.scope import _read as read_plan
from workflows.engine.serialization import JobFailed
from workflows.farm.flows import coregister, subject
from workflows.records.coregistration import CoregistrationPlan, GateSettings
from workflows.records.dataset import Split
from workflows.records.step_results import BuildResult, EvaluateResult, GateResult


def failed(reason: str) -> JobFailed:
    return JobFailed({"status": "failed", "reason": reason})


def run_subject(step: Callable[[Job], Any]) -> tuple[dict[str, Any], list[Job]]:
    scope = Inline("r/s1", step, [])
    arguments = {
        "subject_dir": "/c/ann",
        "captures": ["rest", "smile", "jaw"],
        "model": "/m",
        "out": "/o/ann",
        "options": {"recipe": "draft", "seed": 1, "variant": "cuda"},
    }
    return asyncio.run(subject(scope, **arguments)), scope.log  # type: ignore[arg-type]


def test_a_subject_registers_its_neutral_then_expressions_then_collects() -> None:
    result, log = run_subject(lambda job: {})
    assert result == {"usable": 3, "failed": 0}
    assert [(j.step, j.priority) for j in log] == [("register", 5), ("register", 10), ("register", 10), ("collect", 3)]
    assert [j.id for j in log[:3]] == ["r/s1/neutral-rest", "r/s1/e001-smile", "r/s1/e002-jaw"]
    assert [j.arguments.get("neutral") for j in log[:3]] == [None, "/o/ann/rest", "/o/ann/rest"]
    assert log[1].arguments["capture"] == "/c/ann/smile" and log[1].arguments["out"] == "/o/ann/smile"
    assert log[3].arguments["leave"] == {}
    assert all(job.arguments["options"] == {"recipe": "draft", "seed": 1, "variant": "cuda"} for job in log)


def test_a_failed_expression_does_not_stop_the_others() -> None:
    def step(job: Job) -> dict[str, Any]:
        if "/e001-" in job.id:
            raise failed("broken")
        return {}

    result, log = run_subject(step)
    assert result == {"usable": 2, "failed": 1}
    assert log[-1].step == "collect" and log[-1].arguments["leave"] == {"smile": "failed: broken"}


def test_without_a_neutral_nothing_else_is_registered() -> None:
    def step(job: Job) -> dict[str, Any]:
        if "/neutral-" in job.id:
            raise failed("broken")
        return {}

    result, log = run_subject(step)
    assert result == {"usable": 0, "failed": 3}
    assert [job.step for job in log] == ["register", "collect"]
    assert set(log[-1].arguments["leave"]) == {"rest", "smile", "jaw"}


class Rounds:
    """Results of the steps of a coregistration; `proceed` says for each round whether another round follows."""

    def __init__(self, proceed: Sequence[bool], broken: Sequence[str] = ()) -> None:
        self.proceed, self.broken = list(proceed), broken

    def __call__(self, job: Job) -> dict[str, Any]:
        if any(part in job.id for part in self.broken):
            raise failed("broken")
        if job.step == "hold out":
            return {"input_hash": "h", "file": "/o/held_out.npz", "sources": {}, "lost": []}
        if job.step == "gate":
            verdicts = {"accept": 7, "look": 1, "reject": 0}
            shared = {"policy": "auto", "thresholds": "t", "thresholds_name": "default", "verdicts": verdicts}
            return GateResult(**shared, accepted=8, accepted_id="s", waiting=1).to_json()
        if job.step == "stabilize":
            return {"out": job.arguments["out"]}
        if job.step == "build":
            model = f"{job.arguments['out']}/gnm_head.npz"
            return BuildResult(
                input_hash="h", model=model, content_id="c", registered=8, rejected=(), components=2, drift_mm=0.1
            ).to_json()
        if job.step == "evaluate":
            return EvaluateResult(
                input_hash="h", out="/o", components=(2,), at=2, generalization_mm={}, specificity_mm={}
            ).to_json()
        if job.step == "end round":
            return {"proceed": self.proceed[len(job.arguments["rounds"]) - 1], "reason": "no gain"}
        return {}


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    names = [f"p{n}" for n in range(5)]
    plan = CoregistrationPlan(
        dataset=Path("/d"),
        model=Path("/m0"),
        out=Path("/o"),
        options=RegisterOptions(),
        model_recipe=few_registrations(),
        components=(2,),
        samples=0,
        rule=StoppingRule(max_rounds=3, max_failure_rate=0.2),
        split=Split(training=tuple(names[:4]), held_out=tuple(names[4:]), how=""),
        captures={name: ("rest", "smile") for name in names},
        without_truth=tuple(names[4:]),
    )
    plan.write(tmp_path / "plan.json")
    return tmp_path / "plan.json"


def run_loop(plan: Path, rounds: Rounds, name: str = "/o/plan.json") -> tuple[dict[str, Any], list[Job]]:
    """Run the flow with the plan's content at another path, that of its output folder."""
    scope = Inline("r", rounds, [])

    async def read(_: str) -> Any:
        return json.loads(plan.read_text())

    scope.read = read  # type: ignore[method-assign]
    return asyncio.run(coregister(scope, plan=name)), scope.log  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["/etc/passwd", "plan.json", "/other/plan.json", "/o/x/plan.json"])
def test_a_plan_of_another_place_is_refused(plan: Path, name: str) -> None:
    with pytest.raises(JobFailed, match="parked: (no path of a plan.json|the plan is that of another folder)"):
        run_loop(plan, Rounds([True]), name)


def test_each_round_uses_the_previous_model_until_the_verdict_stops(plan: Path) -> None:
    result, log = run_loop(plan, Rounds([True, False]))
    assert result == {"rounds": 2, "model": "/o/it01/model/gnm_head.npz", "reason": "no gain"}
    steps = [job.step for job in log if job.step not in ("register", "collect")]
    assert steps == ["hold out", *["stabilize", "build", "evaluate", "end round"] * 2]
    registered = [job for job in log if job.step == "register"]
    assert len(registered) == 2 + 2 * 8  # the held-out subject without a ground truth, then four subjects twice
    models = {job.id.split("/")[1]: job.arguments["model"] for job in registered}
    assert models == {"held": "/m0", "it00": "/m0", "it01": "/o/it00/model/gnm_head.npz"}
    assert log[-2].arguments["models"]["model 2"] == "/o/it01/model/gnm_head.npz"


def test_the_gate_is_asked_before_anything_is_made_of_the_registrations(plan: Path) -> None:
    settings = GateSettings(policy="person", thresholds={"name": "x"}, decisions=Path("/o.farm/gate"))
    replace(CoregistrationPlan.read(plan), gate=settings).write(plan)
    _, log = run_loop(plan, Rounds([False]))
    steps = [job for job in log if job.step not in ("register", "collect")]
    assert [job.step for job in steps] == ["hold out", "gate", "stabilize", "build", "evaluate", "end round"]
    gate, *used = steps[1:4]
    assert gate.arguments["policy"] == "person" and gate.arguments["decisions"] == "/o.farm/gate"
    assert used[0].arguments["gate"] == used[1].arguments["made"]["gate"] == "/o/it00/gate"
    assert used[1].arguments["made"]["stabilized"] == "/o/it00/registrations/stabilized"
    with pytest.raises(JobFailed, match="parked: it00/gate: failed: broken"):
        run_loop(plan, Rounds([True], broken=("it00/gate",)))


def test_too_many_failures_park_the_run_before_a_model_is_built(plan: Path) -> None:
    with pytest.raises(JobFailed, match="parked: it00: 2 of 8 captures failed"):
        run_loop(plan, Rounds([True], broken=("it00/s00001-p1/neutral",)))


def test_few_failures_do_not_park_the_run(plan: Path) -> None:
    result, _ = run_loop(plan, Rounds([False], broken=("it00/s00001-p1/e001",)))
    assert result["rounds"] == 1


def test_a_failed_step_parks_the_run_and_is_named(plan: Path) -> None:
    with pytest.raises(JobFailed, match="parked: it01/build: failed: broken"):
        run_loop(plan, Rounds([True, True], broken=("it01/build",)))


def test_different_arguments_give_a_different_job_id(plan: Path) -> None:
    _, first = run_loop(plan, Rounds([False]))
    _, second = run_loop(plan, Rounds([False], broken=("it00/s00001-p1/e001",)))
    ids = [{job.id for job in log if "/collect" in job.id} for log in (first, second)]
    assert len(ids[0] - ids[1]) == 1 and len(ids[0] & ids[1]) == 4


@pytest.mark.parametrize("file", ["/dev/zero", "/proc/self", "/none"])
def test_a_flow_reads_ordinary_files_only(file: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        asyncio.run(read_plan(file))


def test_only_the_first_round_regenerates_anatomy(plan: Path) -> None:
    kept = run_loop(plan, Rounds([True, True, False]))[1]
    assert not any("anatomy" in job.arguments["recipe"] for job in kept if job.step == "build")
    changed = replace(CoregistrationPlan.read(plan), anatomy=("eyes", "pupils"))
    changed.write(plan)
    builds = [job for job in run_loop(plan, Rounds([True, True, False]))[1] if job.step == "build"]
    assert [job.arguments["recipe"].get("anatomy") for job in builds] == [
        {"parts": ["eyes", "pupils"], "seed": changed.seed},
        None,
        None,
    ]
