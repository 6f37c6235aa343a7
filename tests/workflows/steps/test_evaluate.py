"""`gnmreg model evaluate`: inputs, the folder and page it writes, and what it refuses before any work."""

import json
from pathlib import Path

import numpy as np
import pytest

import workflows.steps.evaluate
from coregister.evaluate.evaluation import EvaluationSettings
from registration.errors import InputError
from registration.model import gnm_npz
from registration.stabilize import stabilized_folder as stabilized
from registration.stabilize.pipeline import StabilizedSubject
from tests.coregister.spectrum import heads, spectrum_model, with_identity
from tests.registration.capture import small
from tests.registration.stabilize.runs import write_subject
from workflows.cli.app import main
from workflows.records.held_out import read_held_out
from workflows.steps.evaluate import evaluate_models

SETTINGS = EvaluationSettings(components=(2, 4), samples=3, draws=200)
NAMES = ("anna", "ben", "cleo")
LABELS = ("neutral", "jaw_open", "smile")
FIGURES = {  # of a stabilized set
    **dict.fromkeys(("residual_first_median_mm", "residual_median_mm", "residual_p95_mm"), 0.1),
    **dict.fromkeys(("regional_rms_mm", "regional_most_mm", "regional_turn_deg"), 0.1),
    **{"samples": 2, "components": {}, "flagged": {}},
}


def meshes(model) -> dict[str, np.ndarray]:
    """Return three meshes of each of three subjects; subjects are mixed and neutrals do not come first."""
    rng = np.random.default_rng(0)
    neutrals = heads(model, rng.standard_normal((3, 12)))
    acts = np.tensordot(rng.standard_normal((2, 12)), model.expression_basis, 1)
    rows = [(s, label) for label in LABELS[::-1] for s in range(3)]
    moves = {"neutral": 0, "jaw_open": acts[0], "smile": acts[1]}
    return {
        "vertices": np.stack([neutrals[s] + moves[label] for s, label in rows]).astype(np.float32),
        "triangles": model.triangles,
        "subjects": np.array([NAMES[s] for s, _ in rows]),
        "labels": np.array([label for _, label in rows]),
        "categories": np.array([{"jaw_open": "jaw", "smile": "flexing"}.get(label, label) for _, label in rows]),
        "tag_age": np.array([(30, 41, 42)[s] for s, _ in rows]),
        "tag_gender": np.array([("female", "male", "female")[s] for s, _ in rows]),
    }


@pytest.fixture(scope="module")
def model():
    return spectrum_model()


@pytest.fixture(scope="module")
def inputs(model, tmp_path_factory) -> Path:
    """A folder of two models and an NPZ file of meshes that the second model spans."""
    folder = tmp_path_factory.mktemp("evaluate")
    gnm_npz.write(model, folder / "own.npz")
    gnm_npz.write(with_identity(model, np.roll(model.vertex_identity_basis, -1, 0)), folder / "weak.npz")
    np.savez(folder / "held_out.npz", **meshes(model))
    return folder


@pytest.fixture(scope="module")
def out(inputs) -> Path:
    paths = [inputs / "weak.npz", inputs / "own.npz"]
    evaluate_models(paths, held_out=inputs / "held_out.npz", out=inputs / "out", settings=SETTINGS)
    return inputs / "out"


def test_a_file_of_meshes_is_read_by_subject(inputs, model):
    arrays = meshes(model)
    held_out = read_held_out(inputs / "held_out.npz")
    assert [subject.subject for subject in held_out.subjects] == list(NAMES)
    for number, subject in enumerate(held_out.subjects):
        np.testing.assert_array_equal(subject.neutral, arrays["vertices"][6 + number])
        np.testing.assert_array_equal(subject.expressions, arrays["vertices"][[number, 3 + number]])
        assert subject.categories == ("flexing", "jaw")
        assert subject.tags == {"age": (30, 41, 42)[number], "gender": ("female", "male", "female")[number]}
    assert gnm_npz.topology_hash(held_out.triangles) == gnm_npz.topology_hash(model.triangles)


def with_changes(arrays, **changes):
    arrays = {name: value for name, value in {**arrays, **changes}.items() if value is not None}
    return arrays


BAD_FILES = {
    "no labels": (lambda a: with_changes(a, labels=None), "'labels' is missing"),
    "a tag too short": (lambda a: with_changes(a, tag_age=a["tag_age"][:-1]), "incomplete"),
    "flat vertices": (lambda a: with_changes(a, vertices=a["vertices"].reshape(9, -1)), "'vertices' has a wrong shape"),
    "whole vertices": (lambda a: with_changes(a, vertices=a["vertices"].astype(int)), "'vertices' has a wrong type"),
    "quads": (lambda a: with_changes(a, triangles=np.zeros((5, 4), int)), "'triangles' has a wrong shape"),
    "two neutrals": (
        lambda a: with_changes(a, labels=np.where(a["labels"] == "smile", "neutral", a["labels"])),
        "not one",
    ),
    "no neutral": (
        lambda a: with_changes(a, labels=np.where(a["labels"] == "neutral", "rest", a["labels"])),
        "not one",
    ),
    "objects": (lambda a: with_changes(a, labels=a["labels"].astype(object)), "cannot be read"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_files_that_cannot_be_used_are_refused(model, tmp_path, name):
    change, what = BAD_FILES[name]
    np.savez(tmp_path / "bad.npz", **change(meshes(model)))
    with pytest.raises(InputError) as error:
        read_held_out(tmp_path / "bad.npz")
    assert what in error.value.what and str(tmp_path) in error.value.where


def test_unreadable_paths_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("none")
    for path in (tmp_path / "text.npz", tmp_path / "missing.npz", tmp_path):
        with pytest.raises(InputError):
            read_held_out(path)


def test_the_folder_holds_metrics_distances_and_a_self_contained_page(out, model):
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["kind"] == "gnm-evaluation" and manifest["figures"]["subjects"] == list(NAMES)
    own = manifest["figures"]["models"]["own"]
    assert own["identity"]["components"] == [2, 4, 12] and own["identity"]["intervals"][-1]["mean"] < 1e-3
    assert {row["kind"] for row in own["rows"]} == {"region", "category", "age", "gender"}
    assert [gain["components"] for gain in manifest["figures"]["gains"]] == [2, 4]
    with np.load(out / "vertices.npz") as archive:
        assert archive["models"].tolist() == ["weak", "own"]
        assert archive["distance_mm"].shape == (2, len(model.template_vertex_positions))
    page = (out / "index.html").read_text()
    assert 'src="http' not in page and 'href="http' not in page
    assert page.count("<svg") == 2 and page.count("<img") == 7  # three sides of two models; the dialog's
    for text in ("own", "weak", "lower face", "40-49", "one subject", "flexing"):
        assert text in page
    assert sorted(path.name for path in out.iterdir()) == ["index.html", "manifest.json", "vertices.npz"]
    assert not list(out.parent.glob(".*.tmp"))


def test_an_existing_result_is_reused_and_another_seed_is_computed(inputs, out, monkeypatch):
    calls = []
    real = workflows.steps.evaluate.evaluate
    monkeypatch.setattr(workflows.steps.evaluate, "evaluate", lambda *a: calls.append(1) or real(*a))
    paths = [inputs / "weak.npz", inputs / "own.npz"]
    saved = json.loads((out / "manifest.json").read_text())
    again = evaluate_models(paths, held_out=inputs / "held_out.npz", out=out, settings=SETTINGS)
    assert again.to_json() == saved and not calls
    other = EvaluationSettings(components=(2, 4), samples=3, draws=200, seed=1)
    changed = evaluate_models(paths, held_out=inputs / "held_out.npz", out=out, settings=other)
    assert len(calls) == 1 and changed.input_hash != saved["input_hash"]
    back = evaluate_models(paths, held_out=inputs / "held_out.npz", out=out, settings=SETTINGS)
    assert back.to_json() == saved


def test_the_command_prints_the_metrics(inputs, tmp_path, capsys):
    arguments = ["model", "evaluate", str(inputs / "weak.npz"), str(inputs / "own.npz"), "--held-out"]
    options = ["--components", "2", "4", "--samples", "2"]
    assert main([*arguments, str(inputs / "held_out.npz"), "--out", str(tmp_path / "out"), *options]) == 0
    printed = capsys.readouterr().out
    assert "own, 12 components: generalization 0.000 mm" in printed
    assert "own, 4 components: gain" in printed and str(tmp_path / "out" / "index.html") in printed


@pytest.mark.parametrize("options", [["--components", "2", "13"], ["--components", "4", "2"], ["--samples", "-1"]])
def test_bad_settings_are_refused_before_anything_is_written(inputs, tmp_path, capsys, options):
    arguments = ["model", "evaluate", str(inputs / "own.npz"), "--held-out", str(inputs / "held_out.npz")]
    assert main([*arguments, "--out", str(tmp_path / "out"), *options]) == 2
    assert "fix:" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_foreign_folders_and_duplicate_models_are_refused(inputs, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for paths, out in (([inputs / "own.npz"], tmp_path), ([inputs / "own.npz"] * 2, tmp_path / "out")):
        with pytest.raises(InputError):
            evaluate_models(paths, held_out=inputs / "held_out.npz", out=out, settings=SETTINGS)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.fixture
def run(model, tmp_path) -> Path:
    """Registrations of two subjects, of which one has an expression."""
    neutrals = meshes(model)["vertices"][6:8]
    confidence = np.ones(len(neutrals[0]))
    anna = {"rest": ("neutral", neutrals[0], confidence), "jaw": ("jaw_open", neutrals[0] + 1e-3, confidence)}
    write_subject(tmp_path / "run" / "subject_10", "ben", model, {"rest": ("neutral", neutrals[1], confidence)})
    write_subject(tmp_path / "run" / "subject_2", "anna", model, anna)
    return tmp_path / "run"


def test_a_run_gives_its_neutrals_and_stabilized_expressions(model, run):
    neutrals = meshes(model)["vertices"][6:8]
    held_out = read_held_out(run)
    assert [subject.subject for subject in held_out.subjects] == ["anna", "ben"]  # by folder, numbers as numbers
    for subject, neutral in zip(held_out.subjects, neutrals, strict=True):
        np.testing.assert_allclose(subject.neutral, neutral, atol=1e-7)
        assert len(subject.expressions) == 0
    folder = run / "stabilized"
    (folder / "subjects").mkdir(parents=True)
    steady = StabilizedSubject(
        subject="anna",
        names=("jaw",),
        labels=("jaw_open",),
        neutral=neutrals[0],
        T_neutral_expression=np.eye(4)[None],
        vertices=neutrals[:1] + np.float32(2e-3),
        confidence_map=np.ones(len(neutrals[0]), np.float32),
        residual_mm=np.zeros((1, 5), np.float32),
        T_head_world=np.eye(4),
    )
    stabilized.write_subject(steady, folder, 0)
    stabilized.StabilizedManifest(
        content_id="",
        input_hash="",
        dataset="",
        subjects=("anna",),
        left_out={},
        decisions=(),
        figures=FIGURES,
        config={},
        inputs={},
        versions={},
    ).write(folder / stabilized.MANIFEST)
    anna, ben = read_held_out(run).subjects
    np.testing.assert_array_equal(anna.expressions, steady.vertices)
    assert anna.categories == ("jaw_open",) and len(ben.expressions) == 0


def test_captures_add_tags_and_face_points_of_the_scan(run, tmp_path):
    for folder in ("subject_2", "subject_10"):
        small.make(tmp_path / "captures" / folder / "rest")
    held_out = read_held_out(run, tmp_path / "captures")
    assert len(held_out.warnings) == len(held_out.subjects) and "shows ball" in held_out.warnings[0]
    for subject in held_out.subjects:
        assert subject.tags["age"] == 30
        assert subject.scan is not None and 10 < len(subject.scan)
    assert {"capture anna", "capture ben"} <= set(held_out.inputs)
    assert held_out.inputs["held_out"] != read_held_out(run).inputs["held_out"]
    (tmp_path / "captures" / "subject_2" / "rest" / "capture.toml").unlink()
    with pytest.raises(InputError):
        read_held_out(run, tmp_path / "captures")


def test_runs_that_cannot_be_used_are_refused(run):
    record = run / "subject_2" / "subject.json"
    entries = json.loads(record.read_text())
    entries["captures"][0]["status"] = "failed"
    record.write_text(json.dumps(entries))
    with pytest.raises(InputError) as error:
        read_held_out(run)
    assert "no neutral" in error.value.what
    record.write_text("{}")
    with pytest.raises(InputError):
        read_held_out(run)
