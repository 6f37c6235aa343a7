"""Rounds of coregistration on disk, without a queue. Only the registrations are stand-ins."""

import asyncio
import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import workflows.farm.coregistration
import workflows.farm.plan
import workflows.pages.coregistration
import workflows.steps.build
import workflows.steps.evaluate
import workflows.steps.register
import workflows.steps.stabilize
import workflows.steps.subject
from coregister.next_model.build import build_model
from coregister.next_model.recipes import DEFAULT_MODEL_RECIPE, ModelRecipe, load_model_recipe, true_meshes
from coregister.stopping_rule import StoppingRule
from registration.errors import InputError
from registration.model import gnm_npz
from registration.options import RegisterOptions
from tests.workflows.conftest import change
from tests.workflows.farm.inline import Inline, run_step
from tests.workflows.rounds import ACTS, MODEL, TrueRegister, head, head_pose, write_people, write_person
from workflows.cli.app import main
from workflows.engine.reader import QueueReader
from workflows.engine.serialization import JobFailed
from workflows.farm.coregistration import start_coregistration
from workflows.farm.flows import coregister
from workflows.farm.local import LocalFarm, LocalRunResult
from workflows.farm.plan import RoundSettings, make_plan
from workflows.pages import model
from workflows.records.dataset import read_dataset, split
from workflows.records.training_subjects import RegisteredSubjects

TWICE = StoppingRule(max_rounds=2, max_failure_rate=1.0, early_stopping=False)


@pytest.fixture
def true_register(monkeypatch) -> TrueRegister:
    """Registrations that return the truth, in this process; figures and images, tested elsewhere, are omitted."""
    register = TrueRegister()
    monkeypatch.setattr(workflows.steps.subject, "register", register)
    monkeypatch.setattr(workflows.steps.subject, "thumbnail", lambda registration: None)
    monkeypatch.setattr(workflows.steps.register, "register", register)
    monkeypatch.setattr(workflows.steps.evaluate, "render_evaluation_page", lambda *a: "<html></html>")
    monkeypatch.setattr(workflows.steps.stabilize, "render_stabilization_page", lambda *a: "<html></html>")
    monkeypatch.setattr(workflows.pages.coregistration, "line_charts", lambda *a: "<svg></svg>")
    monkeypatch.setattr(model, "line_charts", lambda *a: "<svg></svg>")
    monkeypatch.setattr(model, "heat_images", lambda *a, **k: [])
    return register


@pytest.fixture
def dataset(capture: Path, tmp_path: Path) -> Path:
    """Three training subjects and two held-out subjects, each with a smile."""
    return write_people(capture, tmp_path / "dataset", 5)


def run_rounds(dataset: Path, out: Path, **options) -> dict:
    first, registration = options.pop("model", MODEL), options.pop("options", RegisterOptions())
    rounds = RoundSettings(**{"rule": TWICE, "components": (2,), "samples": 2, **options})
    plan = start_coregistration(make_plan(dataset, first, out, registration, rounds))
    roots = (dataset, MODEL.parent, out, *([options["decisions"]] if "decisions" in options else []))
    scope = Inline("run", run_step(roots), [])
    asyncio.run(coregister(scope, plan=str(plan)))
    return read_record(out)


def read_record(out: Path) -> dict:
    return json.loads((out / "coregistration.json").read_text())


def write_times(out: Path) -> dict[Path, int]:
    """Return the time at which each product was written."""
    names = ("manifest.json", "gnm_head.npz", "registration.npz", "held_out.npz", "step.json")
    return {path: path.stat().st_mtime_ns for name in names for path in out.rglob(name)}


def test_two_rounds_build_models_without_held_out_subjects(dataset, true_register, tmp_path):
    out = tmp_path / "out"
    record = run_rounds(dataset, out)
    assert [path.relative_to(out).parts[:2] for path in true_register.outputs] == 6 * [
        ("it00", "registrations")
    ] + 6 * [("it01", "registrations")]
    assert {path.name for path in out.iterdir()} == {
        *("coregistration.json", "plan.json", "index.html"),
        *("held_out", "it00", "it01"),
    }
    assert {path.name for path in (out / "it00").iterdir()} == {*("registrations", "gate", "model", "evaluation")}
    assert {path.name for path in (out / "it00" / "model").iterdir()} == {
        *("gnm_head.npz", "gnm_head.manifest.json", "gnm_head.expressions.npz", "head_sparse_68.txt"),
        *("index.html", "step.json"),
    }
    assert record["verdict"] == {"proceed": False, "reason": "all 2 rounds done"}
    assert list(record["models"]) == list(record["generalization_mm"]) == ["model 0", "model 1", "model 2"]
    assert record["sources"] == {"p3": "true meshes", "p4": "true meshes"} and record["at"] == 2
    first, last = (json.loads((out / f"it0{k}/model/gnm_head.manifest.json").read_text()) for k in range(2))
    assert first["inputs"]["previous"] == gnm_npz.content_hash(gnm_npz.read(MODEL))
    assert last["inputs"]["previous"] == first["content_id"]  # round n + 1 starts from model n
    for manifest in (first, last):  # held-out subjects enter no model
        assert [subject["subject"] for subject in manifest["subjects"]] == ["p0", "p1", "p2"]
        assert not any(name.startswith(("p3", "p4")) for name in manifest["inputs"])
        assert not {"held_out", "category"} & set(manifest["demographics"])
    assert {path.parts[-2] for path in true_register.outputs} == {"p0", "p1", "p2"}
    subject = json.loads((out / "it01/registrations/p0/subject.json").read_text())
    assert subject["model"] == first["content_id"]
    page = (out / "index.html").read_text()
    for text in ("it00/model/index.html", "it01/evaluation/index.html", "true meshes", "all 2 rounds done"):
        assert text in page
    assert record["rounds"][0]["decide"]["registered"] == 6 and record["rounds"][0]["decide"]["failed"] == 0


def own_recipe() -> ModelRecipe:
    recipe = true_meshes()
    return replace(recipe, name="own_recipe", identity=replace(recipe.identity, mirrored=False))


@pytest.mark.slow
def test_python_builds_the_same_model_from_the_same_registrations(dataset, true_register, tmp_path):
    """`build_model` without a recipe, the step of `gnmreg coregister` without one, and each with the same one."""
    data, parsed = gnm_npz.read(MODEL), read_dataset(dataset)
    contents = {}
    for name in (DEFAULT_MODEL_RECIPE, "true_meshes", f"{__name__}:own_recipe"):
        out = tmp_path / name.rpartition(":")[2]
        record = run_rounds(dataset, out, rule=StoppingRule(max_rounds=1), model_recipe=name)
        run = out / "it00" / "registrations"
        names = record["plan"]["split"]["training"]
        tags = {subject: parsed.tags(subject) for subject in names}
        subjects = RegisteredSubjects(run=run, names=names, model=data, stabilized_set=run / "stabilized", tags=tags)
        recipe = None if name == DEFAULT_MODEL_RECIPE else load_model_recipe(name)
        built = build_model(subjects, data, recipe, categories=parsed.categories)
        manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
        assert manifest.pop("gate")["left_out"] == {}
        assert built.manifest == manifest and manifest["content_id"] == record["rounds"][0]["build"]["content_id"]
        assert manifest["config"]["name"] == out.name
        contents[name] = manifest["content_id"]
    assert len(set(contents.values())) == 3


@pytest.mark.parametrize(
    "where", ["registering", *(pytest.param(place, marks=pytest.mark.slow) for place in ("building", "evaluating"))]
)
def test_an_interrupted_loop_resumes_without_recomputing(dataset, true_register, tmp_path, monkeypatch, where):
    out, built = tmp_path / "out", []
    real, evaluated = workflows.steps.build.build_model, workflows.steps.evaluate.evaluate_models

    def build(*arguments, **options):
        built.append(1)
        if where == "building" and len(built) == 2:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    def evaluate(*arguments, **options):
        if where == "evaluating" and len(built) == 2 and not stopped:
            stopped.append(1)
            raise KeyboardInterrupt
        return evaluated(*arguments, **options)

    stopped: list[int] = []
    monkeypatch.setattr(workflows.steps.build, "build_model", build)
    monkeypatch.setattr(workflows.steps.evaluate, "evaluate_models", evaluate)
    if where == "registering":
        true_register.outcomes["p1/smile"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run_rounds(dataset, out)
    assert read_record(out)["kind"] == "gnm-coregistration" and not list(out.rglob("*.tmp"))
    before, count = write_times(out), len(true_register.outputs)
    assert before and count
    true_register.outcomes.clear()
    run_rounds(dataset, out)
    after = write_times(out)
    assert {path: after[path] for path in before} == before
    assert len(true_register.outputs) == 12 == len(set(true_register.outputs))
    whole = run_rounds(dataset, tmp_path / "whole")
    for number, expected in enumerate(whole["rounds"]):
        again = read_record(out)["rounds"][number]
        assert again["build"]["content_id"] == expected["build"]["content_id"]
        assert again["evaluate"]["generalization_mm"] == expected["evaluate"]["generalization_mm"]
    count = len(built)
    last = write_times(out)
    run_rounds(dataset, out)
    assert len(built) == count and write_times(out) == last


def test_a_moved_folder_is_reused(dataset, true_register, tmp_path):
    run_rounds(dataset, tmp_path / "out")
    count, elsewhere = len(true_register.outputs), tmp_path / "elsewhere" / "out"
    elsewhere.parent.mkdir()
    (tmp_path / "out").rename(elsewhere)
    before = write_times(elsewhere)
    record = run_rounds(dataset, elsewhere)
    assert len(true_register.outputs) == count and write_times(elsewhere) == before
    assert record["verdict"]["reason"] == "all 2 rounds done"
    assert str(tmp_path / "out") not in (elsewhere / "coregistration.json").read_text()


def test_failed_captures_do_not_stop_the_rest(dataset, true_register, tmp_path):
    true_register.outcomes = {"p0/smile": RuntimeError("out of luck"), "p1/neutral": ValueError("odd")}
    write_person(dataset / "p0" / "neutral", dataset / "p5", 5)
    with pytest.raises(JobFailed, match="it00: 3 of 8 captures failed"):
        run_rounds(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    state = run_rounds(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1, max_failure_rate=0.5))
    assert len(true_register.outputs) == 5  # p0's neutral, and both of p2 and p5
    manifest = json.loads((tmp_path / "out/it00/model/gnm_head.manifest.json").read_text())
    assert [subject["subject"] for subject in manifest["subjects"]] == ["p0", "p2", "p5"]
    assert state["rounds"][0]["decide"]["failed"] == 3 and state["rounds"][0]["decide"]["registered"] == 5
    page = (tmp_path / "out/index.html").read_text()
    assert "out of luck" in page and "p1, neutral" in page


def test_an_outlier_registration_is_reported(capture, true_register, tmp_path):
    dataset = write_people(capture, tmp_path / "dataset", 9, acts=())
    rough = np.random.default_rng(0).normal(0, 8e-3, (1163, 3))
    true_register.outcomes["p2/neutral"] = lambda vertices: vertices + rough
    state = run_rounds(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    (rejected,) = state["rounds"][0]["build"]["rejected"]
    assert rejected["name"] == "p2" and state["rounds"][0]["decide"]["failed"] == 1
    for page in ("it00/model/index.html", "index.html"):
        text = (tmp_path / "out" / page).read_text()
        assert "p2" in text and rejected["reason"].split(" mm")[0] in text


def test_neutrals_suffice_and_registrations_replace_missing_truths(capture, true_register, tmp_path):
    dataset = write_people(capture, tmp_path / "dataset", 5, acts=())
    (dataset / "p4" / "neutral" / "ground_truth.npz").unlink()
    true_register.outcomes["p4/neutral"] = lambda vertices: vertices
    real = true_register.__class__.__call__
    np.savez(tmp_path / "truth.npz", vertices=head(gnm_npz.read(MODEL), 4))

    def with_truth(self, capture, *arguments, **options):
        if "p4" in capture.parts:
            shutil.copy(tmp_path / "truth.npz", capture / "ground_truth.npz")
        try:
            return real(self, capture, *arguments, **options)
        finally:
            if "p4" in capture.parts:
                (capture / "ground_truth.npz").unlink()

    true_register.__class__ = type("Bare", (TrueRegister,), {"__call__": with_truth})
    state = run_rounds(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    assert state["sources"] == {"p3": "true meshes", "p4": "registrations"}
    assert state["rounds"][0]["stabilize"]["out"] is None
    manifest = json.loads((tmp_path / "out/it00/model/gnm_head.manifest.json").read_text())
    assert "previous" in manifest["expression"]


def test_expressions_reach_the_builder_in_the_frame_of_the_neutral(dataset, true_register, tmp_path):
    """Heads are rotated in captures; the builder gets displacements of the unposed neutral, and their confidence."""
    run, data = tmp_path / "run", gnm_npz.read(MODEL)
    for name in ("p0", "p1"):
        workflows.steps.subject.collect_subject(subject_dir=str(dataset / name), model=str(MODEL), out=str(run / name))
    still = workflows.steps.stabilize.stabilize_subjects(
        run=str(run), names=["p0", "p1"], model=str(MODEL), out=str(run / "stabilized")
    )
    subjects = list(RegisteredSubjects(run=run, names=["p0", "p1"], model=data, stabilized_set=Path(still["out"])))
    assert [subject.name for subject in subjects] == ["p0", "p1"]
    for seed, subject in enumerate(subjects):
        assert subject.neutral is not None
        np.testing.assert_allclose(subject.neutral.vertices, head(data, seed), atol=1e-6)
        (smile,) = subject.expressions
        error_mm = 1e3 * (smile.vertices - subject.neutral.vertices - data.expression_basis[ACTS["smile"]])
        assert np.sqrt((error_mm**2).sum(1).mean()) < 0.3  # the accuracy of stabilization with a tiny cranium
        assert (smile.label, smile.confidence[0]) == ("smile", 0.5)
        rotation, _ = head_pose(seed, "neutral")
        assert np.abs(rotation - np.eye(3)).max() > 0.02


def twice(dataset: Path) -> None:
    shutil.copytree(dataset / "p0", dataset / "p9")


def without_neutral(dataset: Path) -> None:
    shutil.rmtree(dataset / "p1" / "neutral")


def another_label(dataset: Path) -> None:
    record = {"kind": "gnm-dataset", "schema": 1, "complete": True, "categories": {"jaw": "jaw"}}
    (dataset / "dataset.json").write_text(json.dumps(record))


def incomplete(dataset: Path) -> None:
    record = {"kind": "gnm-dataset", "schema": 1, "complete": False, "categories": {"smile": "flexing"}}
    (dataset / "dataset.json").write_text(json.dumps(record))


def empty(dataset: Path) -> None:
    shutil.rmtree(dataset)
    dataset.mkdir()


def all_tagged(dataset: Path) -> None:
    for name in ("p0", "p1"):
        change(dataset / name / "neutral", "age", "held_out = true\nage")


@pytest.mark.parametrize(
    ("modify", "what"),
    [
        (empty, "no subjects"),
        (without_neutral, "no neutral"),
        (twice, "same subject"),
        (another_label, "label is unknown"),
        (incomplete, "incomplete"),
        (all_tagged, "too few subjects to build a model from"),
    ],
)
def test_datasets_that_cannot_be_used_are_refused(dataset, true_register, tmp_path, modify, what):
    modify(dataset)
    with pytest.raises(InputError) as error:
        run_rounds(dataset, tmp_path / "out")
    assert what in error.value.what and not true_register.outputs and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"components": (2, 60)}, "too few subjects for so many components"),
        ({"components": (4, 2)}, "out of order"),
        ({"options": RegisterOptions(recipe="magic")}, ""),
        ({"model_recipe": "magic"}, "no such model recipe"),
        ({"model_recipe": "no_module:recipe"}, "no such model recipe"),
        ({"held_out": 1.5}, "fraction to hold out"),
        ({"held_out": 0.9}, "too few subjects to build"),
        ({"held_out": Path("nobody.txt")}, "cannot be read"),
        ({"rule": StoppingRule(max_rounds=0)}, "There is no round"),
        ({"model": Path("none.npz")}, ""),
    ],
)
def test_settings_that_cannot_be_used_are_refused(dataset, true_register, tmp_path, options, what):
    with pytest.raises(InputError) as error:
        run_rounds(dataset, tmp_path / "out", **options)
    assert what in error.value.what and not true_register.outputs and not (tmp_path / "out").exists()


def test_a_foreign_folder_is_refused(dataset, true_register, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="cannot be used"):
        run_rounds(dataset, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset", "notes.txt"]


def test_held_out_subjects_come_from_tags_a_list_or_a_fraction(dataset, tmp_path):
    parsed = read_dataset(dataset)
    assert split(parsed).held_out == ("p3", "p4") and split(parsed).how == "by the tag held_out"
    (tmp_path / "list.txt").write_text("p1\n\np0\n")
    assert split(parsed, tmp_path / "list.txt").held_out == ("p0", "p1")
    first, second = (split(parsed, 0.4, seed) for seed in (0, 1))
    assert split(parsed, 0.4, 0) == first and len(first.held_out) == len(second.held_out) == 2
    assert set(first.training) | set(first.held_out) == set(parsed.subjects)
    assert len({split(parsed, 0.4, seed).held_out for seed in range(6)}) > 1
    (tmp_path / "list.txt").write_text("p1\nnobody\n")
    with pytest.raises(InputError, match="no such subject"):
        split(parsed, tmp_path / "list.txt")


def test_the_command_resumes_and_reports_failures(dataset, true_register, tmp_path, capsys, monkeypatch):
    """The processes are stand-ins that run the flow here; `make demo-batch` starts real processes."""
    monkeypatch.setattr(workflows.farm.plan, "RoundSettings", partial(RoundSettings, samples=2))
    out = tmp_path / "out"
    roots = (dataset, MODEL.parent, out, tmp_path / "out.farm")
    arguments = f"coregister {dataset} --model {MODEL} --out {out} --anatomy keep --components 2".split()
    assert main([*arguments, "--folder", str(tmp_path)]) == 2
    assert "There is no queue" in capsys.readouterr().err and not out.exists()

    def run(farm: LocalFarm, name: str, progress) -> LocalRunResult:
        spec = QueueReader(farm.url).rows([name])[name].spec
        try:
            asyncio.run(coregister(Inline(name, run_step(roots), []), **spec["arguments"]))
        except JobFailed as error:
            return LocalRunResult(counts={}, reason=str(error))
        return LocalRunResult(counts={})

    monkeypatch.setattr(workflows.farm.coregistration, "run_until_done", run)
    local = [*arguments, "--local", "--iterations", "1", "--held-out", "0.4"]
    for _ in range(2):
        assert main(local) == 0
        shown = capsys.readouterr().out
        assert "model 1, 2 components: generalization" in shown and str(out / "index.html") in shown
    assert read_record(out)["plan"]["split"]["how"] == "a fraction of 0.4 by seed 0" and len(true_register.outputs) == 6
    true_register.outcomes["p0/neutral"] = true_register.outcomes["p1/neutral"] = ValueError("odd")
    assert main([*local, "--seed", "1"]) == 1
    assert "captures failed; inspect them" in capsys.readouterr().out
    assert "captures failed; inspect them" in read_record(out)["stopped"]
    assert "Stopped: parked: it00: " in (out / "index.html").read_text()

    def interrupted(*_: object) -> LocalRunResult:
        raise KeyboardInterrupt

    monkeypatch.setattr(workflows.farm.coregistration, "run_until_done", interrupted)
    assert main(local) == 130
    assert "Stopped: the command ended before the run" in (out / "index.html").read_text()
