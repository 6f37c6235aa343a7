"""`gnmreg stabilize`: equal to the plain function; bad input is refused first; decisions belong to their dataset."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.support import performances
from registration.errors import InputError
from registration.model import gnm_npz
from registration.stabilize import stabilized_folder as disk
from registration.stabilize.decisions import Decision
from registration.stabilize.pipeline import stabilize
from registration.storage.registration_folder import load_registration, save_registration
from tests.coregister.conftest import head_assembly, model, model_file, source, wheel  # noqa: F401  fixtures
from tests.registration.stabilize import runs
from workflows.cli.app import main
from workflows.records.decisions import append_decisions, read_decisions
from workflows.records.run import Selection, read_run
from workflows.steps.stabilize import stabilize_run

NAMES = ("smile", "jaw_open", "brows_up")


@pytest.fixture(scope="module")
def run(head_assembly, model, tmp_path_factory) -> Path:  # noqa: F811
    truths = [performances.true_subject(head_assembly, number, NAMES) for number in range(2)]
    seens = [performances.observe(truth, number, unobserved=0.02) for number, truth in enumerate(truths)]
    return runs.write_run(tmp_path_factory.mktemp("run"), model, truths, seens)


@pytest.fixture(scope="module")
def outcome(run, model_file):  # noqa: F811
    return stabilize_run(run, model_path=model_file)


@pytest.fixture
def run_copy(run, tmp_path) -> Path:
    """A copy of the run that a test may modify."""
    shutil.copytree(run, tmp_path / "copy", ignore=shutil.ignore_patterns("stabilized"))
    return tmp_path / "copy"


def test_the_folder_holds_what_the_function_returns(run, outcome, model):  # noqa: F811
    expected = stabilize(read_run(run, model).meshes(), model)
    for number, subject in enumerate(expected.subjects):
        saved = disk.read_subject(outcome.out, number)
        assert saved.subject == subject.subject and saved.labels == NAMES
        np.testing.assert_allclose(saved.T_neutral_expression, subject.T_neutral_expression, atol=1e-9)
        np.testing.assert_allclose(saved.vertices, subject.vertices, atol=1e-6)
        np.testing.assert_array_equal(saved.confidence_map, subject.confidence_map)
    stored = disk.read_components(outcome.out)
    assert [part.region for part in stored.components] == [part.region for part in expected.components]
    assert stored.labels == 2 * NAMES and stored.names == 2 * NAMES
    page = (outcome.out / "index.html").read_text()
    assert 'src="http' not in page and "synth_0000" in page and page.count("<img") >= 6
    assert not list(outcome.out.parent.glob(".*.tmp"))


def test_an_existing_result_is_reused_and_one_subject_suffices(run, outcome, model_file, capsys):  # noqa: F811
    written = (outcome.out / "manifest.json").stat().st_mtime_ns
    assert main(["stabilize", str(run)]) == 0
    assert "index.html" in capsys.readouterr().out
    assert (outcome.out / "manifest.json").stat().st_mtime_ns == written
    single = stabilize_run(run / "synth_0001", model_path=model_file)
    assert single.figures["samples"] == 3 and single.dataset != outcome.dataset
    assert single.out == run / "synth_0001" / "stabilized"


def test_decisions_are_replayed(run, outcome, model, model_file, tmp_path):  # noqa: F811
    log = tmp_path / "log" / "decisions.jsonl"
    first = Decision(region="mouth", component=0, action="drop", reason="a try")
    last = Decision(region="neck_back", component=0, action="subtract", reason="it is the head")
    append_decisions(log, outcome.dataset, [first])
    append_decisions(log, outcome.dataset, [last, Decision(region="mouth", component=0, action="keep", reason="no")])
    entries = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(entries) == 3 and all(entry["time"] and entry["by"] for entry in entries)
    replayed = stabilize_run(run, model_path=model_file, out=tmp_path / "out", decisions=log)
    expected = stabilize(read_run(run, model).meshes(), model, decisions=[last])
    plain = disk.read_subject(outcome.out, 0)
    saved = disk.read_subject(replayed.out, 0)
    np.testing.assert_allclose(saved.vertices, expected.subjects[0].vertices, atol=1e-6)
    assert np.abs(saved.T_neutral_expression - plain.T_neutral_expression).max() > 1e-6


def test_decisions_of_another_dataset_or_none_are_refused(run, outcome, model_file, tmp_path):  # noqa: F811
    log = tmp_path / "decisions.jsonl"
    append_decisions(log, "0" * 64, [Decision(region="nose", component=0, action="keep")])
    with pytest.raises(InputError, match="another dataset"):
        stabilize_run(run, model_path=model_file, out=tmp_path / "out", decisions=log)
    with pytest.raises(InputError, match="another dataset"):
        append_decisions(log, outcome.dataset, [Decision(region="nose", component=0, action="keep")])
    for text in ("{", '{"dataset": "x"}\n', log.read_text().replace("keep", "burn")):
        log.write_text(text)
        with pytest.raises(InputError, match="cannot be read"):
            read_decisions(log, outcome.dataset)
    assert [path.name for path in tmp_path.iterdir()] == ["decisions.jsonl"]


@pytest.mark.parametrize("own", [True, False])
def test_an_expression_that_started_from_another_neutral_is_refused(run_copy, model, own):  # noqa: F811
    folder = run_copy / "synth_0000" / "smile"
    registration = load_registration(folder)
    identity = registration.identity if own else registration.identity + 0.5
    save_registration(
        replace(registration, identity=identity, inputs={**registration.inputs, "neutral": "0" * 64}), folder
    )
    if own:
        read_run(run_copy, model)
        return
    with pytest.raises(InputError) as error:
        read_run(run_copy, model)
    assert "another neutral" in error.value.what and error.value.where.endswith("smile")


def remove_neutral(run: Path) -> None:
    change_record(run, lambda rows: rows.pop(0))


def mark_failed(run: Path) -> None:
    change_record(run, lambda rows: rows[1].update(status="failed", reason="blew up"))


def remove_expressions(run: Path) -> None:
    change_record(run, lambda rows: rows.__delitem__(slice(1, None)))


def change_topology(run: Path) -> None:
    change_arrays(run, lambda arrays: arrays.update(triangles=arrays["triangles"][::-1].copy()))


def write_nan(run: Path) -> None:
    change_arrays(run, lambda arrays: arrays["vertices"].__setitem__((5, 1), np.nan))


def corrupt_file(run: Path) -> None:
    (run / "synth_0001" / "smile" / "registration.npz").write_bytes(b"none")


def duplicate_subject(run: Path) -> None:
    shutil.copytree(run / "synth_0001", run / "again")


def leave_one_expression(run: Path) -> None:
    shutil.rmtree(run / "synth_0000")
    change_record(run, lambda rows: rows.__delitem__(slice(2, None)))


def remove_all_subjects(run: Path) -> None:
    shutil.rmtree(run)
    run.mkdir()


def change_record(run: Path, change) -> None:
    file = run / "synth_0001" / "subject.json"
    record = json.loads(file.read_text())
    change(record["captures"])
    file.write_text(json.dumps(record))


def change_arrays(run: Path, change) -> None:
    file = run / "synth_0001" / "smile" / "registration.npz"
    with np.load(file) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(file, **arrays)


@pytest.mark.parametrize(
    "damage, what",
    [
        (remove_neutral, "no neutral"),
        (mark_failed, "registrations that failed"),
        (remove_expressions, "no expression"),
        (change_topology, "another topology"),
        (write_nan, "NaN or infinite"),
        (corrupt_file, "cannot be read"),
        (duplicate_subject, "same subject"),
        (leave_one_expression, "only one expression"),
        (remove_all_subjects, "no subjects"),
    ],
)
def test_bad_runs_are_refused_before_any_work(run_copy, damage, what, model_file, monkeypatch, capsys):  # noqa: F811
    damage(run_copy)
    before = sorted(run_copy.rglob("*"))
    monkeypatch.setattr("workflows.steps.stabilize.automatic_stage", None)  # must not be reached
    assert main(["stabilize", str(run_copy), "--model", str(model_file)]) == 2
    error = capsys.readouterr().err
    assert what in error and "fix:" in error and "Traceback" not in error
    assert sorted(run_copy.rglob("*")) == before


def test_failed_registrations_can_be_excluded(run_copy, model_file):  # noqa: F811
    mark_failed(run_copy)
    outcome = stabilize_run(run_copy, model_path=model_file, selection=Selection(skip_failed=True))
    manifest = disk.read_manifest(outcome.out)
    assert outcome.figures["samples"] == 5 and manifest.left_out == {"synth_0001": ("smile",)}


def test_other_folders_and_other_models_are_refused(run_copy, model_file, model, tmp_path):  # noqa: F811
    (run_copy / "stabilized").mkdir()
    (run_copy / "stabilized" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="output folder"):
        stabilize_run(run_copy, model_path=model_file)
    keep = model.vertex_group_names != "nose_region"
    poor = tmp_path / "poor.npz"
    gnm_npz.write(
        gnm_npz.GNMData(
            **{
                **{name: getattr(model, name) for name in gnm_npz.AXES},
                "vertex_groups": model.vertex_groups[keep],
                "vertex_group_names": model.vertex_group_names[keep],
            }
        ),
        poor,
    )
    with pytest.raises(InputError, match="no vertex group 'nose_region'"):
        stabilize_run(run_copy, model_path=poor)


def test_an_interrupted_run_leaves_nothing(run_copy, model_file, monkeypatch):  # noqa: F811
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("workflows.steps.stabilize.regional_stage", stop)
    before = sorted(path.name for path in run_copy.iterdir())
    with pytest.raises(KeyboardInterrupt):
        stabilize_run(run_copy, model_path=model_file)
    assert sorted(path.name for path in run_copy.iterdir()) == before


def test_an_unknown_model_must_be_given_by_option(run_copy, capsys):
    file = run_copy / "synth_0000" / "subject.json"
    file.write_text(file.read_text().replace('"model": "', '"model": "0'))
    assert main(["stabilize", str(run_copy)]) == 2
    assert "--model" in capsys.readouterr().err
