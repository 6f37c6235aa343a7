"""The loop as a flow of jobs makes what the plain loop makes. Registrations are stand-ins, the other steps are real."""

import asyncio
import json
from pathlib import Path

import pytest

import workflows.farm_steps
from registration.errors import InputError
from tests.workflows.farm.test_flows import Inline
from tests.workflows.rounds import MODEL, Finds
from tests.workflows.test_coregistration import TWICE, dataset, finds, go, told  # noqa: F401
from workflows.coregistration import planned
from workflows.engine.database import default_url
from workflows.engine.durable import migrate
from workflows.engine.reads import Reader
from workflows.farm_coregistration import PLAN, put_coregistration
from workflows.flows import coregister
from workflows.jobs import STEPS, Job, checked, resolved_roots
from workflows.slot import function_of


def test_the_flow_makes_the_same_models(
    dataset: Path,  # noqa: F811
    finds: Finds,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workflows.farm_steps, "register", finds)
    go(dataset, tmp_path / "plain")
    url, out = default_url(tmp_path), tmp_path / "farm"
    plan = planned(dataset, model_path=MODEL, out=out, rule=TWICE, components=(2,), samples=2)
    with pytest.raises(InputError, match="There is no queue"):
        put_coregistration(url, plan)
    migrate(url)
    assert put_coregistration(url, plan) == "farm"
    row = Reader(url).rows(["farm"])["farm"]
    assert (row.state, row.spec) == (
        "waiting",
        {"flow": "coregister", "arguments": {"plan": str(out / PLAN), "variant": "llvm"}},
    )
    roots = resolved_roots((tmp_path, MODEL.parent))

    def step(job: Job) -> object:
        taken, arguments = checked(json.loads(json.dumps(job.spec())), STEPS, roots)
        return json.loads(json.dumps(function_of(taken.function)(**arguments)))

    scope = Inline("farm", step, [])
    result = asyncio.run(coregister(scope, **row.spec["arguments"]))  # type: ignore[arg-type]
    plain, farmed = told(tmp_path / "plain"), told(out)
    assert result["rounds"] == 2 and result["reason"] == farmed["verdict"]["reason"]
    for name in ("generalization_mm", "sources", "verdict", "at"):
        assert farmed[name] == plain[name]
    for one, other in zip(farmed["rounds"], plain["rounds"], strict=True):
        assert one["build"]["content_id"] == other["build"]["content_id"]
        assert one["register"] == other["register"] and one["decide"] == other["decide"]
    again = Inline("farm", step, [])
    asyncio.run(coregister(again, **row.spec["arguments"]))  # type: ignore[arg-type]
    assert [job.id for job in again.log] == [job.id for job in scope.log]
