"""`gnmreg export`: what it writes and prints, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.registration.export.heads import MODEL, a_folder, a_subject
from workflows.cli.app import main
from workflows.steps.stabilize import stabilize_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_folder(tmp_path_factory.mktemp("export") / "neutral")


def test_a_registration_is_exported_and_the_files_are_named(folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "new" / "head.obj"
    assert main(["export", str(folder), str(out)]) == 0
    assert capsys.readouterr().out.split() == [str(out), str(out.with_suffix(".png")), str(out.with_suffix(".mtl"))]
    assert main(["export", str(folder), str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["export", str(folder), str(out), "--force"]) == 0
    assert main(["export", str(folder), str(tmp_path / "head.glb"), "--model", str(MODEL)]) == 0
    assert "does not hold the quads" in capsys.readouterr().out


def test_a_model_is_exported(tmp_path: Path) -> None:
    assert main(["export", str(MODEL), str(tmp_path / "template.ply")]) == 0
    assert np.isfinite(trimesh.load(tmp_path / "template.ply").vertices).all()


def test_sources_that_are_none_are_refused(folder: Path, tmp_path: Path, capsys) -> None:
    for source, message in (
        (tmp_path, "There is nothing to export"),
        (tmp_path / "missing", "There is nothing to export"),
        (folder / "texture.png", "head model"),
    ):
        assert main(["export", str(source), str(tmp_path / "head.glb")]) == 2
        assert message in capsys.readouterr().err
    assert main(["export", str(folder), str(tmp_path / "head.xyz")]) == 2
    assert ".glb" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_is_gone_is_asked_for(tmp_path: Path, capsys) -> None:
    lost = a_folder(tmp_path / "neutral", inputs={"model": "ab" * 32}, provenance={"model": str(tmp_path / "gone.npz")})
    assert main(["export", str(lost), str(tmp_path / "head.glb")]) == 2
    assert "--model" in capsys.readouterr().err
    assert main(["export", str(lost), str(tmp_path / "head.glb"), "--model", str(MODEL)]) == 0


def test_a_failed_registration_needs_a_word(tmp_path: Path, capsys) -> None:
    failed = a_folder(tmp_path / "failed", status="failed", reason="the mesh moved")
    assert main(["export", str(failed), str(tmp_path / "head.glb")]) == 2
    assert "the mesh moved" in capsys.readouterr().err
    assert main(["export", str(failed), str(tmp_path / "head.glb"), "--failed", "export"]) == 0


def test_arkit_needs_a_neutral_of_a_model_with_lids(folder: Path, tmp_path: Path, capsys) -> None:
    smile = a_folder(tmp_path / "smile", 3, inputs={"model": "ab" * 32, "neutral": "cd" * 32})
    for source, message in (
        (smile, "--arkit has no meaning for this source"),
        (tmp_path, "--arkit has no meaning for this source"),
        (folder, "by which ARKit's shapes are defined"),  # the tiny head has no edges of the lids
    ):
        assert main(["export", str(source), str(tmp_path / "head.usda"), "--arkit"]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "head.usda").exists()


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = a_subject(tmp_path_factory.mktemp("export") / "anna")
    stabilize_run(run, model_path=MODEL)
    for frame in range(2):
        a_folder(run.parent / "frames" / f"{frame}", 3 * frame)
    return run


@pytest.mark.parametrize(
    ("source", "out", "options"),
    [
        ("anna", "expressions.glb", ()),
        ("anna", "frames.usda", ("--sequence", "--fps", "30")),
        ("anna/stabilized", "expressions.usda", ("--subject", "anna")),
        ("frames", "take.usd", ("--frame", "world", "--failed", "skip")),
        ("anna/neutral", "whole.glb", ("--fill-from", "anna/brow", "anna/jaw")),
        ("anna/neutral", "mirrored.obj", ("--fill",)),
    ],
)
def test_every_source_is_exported(source: str, out: str, options: tuple[str, ...], subject: Path, tmp_path, capsys):
    words = [str(subject.parent / word) if "/" in word else word for word in options]
    assert main(["export", str(subject.parent / source), str(tmp_path / out), *words]) == 0
    printed = capsys.readouterr().out.splitlines()
    files = [line for line in printed if line.startswith(str(tmp_path))]
    assert sorted(files) == sorted(str(file) for file in tmp_path.iterdir()) and str(tmp_path / out) in files
    assert any(file.endswith("_unseen.png") for file in files) == any(word.startswith("--fill") for word in options)


@pytest.mark.parametrize(
    ("source", "out", "options", "message"),
    [
        ("anna", "a.obj", (), "cannot hold expressions"),
        ("anna", "a.glb", ("--sequence",), "cannot hold a sequence"),
        ("frames", "a.ply", (), "cannot hold a sequence"),
        ("anna/neutral", "a.ply", ("--fill",), "no texture to fill"),
        ("anna/neutral", "a.obj", ("--arkit",), "cannot hold expressions"),
        ("anna/neutral", "a.glb", ("--sequence",), "--sequence has no meaning"),
        ("anna/neutral", "a.glb", ("--subject", "anna"), "--subject has no meaning"),
        ("anna", "a.glb", ("--arkit",), "--arkit has no meaning"),
        (str(MODEL), "a.glb", ("--fill",), "--fill has no meaning"),
        (str(MODEL), "a.glb", ("--model", str(MODEL)), "--model has no meaning"),
        ("anna/neutral", "a.glb", ("--fps", "0"), "frame rate"),
    ],
)
def test_what_cannot_count_is_refused(source, out, options, message, subject: Path, tmp_path, capsys):
    assert main(["export", str(subject.parent / source), str(tmp_path / out), *options]) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())
