"""`gnmreg dataset synth`: a seed determines the population, interrupted or not. Rendering is a stand-in."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import workflows.steps.synthesize
from coregister.synthetic import subject as subjects
from coregister.synthetic.capture import Studio
from registration.errors import InputError
from registration.storage.hashing import hash_file
from workflows.cli.app import main
from workflows.processes import run_parallel
from workflows.records.dataset import read_dataset, split
from workflows.steps.synthesize import Population, render_subject, synth_dataset

ACTS = ("smile", "jaw_open")


class FakeSynthesizer:
    """Stand-in for `synthesize_capture`: writes a folder with its arguments and a truth sampled by the seed."""

    def __init__(self) -> None:
        self.written_captures: list[str] = []
        self.error: BaseException | None = None  # raised at the fifth capture

    def __call__(self, root: Path, *, seed: int, expression: str, tags: dict, studio: Studio) -> Path:
        if self.error is not None and len(self.written_captures) == 4:
            raise self.error
        assert studio.seed == seed
        root.mkdir(parents=True)
        lines = [f'subject = "{root.parent.name}"', f'expression = "{expression}"', 'units = "m"']
        lines += [f"{name} = {json.dumps(value)}" for name, value in tags.items()]
        (root / "capture.toml").write_text("\n".join(lines) + "\n")
        np.save(root / "truth.npy", np.random.default_rng([seed, *expression.encode()]).normal(size=5))
        self.written_captures.append(f"{root.parent.name}/{expression}")
        return root


@pytest.fixture
def synthesizer(monkeypatch) -> FakeSynthesizer:
    synthesizer = FakeSynthesizer()
    monkeypatch.setattr(subjects, "synthesize_capture", synthesizer)

    def in_this_process(function, calls, jobs) -> Iterator[tuple[str, str]]:
        yield from ((name, function(**call)) for name, call in calls.items())

    monkeypatch.setattr(workflows.steps.synthesize, "run_parallel", in_this_process)
    return synthesizer


def contents(out: Path) -> dict[str, str]:
    return {str(path.relative_to(out)): hash_file(path) for path in sorted(out.rglob("*")) if path.is_file()}


def test_a_seed_determines_the_population_resumed_or_not(synthesizer, tmp_path):
    population = Population(subjects=3, expressions=ACTS, seed=2, held_out=1)
    synthesizer.error = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        synth_dataset(tmp_path / "a", population)
    assert json.loads((tmp_path / "a/dataset.json").read_text())["complete"] is False
    before = contents(tmp_path / "a")
    synthesizer.error = None
    record = synth_dataset(tmp_path / "a", population)
    assert len(synthesizer.written_captures) == 9 == len(set(synthesizer.written_captures))
    after = contents(tmp_path / "a")
    assert len(before) == 9 and all(after[name] == before[name] for name in before if name != "dataset.json")
    assert record.seeds == {"synth_2000": 2000, "synth_2001": 2001, "synth_2002": 2002}
    assert record.held_out == ("synth_2002",) and record.complete and record.versions["numpy"]
    assert record.categories == {"smile": "flexing", "jaw_open": "jaw"}
    synth_dataset(tmp_path / "b", population)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    written = (tmp_path / "a/dataset.json").stat().st_mtime_ns
    synth_dataset(tmp_path / "a", population)
    assert len(synthesizer.written_captures) == 18 and (tmp_path / "a/dataset.json").stat().st_mtime_ns == written
    other = Population(subjects=3, seed=3)
    assert not set(other.seeds.values()) & set(population.seeds.values())


def test_coregistration_reads_a_synthetic_dataset(synthesizer, tmp_path, monkeypatch):
    synth_dataset(tmp_path / "a", Population(subjects=4, expressions=("smile",), held_out=2))
    monkeypatch.setattr("workflows.records.subject.read_capture", lambda root: read_toml(root))
    dataset = read_dataset(tmp_path / "a")
    assert dataset.categories == {"smile": "flexing"} and dataset.closed
    assert split(dataset).held_out == ("synth_0002", "synth_0003")


def read_toml(root: Path):
    """Return a capture with the fields of its TOML file only, as there are no images."""
    import tomllib

    from registration.types import Capture

    fields = tomllib.loads((root / "capture.toml").read_text())
    subject, expression, _ = (fields.pop(name) for name in ("subject", "expression", "units"))
    return Capture(root=root, subject=subject, expression=expression, views=(), tags=fields)


def test_a_failed_capture_is_reported_after_all_others(synthesizer, tmp_path):
    synthesizer.error = InputError("The lamp is out", where="lamp", expected="light", got="none", fix="change it")
    with pytest.raises(InputError, match="of 6 captures could not be rendered"):
        synth_dataset(tmp_path / "a", Population(subjects=6))
    assert json.loads((tmp_path / "a/dataset.json").read_text())["complete"] is False
    synthesizer.error = None
    assert synth_dataset(tmp_path / "a", Population(subjects=6)).complete


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ("--subjects 0", "number of subjects"),
        ("--subjects 2 --held-out 3", "More subjects are held out"),
        ("--subjects 2 --expressions smile,grin", "no such expression"),
        ("--subjects 2 --expressions neutral", "each once"),
        ("--subjects 2 --views 0", "number of cameras"),
        ("--subjects 2 --seed -1", "seed"),
    ],
)
def test_bad_settings_are_refused_before_any_work(options, what, synthesizer, tmp_path, capsys):
    assert main(["dataset", "synth", str(tmp_path / "a"), *options.split()]) == 2
    assert what in capsys.readouterr().err and not (tmp_path / "a").exists() and not synthesizer.written_captures


def test_other_folders_are_refused(synthesizer, tmp_path):
    synth_dataset(tmp_path / "a", Population(subjects=2))
    with pytest.raises(InputError, match="cannot be used"):
        synth_dataset(tmp_path / "a", Population(subjects=3))
    (tmp_path / "mine").mkdir()
    shutil.copy(tmp_path / "a" / "dataset.json", tmp_path / "mine" / "notes.json")
    with pytest.raises(InputError, match="cannot be used"):
        synth_dataset(tmp_path / "mine", Population(subjects=2))


def test_an_error_in_one_process_does_not_stop_the_others(tmp_path):
    bad = Studio(cameras=0)
    calls = {
        "ann": {"root": tmp_path / "ann", "seed": 0, "expression": "neutral", "tags": {}, "studio": bad},
        "bob": {"unknown": tmp_path / "bob"},
    }
    results = dict(run_parallel(render_subject, calls, jobs=2))
    assert "number of cameras" in results["ann"] and results["bob"].startswith("TypeError")


@pytest.mark.slow
def test_two_subjects_are_rendered(tmp_path):
    from coregister.first_model import makehuman

    try:
        makehuman.fetch()
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")
    studio = Studio(cameras=2, size_px=(96, 96), texture_size=256)
    synth_dataset(tmp_path / "a", Population(subjects=2, expressions=("smile",), held_out=1, studio=studio), jobs=2)
    dataset = read_dataset(tmp_path / "a")
    assert list(dataset.subjects) == ["synth_0000", "synth_0001"]
    assert {"age", "gender", "ethnicity"} <= set(dataset.tags("synth_0000"))
    truths = [np.load(path)["vertices"] for path in sorted((tmp_path / "a").glob("*/neutral/ground_truth.npz"))]
    assert truths[0].shape == truths[1].shape and np.abs(truths[0] - truths[1]).max() > 1e-3
