"""A subject's captures in sequence. Registrations are stand-ins except in the last test."""

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import workflows.steps.subject
from registration.errors import InputError
from registration.evaluate.folder import evaluate_folder
from registration.fit.recipes import RECIPES, Recipe, draft
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.render import backend
from registration.storage.registration_folder import AXES, load_registration, read_manifest
from tests.registration.register import synthetic
from tests.workflows.conftest import MODEL, FakeRegister, RecordingProgress, add_truths, change, manifest, statuses
from workflows.records.subject import SubjectRecord
from workflows.steps.subject import register_subject

REFUSED = InputError("The lens is dirty", where="cam3", expected="a clean one", got="dust", fix="wipe it")


def run(subject: Path, **options) -> SubjectRecord:
    out = options.pop("out", subject.parent / "out")
    return register_subject(subject, MODEL, out, **options)


def test_the_neutral_is_registered_first_then_each_expression_from_it(
    subject: Path, fake: FakeRegister, tmp_path: Path
):
    progress, out = RecordingProgress(), tmp_path / "out"
    files = {"68": synthetic.FIXTURES / "head_sparse_68.txt"}
    options = RegisterOptions(
        recipe="studio", views=3, seed=4, deterministic=True, variant="cuda", landmark_files=files
    )
    run(subject, progress=progress, options=options, force=True)
    assert fake.calls == [
        ("rest", out / "rest", None),
        *((name, out / name, out / "rest") for name in ("jaw2", "jaw10", "smile")),
    ]
    assert fake.settings == 4 * [{"model": MODEL, "options": options, "force": True}]
    assert progress.steps[:2] == ["rest (1 of 4): fitting", "jaw2 (2 of 4): fitting"]
    assert "smile (4 of 4): converged: it is converged" in progress.messages


def test_the_contents_of_subject_json(subject: Path, fake: FakeRegister, tmp_path: Path):
    out = tmp_path / "out"
    run(subject)
    record = manifest(out)
    assert (record["kind"], record["schema"], record["subject"]) == ("gnm-subject", 1, "ball")
    assert (record["recipe"], record["neutral"]) == ("draft", "rest")
    assert re.fullmatch("[0-9a-f]{64}", record["model"])
    rest, jaw, *_ = record["captures"]
    assert rest == {
        "name": "rest",
        "expression": "neutral",
        "status": "converged",
        "reason": "it is converged",
        "figures": {"scan_to_mesh": {"face": {"mean_mm": 0.25, "median_mm": 0.125}}},
        "seconds": 201.0,
        "folder": "rest",
    }
    assert (jaw["name"], jaw["expression"], jaw["folder"]) == ("jaw2", "jaw", "jaw2")
    assert sorted(path.name for path in out.iterdir()) == [
        "index.html", "jaw10", "jaw2", "rest", "smile", "subject.json"
    ]  # fmt: skip


def test_the_drift_equals_that_of_evaluate(subject: Path, fake: FakeRegister, tmp_path: Path):
    """Both ground truths are equal, and the registered surface is translated by a millimetre."""
    out = tmp_path / "out"
    add_truths(subject, "rest", "smile")
    run(subject)
    figures = read_manifest(out / "smile").figures
    assert figures["drift"]["face"]["mean_mm"] == pytest.approx(1.0, abs=0.05)
    assert "drift" not in read_manifest(out / "rest").figures
    row_figures = manifest(out)["captures"][-1]["figures"]
    faces = {name: {"face": figures[name]["face"]} for name in ("scan_to_mesh", "drift")}
    assert row_figures == {**faces, "verdict": figures["verdict"]}
    by_hand = evaluate_folder(out / "smile", subject / "smile", out / "rest", subject / "rest").metrics
    assert by_hand["drift"] == figures["drift"] and by_hand["scan_to_mesh"] == figures["scan_to_mesh"]


@pytest.mark.parametrize(
    "change_truths",
    [
        lambda folder: (folder / "smile" / "ground_truth.npz").unlink(),
        lambda folder: (folder / "rest" / "ground_truth.npz").unlink(),
        lambda folder: (folder / "rest" / "scan.ply").unlink(),
        lambda folder: (folder / "smile" / "scan.ply").unlink(),
        lambda folder: np.savez(folder / "smile" / "ground_truth.npz", vertices=np.zeros((5, 3))),
    ],
)
def test_no_drift_without_comparable_truths(change_truths, subject: Path, fake: FakeRegister):
    add_truths(subject, "rest", "smile")
    change_truths(subject)
    row = run(subject).rows[-1]
    assert (row.status, row.reason) == ("converged", "it is converged")
    assert set(row.figures) == {"scan_to_mesh"}


def test_a_failed_drift_measurement_is_reported(subject: Path, fake: FakeRegister):
    add_truths(subject, "rest")
    (subject / "jaw10" / "ground_truth.npz").write_bytes(b"broken")
    rest, jaw2, row, smile = run(subject).rows
    assert smile.reason == "it is converged"
    assert row.status == "converged" and row.folder == "jaw10"
    assert "the drift could not be measured: The ground truth cannot be read" in row.reason


@pytest.mark.parametrize(
    ("outcome", "status", "reason"),
    [
        (REFUSED, "error", "The lens is dirty: cam3; expected a clean one, got dust; wipe it"),
        (RuntimeError("out of luck\nand more"), "error", "RuntimeError: out of luck"),
        ("failed", "failed", "it is failed"),
    ],
)
def test_one_failure_does_not_stop_the_others(outcome, status, reason, subject: Path, fake: FakeRegister):
    progress = RecordingProgress()
    fake.outcomes["jaw2"] = outcome
    result = run(subject, progress=progress)
    assert fake.order == ["rest", "jaw2", "jaw10", "smile"]
    assert [row.status for row in result.rows] == ["converged", status, "converged", "converged"]
    row = result.rows[1]
    assert row.reason == reason
    assert row.folder == (None if status == "error" else "jaw2")
    assert any("Traceback" in text for text in progress.messages) == isinstance(outcome, RuntimeError)


@pytest.mark.parametrize(
    ("outcome", "reason"),
    [("failed", "it is failed"), (REFUSED, "The lens is dirty"), (ValueError("odd"), "ValueError: odd")],
)
def test_without_a_neutral_no_expression_is_registered(outcome, reason: str, subject: Path, fake: FakeRegister):
    fake.outcomes["rest"] = outcome
    result = run(subject)
    assert fake.order == ["rest"]
    assert [row.status for row in result.rows[1:]] == 3 * ["skipped"]
    assert all(row.reason.startswith(f"the neutral failed: {reason}") for row in result.rows[1:])
    assert not any(row.usable for row in result.rows)


def test_a_stopped_neutral_is_used(subject: Path, fake: FakeRegister):
    fake.outcomes["rest"] = "stopped"
    assert [row.status for row in run(subject).rows] == ["stopped", *3 * ["converged"]]


def test_a_capture_that_cannot_be_read_does_not_stop_the_others(subject: Path, fake: FakeRegister):
    shutil.rmtree(subject / "jaw2" / "sparse")
    result = run(subject)
    assert fake.order == ["rest", "jaw10", "smile"]
    assert result.rows[-1].name == "jaw2" and result.rows[-1].status == "error"
    assert "The COLMAP model is missing" in result.rows[-1].reason


def test_the_record_lists_every_capture_from_the_start(subject: Path, fake: FakeRegister, tmp_path: Path):
    fake.outcomes["jaw2"] = "failed"
    run(subject)
    expected = ["converged", "failed", "converged", "converged"]
    for count, rows in enumerate(fake.records):
        assert [status for _, status in rows] == [*expected[:count], *(4 - count) * ["waiting"]]


def test_an_interrupted_run_is_recorded_and_resumes(subject: Path, fake: FakeRegister, tmp_path: Path):
    out = tmp_path / "out"
    fake.outcomes["jaw10"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run(subject)
    assert statuses(out) == [("rest", "converged"), ("jaw2", "converged"), ("jaw10", "waiting"), ("smile", "waiting")]
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    assert "2 of 4" in (out / "index.html").read_text()
    fake.outcomes.clear()
    run(subject)
    assert {status for _, status in statuses(out)} == {"converged"}


def test_a_crash_while_writing_leaves_the_previous_record(subject: Path, fake: FakeRegister, tmp_path, monkeypatch):
    out = tmp_path / "out"
    run(subject)
    before = manifest(out)
    monkeypatch.setattr(os, "replace", lambda *paths: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space left"):
        run(subject)
    assert manifest(out) == before
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_a_drift_newer_than_the_neutral_is_kept(subject: Path, fake: FakeRegister, tmp_path: Path, monkeypatch):
    out, evaluated = tmp_path / "out", []
    add_truths(subject, "rest", "jaw2", "smile")
    run(subject)
    monkeypatch.setattr(workflows.steps.subject, "register", lambda capture, *, out, **settings: load_registration(out))

    def record_call(registration, capture, **options):
        evaluated.append(capture.root.name)
        raise REFUSED

    monkeypatch.setattr(workflows.steps.subject, "evaluate_registration", record_call)
    again = run(subject)
    assert evaluated == [] and again.rows[-1].figures["drift"]["face"]["mean_mm"] == pytest.approx(1.0, abs=0.05)
    os.utime(out / "rest" / "manifest.json")
    run(subject)
    assert evaluated == ["jaw2", "smile"]


def test_the_neutral_can_be_selected(subject: Path, fake: FakeRegister):
    change(subject / "smile", '"smile"', '"neutral"')
    assert run(subject, neutral="smile").neutral == "smile"
    assert fake.order == ["smile", "jaw2", "jaw10", "rest"]


def test_the_recorded_folder_is_replaced_only_for_its_subject(subject: Path, fake: FakeRegister, tmp_path: Path):
    run(subject)
    for name in ("rest", "jaw2", "jaw10", "smile"):
        change(subject / name, '"ball"', '"cube"')
    with pytest.raises(InputError, match="cannot be used") as refused:
        run(subject)
    assert "'ball'" in str(refused.value) and len(fake.calls) == 4


def short_draft() -> Recipe:
    """Return the draft recipe with a fifth of its steps."""
    recipe = draft()
    return replace(recipe, stages=tuple(replace(stage, steps=stage.steps // 5) for stage in recipe.stages))


@pytest.fixture
def threads() -> Iterator[None]:
    """Restore the thread counts that a deterministic run changes for the whole process."""
    import drjit as dr

    count, lanes = torch.get_num_threads(), os.cpu_count() or 1
    yield
    torch.set_num_threads(count)
    dr.set_thread_count(lanes)


@pytest.mark.slow
def test_a_subject_equals_its_captures_registered_by_hand(tmp_path: Path, monkeypatch, threads: None):
    monkeypatch.setitem(RECIPES, "draft", short_draft)
    subject, out, options = tmp_path / "tiny", tmp_path / "out", RegisterOptions(views=3, deterministic=True)
    for expression in ("neutral", "smile"):
        synthetic.make(subject / expression, expression)
    result = register_subject(subject, MODEL, out, options)
    assert all(row.usable for row in result.rows), result.rows
    by_hand = register(subject / "smile", MODEL, tmp_path / "smile", options, neutral=out / "neutral")
    stored = load_registration(out / "smile")
    for name in (*AXES, "texture"):
        first, second = (getattr(load_registration(path), name) for path in (out / "smile", tmp_path / "smile"))
        np.testing.assert_array_equal(first, second)
    assert read_manifest(out / "smile").input_hash == read_manifest(tmp_path / "smile").input_hash
    assert by_hand.inputs["neutral"] == stored.inputs["neutral"]
    assert stored.figures["drift"]["face"]["mean_mm"] < 2.0
    record = manifest(out)
    assert record["captures"][1]["figures"]["drift"] == stored.figures["drift"]

    def stop(*args, **kwargs):
        raise AssertionError("nothing was to be computed")

    monkeypatch.setattr(backend, "activate", stop)
    monkeypatch.setattr(workflows.steps.subject, "evaluate_registration", stop)
    register_subject(subject, MODEL, out, options)
    assert manifest(out) == record
