"""Malformed records are errors that name the file and the field, whichever function reads them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from registration.errors import InputError
from registration.model import gnm_npz
from tests.registration.register import synthetic
from tests.workflows.records.plan import PLAN
from workflows.records.coregistration import CoregistrationPlan, CoregistrationState, RoundProducts, initial_state
from workflows.records.dataset import DatasetRecord, read_dataset
from workflows.records.decisions import DecisionEntry, read_decisions
from workflows.records.held_out import read_held_out
from workflows.records.run import known_model, read_run
from workflows.records.step_results import BuildResult, EvaluateResult, HoldOutResult, StabilizeResult
from workflows.records.store import MANIFEST, Store
from workflows.records.subject import CaptureRow, SubjectRecord, read_usable
from workflows.records.training_subjects import RegisteredSubjects, registered_meshes
from workflows.steps.job_options import from_job
from workflows.steps.products import Product
from workflows.steps.round import apply_verdict
from workflows.steps.stabilize import stabilize_subjects

MODEL = synthetic.MODEL
CURVES = {"model 0": {"2": 1.0}, "model 1": {"2": 0.5}}
SUBJECT = SubjectRecord(
    subject="ann",
    model="ab",
    recipe="draft",
    neutral="rest",
    rows=(CaptureRow(name="rest", expression="neutral", status="converged", folder="rest"),),
)


def truncated(value: dict[str, Any]) -> str:
    return json.dumps(value)[:-5]


def without(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda value: json.dumps({name: item for name, item in value.items() if name != key})


def with_(key: str, item: Any) -> Callable[[dict[str, Any]], str]:
    return lambda value: json.dumps({**value, key: item})


def assert_refused(read: Callable[[], object], file: object, field: str = "") -> None:
    with pytest.raises(InputError) as error:
        read()
    assert str(file) in error.value.where and field in error.value.where


def read_registered(run: Path) -> object:
    data = gnm_npz.read(MODEL)
    return RegisteredSubjects(run=run, names=["ann"], model=data, stabilized_set=None).usable


def end_a_round(run: Path) -> object:
    evaluated = EvaluateResult(
        input_hash="h", out="/e", components=(2,), at=2, generalization_mm=CURVES, specificity_mm=CURVES
    )
    built = BuildResult(
        input_hash="h", model="/m", content_id="c", registered=1, rejected=(), components=2, drift_mm=0.1
    )
    round_ = RoundProducts(name="it00", stabilize=StabilizeResult(out=None), build=built, evaluate=evaluated)
    return apply_verdict(initial_state(replace(PLAN, out=run.parent.parent)), [round_])


@pytest.mark.parametrize(
    "read",
    [
        lambda run: read_usable(run / "ann"),
        lambda run: read_run(run, gnm_npz.read(MODEL)),
        known_model,
        read_held_out,
        lambda run: registered_meshes(run / "ann", gnm_npz.read(MODEL)),
        read_registered,
        end_a_round,
        lambda run: stabilize_subjects(run=str(run), names=["ann"], model=str(MODEL), out=str(run / "stabilized")),
        lambda run: SubjectRecord.read(run / "ann" / "subject.json"),
    ],
)
@pytest.mark.parametrize(
    "damage, field",
    [
        (truncated, ""),
        (without("captures"), "captures"),
        (with_("neutral", 3), "neutral"),
        (with_("captures", [{"name": "rest", "expression": "neutral", "status": "fine"}]), "captures[0].status"),
        (with_("colour", "red"), "colour"),
        (with_("schema", 2), "schema"),
        (with_("kind", "something"), ""),
    ],
)
def test_a_malformed_subject_record_is_refused_by_every_reader(
    tmp_path: Path, read: Callable[[Path], object], damage: Callable[[dict[str, Any]], str], field: str
) -> None:
    run = tmp_path / "it00" / "registrations"
    file = run / "ann" / "subject.json"
    file.parent.mkdir(parents=True)
    file.write_text(damage(SUBJECT.to_json()))
    assert_refused(lambda: read(run), file, field)


def test_a_folder_without_a_record_is_not_a_subject(tmp_path: Path) -> None:
    (tmp_path / "run" / "ann").mkdir(parents=True)
    assert read_usable(tmp_path / "run" / "ann") is None and not read_registered(tmp_path / "run")


@pytest.mark.parametrize(
    "type_, record, damage, field",
    [
        (CoregistrationPlan, PLAN, truncated, ""),
        (CoregistrationPlan, PLAN, without("split"), "split"),
        (CoregistrationPlan, PLAN, with_("options", {"recpe": "draft"}), "options.recpe"),
        (CoregistrationPlan, PLAN, with_("schema", 9), "schema"),
        (CoregistrationState, initial_state(PLAN), truncated, ""),
        (CoregistrationState, initial_state(PLAN), with_("at", "2"), "at"),
        (CoregistrationState, initial_state(PLAN), with_("schema", 9), "schema"),
    ],
)
def test_a_malformed_plan_or_state_is_refused(
    tmp_path: Path, type_: Any, record: Any, damage: Callable[[dict[str, Any]], str], field: str
) -> None:
    file = tmp_path / "record.json"
    record.write(file)
    assert type_.read(file) == record
    file.write_text(damage(record.to_json()))
    assert_refused(lambda: type_.read(file), file, field)


@pytest.mark.parametrize(
    "damage, field",
    [
        (truncated, ""),
        (without("complete"), "complete"),
        (with_("categories", ["smile"]), "categories"),
        (with_("schema", 9), "schema"),
    ],
)
def test_a_malformed_dataset_record_is_refused(
    tmp_path: Path, damage: Callable[[dict[str, Any]], str], field: str
) -> None:
    file = tmp_path / "dataset.json"
    file.write_text(damage(DatasetRecord(complete=True, categories={"smile": "lips"}).to_json()))
    assert_refused(lambda: read_dataset(tmp_path), file, field)


@pytest.mark.parametrize(
    "damage, field",
    [
        (truncated, ""),
        (without("region"), "region"),
        (with_("component", "first"), "component"),
        (with_("action", "burn"), "action"),
    ],
)
def test_a_malformed_decision_is_refused_with_its_line(
    tmp_path: Path, damage: Callable[[dict[str, Any]], str], field: str
) -> None:
    file = tmp_path / "decisions.jsonl"
    entry = DecisionEntry(dataset="d", region="face", component=0, action="keep", reason="")
    file.write_text(f"{json.dumps(entry.to_json())}\n{damage(entry.to_json())}\n")
    assert_refused(lambda: read_decisions(file, "d"), f"{file}, line 2", field)


@pytest.mark.parametrize(
    "damage, field",
    [
        (truncated, ""),
        (without("attempt"), "attempt"),
        (with_("files", {"f": {"sha256": "0"}}), "files['f'].bytes"),
        (with_("schema", 9), "schema"),
    ],
)
def test_a_malformed_artifact_is_refused(tmp_path: Path, damage: Callable[[dict[str, Any]], str], field: str) -> None:
    store = Store(tmp_path)
    store.produce("a", input_hash="h", make=lambda folder: {})
    file = tmp_path / "a" / MANIFEST
    file.write_text(damage(json.loads(file.read_text())))
    assert_refused(lambda: store.find("a"), file, field)


def test_a_product_is_looked_up_by_its_inputs_and_refused_if_malformed(tmp_path: Path) -> None:
    product = Product(tmp_path, "h", HoldOutResult)
    assert product.find() is None
    result = HoldOutResult(input_hash="h", file="held_out.npz", sources={"ann": "registrations"}, lost=("bob",))
    product.write(result)
    assert product.find() == result
    assert Product(tmp_path, "other", BuildResult).find() is None  # of other inputs, or of another version
    file = tmp_path / "step.json"
    for text, field in (
        (truncated(result.to_json()), ""),
        ("[]", ""),
        (without("input_hash")(result.to_json()), ""),
        (without("file")(result.to_json()), "file"),
        (with_("lost", [3])(result.to_json()), "lost[0]"),
    ):
        file.write_text(text)
        assert_refused(product.find, file, field)


@pytest.mark.parametrize(
    "options, field",
    [
        ({"recpe": "draft"}, "recpe"),
        ({"views": "all"}, "views"),
        ({"variant": "vulkan"}, "variant"),
        ({"recipe": "os:getcwd"}, "recipe"),
        ({"landmark_files": {"68": "/etc/passwd"}}, "landmarks"),
    ],
)
def test_options_of_jobs_that_a_worker_must_not_use_are_refused(options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as error:
        from_job(options)
    assert field in error.value.where
