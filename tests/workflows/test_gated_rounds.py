"""The quality gate in rounds of coregistration: which registrations models are built from."""

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import pytest

from registration.options import RegisterOptions
from registration.storage.registration_folder import read_manifest
from tests.workflows import test_coregistration
from tests.workflows.farm.inline import Inline, run_step
from tests.workflows.rounds import MODEL
from tests.workflows.test_coregistration import TWICE, run_rounds
from workflows.engine.serialization import JobFailed
from workflows.farm.coregistration import start_coregistration
from workflows.farm.flows import coregister
from workflows.farm.plan import RoundSettings, make_plan
from workflows.gate.decisions import DecisionLog, Ruling
from workflows.gate.rules import GateThresholds, Limit

dataset, true_register = test_coregistration.dataset, test_coregistration.true_register  # fixtures


def decided(out: Path, log: DecisionLog, name: str, decision: str) -> None:
    """Record a decision about a registration of the first round."""
    manifest = read_manifest(out / "it00" / "registrations" / name)
    fields = {"reason": "seen", "who": "eve", "thresholds": "t", "verdict": "look"}
    log.append(Ruling(content_id=manifest.content_id, name=name, decision=decision, **fields))


def test_models_are_built_from_accepted_registrations_only(dataset, true_register, tmp_path):
    """What the rules reject, and what a person rejects, is in no model; without a neutral no expression is."""
    out, log = tmp_path / "out", DecisionLog.of_farm(tmp_path / "farm")
    limits = GateThresholds(motion_mm=Limit(look=None, reject=1.0), sample_share=0.0)
    settings = {"rule": replace(TWICE, max_rounds=1), "gate_thresholds": limits, "decisions": log.folder}
    true_register.figures["p1/smile"] = {"motion_mm": 2.0}
    record = run_rounds(dataset, out, **settings)
    manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
    assert manifest["gate"]["verdicts"] == {"accept": 0, "look": 5, "reject": 1} and manifest["gate"]["accepted"] == 5
    assert list(manifest["gate"]["left_out"]) == ["p1/smile"]
    assert manifest["gate"]["left_out"]["p1/smile"].startswith("motion at the end 2.000 mm (limit 1.000 mm)")
    assert manifest["gate"]["thresholds"] == limits.content_id and manifest["gate"]["waiting"] == 5
    assert {s["subject"]: s["expressions"] for s in manifest["subjects"]} == {"p0": 1, "p1": 0, "p2": 1}
    assert "p1/smile" not in manifest["inputs"] and record["rounds"][0]["decide"]["failed"] == 1
    assert record["rounds"][0]["gate"]["left_out_count"] == 1
    assert "p1/smile" in (out / "it00/gate/verdicts.csv").read_text()
    first = manifest["content_id"]
    for name, decision in (("p1/smile", "accept"), ("p0/neutral", "reject")):
        decided(out, log, name, decision)
    run_rounds(dataset, out, **settings)
    manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
    gate = manifest["gate"]
    assert gate["left_out"] == {"p0/neutral": "eve: seen", "p0/smile": "its neutral is left out"}
    assert [(d["name"], d["decision"], d["who"]) for d in gate["decisions"]] == [
        ("p0/neutral", "reject", "eve"),
        ("p1/smile", "accept", "eve"),
    ]
    assert gate["log_head"] == log.head.sha256 and manifest["content_id"] != first
    assert [subject["subject"] for subject in manifest["subjects"]] == ["p1", "p2"]
    page = (out / "it00/model/index.html").read_text()
    assert "its neutral is left out" in page and "decided by a person" in page
    assert "left out by the gate" in (out / "index.html").read_text()


def test_a_run_waits_for_a_person_and_continues_when_all_is_decided(dataset, true_register, tmp_path):
    out, log = tmp_path / "out", DecisionLog.of_farm(tmp_path / "farm")
    settings = {"rule": replace(TWICE, max_rounds=1), "gate": "person", "decisions": log.folder}
    with pytest.raises(JobFailed, match="parked: it00/gate: .*6 registrations wait for a person"):
        run_rounds(dataset, out, **settings)
    names = [f"p{k}/{name}" for k in range(3) for name in ("neutral", "smile")]
    for name in names[:-1]:
        decided(out, log, name, "accept")
    with pytest.raises(JobFailed, match="1 registration waits for a person"):
        run_rounds(dataset, out, **settings)
    assert not (out / "it00" / "model").exists()
    decided(out, log, names[-1], "reject")
    run_rounds(dataset, out, **settings)
    gate = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())["gate"]
    assert gate["policy"] == "person" and gate["waiting"] == 0 and list(gate["left_out"]) == [names[-1]]


def test_a_plan_without_a_gate_uses_all_usable_registrations(dataset, true_register, tmp_path):
    out = tmp_path / "out"
    rounds = RoundSettings(rule=replace(TWICE, max_rounds=1), components=(2,), samples=2)
    plan = replace(make_plan(dataset, MODEL, out, RegisterOptions(), rounds), gate=None)
    true_register.figures["p1/smile"] = {"motion_mm": 2.0}
    scope = Inline("run", run_step((dataset, MODEL.parent, out)), [])
    asyncio.run(coregister(scope, plan=str(start_coregistration(plan))))
    manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
    assert "gate" not in manifest and [s["expressions"] for s in manifest["subjects"]] == [1, 1, 1]
    assert [job.step for job in scope.log if job.step == "gate"] == []
