"""Round after round on disk, without a queue. The registrations are stand-ins, all else is real."""

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
from tests.workflows.farm.inline import Inline, really
from tests.workflows.rounds import ACTS, MODEL, Finds, head, world, write_people, write_person
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
def finds(monkeypatch) -> Finds:
    """Registrations that find the truth, in this process; and no pictures, which other tests look at."""
    found = Finds()
    monkeypatch.setattr(workflows.steps.subject, "register", found)
    monkeypatch.setattr(workflows.steps.subject, "thumbnail", lambda registration: None)
    monkeypatch.setattr(workflows.steps.register, "register", found)
    monkeypatch.setattr(workflows.steps.evaluate, "write_evaluate_page", lambda *a: "<html></html>")
    monkeypatch.setattr(workflows.steps.stabilize, "write_stabilize_page", lambda *a: "<html></html>")
    monkeypatch.setattr(workflows.pages.coregistration, "number_curves", lambda *a: "<svg></svg>")
    monkeypatch.setattr(model, "number_curves", lambda *a: "<svg></svg>")
    monkeypatch.setattr(model, "heat_images", lambda *a, **k: [])
    return found


@pytest.fixture
def dataset(capture: Path, tmp_path: Path) -> Path:
    """Three subjects to build from and two that are held out, each with a smile."""
    return write_people(capture, tmp_path / "dataset", 5)


def go(dataset: Path, out: Path, **options) -> dict:
    first, registration = options.pop("model", MODEL), options.pop("options", RegisterOptions())
    rounds = RoundSettings(**{"rule": TWICE, "components": (2,), "samples": 2, **options})
    plan = start_coregistration(make_plan(dataset, first, out, registration, rounds))
    scope = Inline("run", really((dataset, MODEL.parent, out)), [])
    asyncio.run(coregister(scope, plan=str(plan)))
    return told(out)


def told(out: Path) -> dict:
    return json.loads((out / "coregistration.json").read_text())


def written(out: Path) -> dict[Path, int]:
    """When each product was written."""
    names = ("manifest.json", "gnm_head.npz", "registration.npz", "people.npz", "step.json")
    return {path: path.stat().st_mtime_ns for name in names for path in out.rglob(name)}


def test_two_rounds_without_those_who_are_held_out(dataset, finds, tmp_path):
    out = tmp_path / "out"
    record = go(dataset, out)
    assert [path.relative_to(out).parts[:2] for path in finds.made] == 6 * [("it00", "registrations")] + 6 * [
        ("it01", "registrations")
    ]
    assert {path.name for path in out.iterdir()} == {
        *("coregistration.json", "plan.json", "index.html"),
        *("held_out", "it00", "it01"),
    }
    assert {path.name for path in (out / "it00").iterdir()} == {"registrations", "model", "evaluation"}
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
        assert [one["subject"] for one in manifest["subjects"]] == ["p0", "p1", "p2"]
        assert not any(name.startswith(("p3", "p4")) for name in manifest["inputs"])
        assert not {"held_out", "category"} & set(manifest["demographics"])
    assert {path.parts[-2] for path in finds.made} == {"p0", "p1", "p2"}
    one = json.loads((out / "it01/registrations/p0/subject.json").read_text())
    assert one["model"] == first["content_id"]
    page = (out / "index.html").read_text()
    for text in ("it00/model/index.html", "it01/evaluation/index.html", "true meshes", "all 2 rounds done"):
        assert text in page
    assert record["rounds"][0]["decide"]["registered"] == 6 and record["rounds"][0]["decide"]["failed"] == 0


def own_recipe() -> ModelRecipe:
    recipe = true_meshes()
    return replace(recipe, name="own_recipe", identity=replace(recipe.identity, mirrored=False))


def test_python_builds_the_same_model_from_the_same_registrations(dataset, finds, tmp_path):
    """`build_model` without a recipe, the step of `gnmreg coregister` without one, and each with the same one."""
    data, found = gnm_npz.read(MODEL), read_dataset(dataset)
    contents = {}
    for name in (DEFAULT_MODEL_RECIPE, "true_meshes", f"{__name__}:own_recipe"):
        out = tmp_path / name.rpartition(":")[2]
        record = go(dataset, out, rule=StoppingRule(max_rounds=1), model_recipe=name)
        run = out / "it00" / "registrations"
        names = record["plan"]["split"]["training"]
        tags = {subject: found.tags(subject) for subject in names}
        subjects = RegisteredSubjects(run=run, names=names, model=data, steady=run / "stabilized", tags=tags)
        recipe = None if name == DEFAULT_MODEL_RECIPE else load_model_recipe(name)
        built = build_model(subjects, data, recipe, categories=found.categories)
        manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
        assert built.manifest == manifest and manifest["content_id"] == record["rounds"][0]["build"]["content_id"]
        assert manifest["config"]["name"] == out.name
        contents[name] = manifest["content_id"]
    assert len(set(contents.values())) == 3


@pytest.mark.parametrize("where", ["registering", "building", "evaluating"])
def test_a_killed_loop_goes_on_without_computing_anything_twice(dataset, finds, tmp_path, monkeypatch, where):
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
        finds.outcomes["p1/smile"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        go(dataset, out)
    assert told(out)["kind"] == "gnm-coregistration" and not list(out.rglob("*.tmp"))
    before, made = written(out), len(finds.made)
    assert before and made
    finds.outcomes.clear()
    go(dataset, out)
    after = written(out)
    assert {path: after[path] for path in before} == before
    assert len(finds.made) == 12 == len(set(finds.made))
    whole = go(dataset, tmp_path / "whole")
    for number, one in enumerate(whole["rounds"]):
        again = told(out)["rounds"][number]
        assert again["build"]["content_id"] == one["build"]["content_id"]
        assert again["evaluate"]["generalization_mm"] == one["evaluate"]["generalization_mm"]
    count = len(built)
    last = written(out)
    go(dataset, out)
    assert len(built) == count and written(out) == last


def test_a_folder_that_was_moved_is_as_good(dataset, finds, tmp_path):
    go(dataset, tmp_path / "out")
    made, elsewhere = len(finds.made), tmp_path / "elsewhere" / "out"
    elsewhere.parent.mkdir()
    (tmp_path / "out").rename(elsewhere)
    before = written(elsewhere)
    record = go(dataset, elsewhere)
    assert len(finds.made) == made and written(elsewhere) == before
    assert record["verdict"]["reason"] == "all 2 rounds done"
    assert str(tmp_path / "out") not in (elsewhere / "coregistration.json").read_text()


def test_one_failing_capture_does_not_stop_the_rest(dataset, finds, tmp_path):
    finds.outcomes = {"p0/smile": RuntimeError("out of luck"), "p1/neutral": ValueError("odd")}
    write_person(dataset / "p0" / "neutral", dataset / "p5", 5)
    with pytest.raises(JobFailed, match="it00: 3 of 8 captures failed"):
        go(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    state = go(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1, max_failure_rate=0.5))
    assert len(finds.made) == 5  # p0's neutral, and both of p2 and p5
    manifest = json.loads((tmp_path / "out/it00/model/gnm_head.manifest.json").read_text())
    assert [one["subject"] for one in manifest["subjects"]] == ["p0", "p2", "p5"]
    assert state["rounds"][0]["decide"]["failed"] == 3 and state["rounds"][0]["decide"]["registered"] == 5
    page = (tmp_path / "out/index.html").read_text()
    assert "out of luck" in page and "p1, neutral" in page


def test_a_spoiled_registration_is_named(capture, finds, tmp_path):
    dataset = write_people(capture, tmp_path / "dataset", 9, acts=())
    rough = np.random.default_rng(0).normal(0, 8e-3, (1163, 3))
    finds.outcomes["p2/neutral"] = lambda vertices: vertices + rough
    state = go(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    (rejected,) = state["rounds"][0]["build"]["rejected"]
    assert rejected["name"] == "p2" and state["rounds"][0]["decide"]["failed"] == 1
    for page in ("it00/model/index.html", "index.html"):
        text = (tmp_path / "out" / page).read_text()
        assert "p2" in text and rejected["reason"].split(" mm")[0] in text


def test_neutrals_alone_will_do_and_bare_captures_are_measured_by_registrations(capture, finds, tmp_path):
    dataset = write_people(capture, tmp_path / "dataset", 5, acts=())
    (dataset / "p4" / "neutral" / "ground_truth.npz").unlink()
    finds.outcomes["p4/neutral"] = lambda vertices: vertices
    real = finds.__class__.__call__
    np.savez(tmp_path / "truth.npz", vertices=head(gnm_npz.read(MODEL), 4))

    def with_truth(self, capture, *arguments, **options):
        if "p4" in capture.parts:
            shutil.copy(tmp_path / "truth.npz", capture / "ground_truth.npz")
        try:
            return real(self, capture, *arguments, **options)
        finally:
            if "p4" in capture.parts:
                (capture / "ground_truth.npz").unlink()

    finds.__class__ = type("Bare", (Finds,), {"__call__": with_truth})
    state = go(dataset, tmp_path / "out", rule=StoppingRule(max_rounds=1))
    assert state["sources"] == {"p3": "true meshes", "p4": "registrations"}
    assert state["rounds"][0]["stabilize"]["out"] is None
    manifest = json.loads((tmp_path / "out/it00/model/gnm_head.manifest.json").read_text())
    assert "previous" in manifest["expression"]


def test_expressions_reach_the_builder_in_the_neutrals_own_frame(dataset, finds, tmp_path):
    """Captures turn heads at will; the builder gets the displacement on the unposed neutral, and its confidence."""
    run, data = tmp_path / "run", gnm_npz.read(MODEL)
    for name in ("p0", "p1"):
        workflows.steps.subject.collect_subject(subject_dir=str(dataset / name), model=str(MODEL), out=str(run / name))
    still = workflows.steps.stabilize.stabilize_subjects(
        run=str(run), names=["p0", "p1"], model=str(MODEL), out=str(run / "stabilized")
    )
    subjects = list(RegisteredSubjects(run=run, names=["p0", "p1"], model=data, steady=Path(still["out"])))
    assert [subject.name for subject in subjects] == ["p0", "p1"]
    for seed, subject in enumerate(subjects):
        assert subject.neutral is not None
        np.testing.assert_allclose(subject.neutral.vertices, head(data, seed), atol=1e-6)
        (smile,) = subject.expressions
        moved = 1e3 * (smile.vertices - subject.neutral.vertices - data.expression_basis[ACTS["smile"]])
        assert np.sqrt((moved**2).sum(1).mean()) < 0.3  # what stabilization makes of a tiny skull
        assert (smile.label, smile.confidence[0]) == ("smile", 0.5)
        turn, _ = world(seed, "neutral")
        assert np.abs(turn - np.eye(3)).max() > 0.02


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
    ("spoil", "what"),
    [
        (empty, "no subjects"),
        (without_neutral, "no neutral"),
        (twice, "same subject"),
        (another_label, "label is unknown"),
        (incomplete, "incomplete"),
        (all_tagged, "too few subjects to build a model from"),
    ],
)
def test_datasets_that_cannot_be_used_are_refused(dataset, finds, tmp_path, spoil, what):
    spoil(dataset)
    with pytest.raises(InputError) as error:
        go(dataset, tmp_path / "out")
    assert what in error.value.what and not finds.made and not (tmp_path / "out").exists()


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
def test_settings_that_cannot_be_used_are_refused(dataset, finds, tmp_path, options, what):
    with pytest.raises(InputError) as error:
        go(dataset, tmp_path / "out", **options)
    assert what in error.value.what and not finds.made and not (tmp_path / "out").exists()


def test_a_foreign_folder_is_refused(dataset, finds, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="cannot be used"):
        go(dataset, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset", "notes.txt"]


def test_who_is_held_out(dataset, tmp_path):
    found = read_dataset(dataset)
    assert split(found).held_out == ("p3", "p4") and split(found).how == "by the tag held_out"
    (tmp_path / "list.txt").write_text("p1\n\np0\n")
    assert split(found, tmp_path / "list.txt").held_out == ("p0", "p1")
    one, two = (split(found, 0.4, seed) for seed in (0, 1))
    assert split(found, 0.4, 0) == one and len(one.held_out) == len(two.held_out) == 2
    assert set(one.training) | set(one.held_out) == set(found.subjects)
    assert len({split(found, 0.4, seed).held_out for seed in range(6)}) > 1
    (tmp_path / "list.txt").write_text("p1\nnobody\n")
    with pytest.raises(InputError, match="no such subject"):
        split(found, tmp_path / "list.txt")


def test_the_command(dataset, finds, tmp_path, capsys, monkeypatch):
    """Processes have stand-ins too, which do the queue's one flow here; `make demo-batch` starts them."""
    monkeypatch.setattr(workflows.farm.plan, "RoundSettings", partial(RoundSettings, samples=2))
    out, roots = tmp_path / "out", (dataset, MODEL.parent, tmp_path / "out")
    arguments = ["coregister", str(dataset), "--model", str(MODEL), "--out", str(out), "--components", "2"]
    assert main([*arguments, "--folder", str(tmp_path)]) == 2
    assert "There is no queue" in capsys.readouterr().err and not out.exists()

    def run(farm: LocalFarm, name: str, progress) -> LocalRunResult:
        spec = QueueReader(farm.url).rows([name])[name].spec
        try:
            asyncio.run(coregister(Inline(name, really(roots), []), **spec["arguments"]))
        except JobFailed as error:
            return LocalRunResult(counts={}, reason=str(error))
        return LocalRunResult(counts={})

    monkeypatch.setattr(workflows.farm.coregistration, "run_until_done", run)
    local = [*arguments, "--local", "--iterations", "1", "--held-out", "0.4"]
    for _ in range(2):
        assert main(local) == 0
        shown = capsys.readouterr().out
        assert "model 1, 2 components: generalization" in shown and str(out / "index.html") in shown
    assert told(out)["plan"]["split"]["how"] == "a fraction of 0.4 by seed 0" and len(finds.made) == 6
    finds.outcomes["p0/neutral"] = finds.outcomes["p1/neutral"] = ValueError("odd")
    assert main([*local, "--seed", "1"]) == 1
    assert "captures failed; inspect them" in capsys.readouterr().out
