"""Subjects, stabilized sets and sequences as heads to export."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.export.options import ExportOptions
from registration.storage.registration_folder import load_registration
from tests.registration.export.heads import DATA, MODEL, TURN, a_folder, a_subject
from workflows.records.export_source import read_source
from workflows.steps.stabilize import stabilize_run


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = a_subject(tmp_path_factory.mktemp("export") / "anna")
    stabilize_run(folder, model_path=MODEL)
    return folder


def test_expressions_are_shapes_without_the_motion_of_the_head(subject: Path) -> None:
    head = read_source(subject, None).head
    assert head.name == "anna" and list(head.shapes) == ["brow_label", "jaw_label"] and head.frames is None
    for mode, shape in zip((0, 3), head.shapes.values(), strict=True):
        known = DATA.expression_basis[mode].astype(np.float64)
        assert np.abs(shape - known).max() < 0.15 * np.abs(known).max()  # the heads were turned by 3 and 6 degrees
    world = read_source(subject, None, ExportOptions(frame="world")).head
    neutral = load_registration(subject / "neutral")
    np.testing.assert_array_equal(world.vertices, neutral.vertices)
    for shape, turned in zip(head.shapes.values(), world.shapes.values(), strict=True):
        np.testing.assert_allclose(np.linalg.norm(shape, axis=1), np.linalg.norm(turned, axis=1), atol=1e-6)
        assert np.abs(TURN.inv().apply(turned) - shape).max() < 1e-3


def test_a_stabilized_set_has_the_texture_of_the_neutral_beside_it(subject: Path, tmp_path: Path) -> None:
    found = read_source(subject / "stabilized", None)
    direct = read_source(subject, None).head
    assert not found.notes and list(found.head.shapes) == list(direct.shapes)
    np.testing.assert_array_equal(found.head.texture, direct.texture)
    np.testing.assert_allclose(found.head.vertices, direct.vertices, atol=1e-6)
    alone = Path(shutil.copytree(subject / "stabilized", tmp_path / "alone" / "stabilized"))
    bare = read_source(alone, MODEL)
    assert bare.head.texture is None and "no texture" in bare.notes[0]
    with pytest.raises(InputError, match="not found"):
        read_source(alone, None)
    with pytest.raises(InputError, match="no such subject"):
        read_source(alone, MODEL, ExportOptions(subject="bob"))


def test_expressions_are_the_frames_of_a_sequence_if_asked(subject: Path) -> None:
    head = read_source(subject, None, ExportOptions(sequence=True, fps=30)).head
    shapes = read_source(subject, None).head
    assert not head.shapes and head.frames is not None and head.frames_per_second == 30
    for frame, shape in zip(head.frames, shapes.shapes.values(), strict=True):
        np.testing.assert_allclose(frame, shapes.vertices + shape, atol=1e-6)


def test_a_folder_of_registrations_is_a_sequence_in_natural_order(tmp_path: Path) -> None:
    for name, mode in (("frame10", 3), ("frame9", None)):
        a_folder(tmp_path / name, mode)
    head = read_source(tmp_path, None, ExportOptions(frame="world")).head
    expected = [load_registration(tmp_path / name).vertices for name in ("frame9", "frame10")]
    np.testing.assert_allclose(head.frames, np.stack(expected), atol=1e-6)
    upright = read_source(tmp_path, None).head.frames
    motion = TURN.inv().apply(expected[1] - expected[0])
    np.testing.assert_allclose(
        np.linalg.norm(upright[1] - upright[0], axis=1), np.linalg.norm(motion, axis=1), atol=1e-6
    )


def test_mixed_topologies_and_failed_frames_are_refused(tmp_path: Path) -> None:
    a_folder(tmp_path / "a")
    a_folder(tmp_path / "b", status="failed", reason="the mesh moved")
    with pytest.raises(InputError, match="failed"):
        read_source(tmp_path, None)
    skipped = read_source(tmp_path, None, ExportOptions(failed="skip"))
    assert len(skipped.head.frames) == 1 and any("b (failed: the mesh moved)" in note for note in skipped.notes)
    assert len(read_source(tmp_path, None, ExportOptions(failed="export")).head.frames) == 2
    a_folder(tmp_path / "b", triangles=DATA.triangles[::-1].astype(np.int32))
    with pytest.raises(InputError, match="another topology") as error:
        read_source(tmp_path, None)
    assert error.value.where == str(tmp_path / "b")


def test_unfinished_subjects_are_refused_or_named(tmp_path: Path) -> None:
    folder = a_subject(tmp_path / "anna", {"brow": 0}, smile="waiting", jaw="error")
    with pytest.raises(InputError, match="failed or is missing") as error:
        read_source(folder, None)
    assert "--failed skip" in error.value.fix and error.value.got == "waiting why"
    found = read_source(folder, None, ExportOptions(failed="skip"))
    assert list(found.head.shapes) == ["brow_label"]
    assert found.notes == ("left out: smile (waiting: why)", "left out: jaw (error: why)")


def test_a_run_of_subjects_asks_for_one(subject: Path) -> None:
    with pytest.raises(InputError, match="nothing to export") as error:
        read_source(subject.parent, None)
    assert "one of its subjects" in error.value.fix


def test_a_rate_out_of_range_is_refused() -> None:
    for fps in (0.0, -1.0, float("nan"), 1e6):
        with pytest.raises(InputError, match="frame rate"):
            ExportOptions(fps=fps)
