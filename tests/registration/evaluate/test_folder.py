"""`gnmreg evaluate` must store figures only with the registration that they belong to."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.evaluate.folder import evaluate_folder
from registration.storage.hashing import hash_capture, hash_fields
from registration.storage.mesh import write_ply
from registration.storage.registration_folder import load_registration, save_registration
from registration.types import Registration
from tests.registration.capture.small import make
from tests.registration.evaluate.test_evaluation import a_registration


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return make(tmp_path / "capture")


def register(root: Path, out: Path, views: tuple[str, ...] = (), **inputs: str) -> Path:
    """A registration folder that says it is of this capture: its scan, moved by half a millimetre."""
    capture, scan = read_capture(root), read_scan(root / "scan.ply")
    kept = tuple(view for view in capture.views if not views or view.name in views)
    registration = a_registration(
        1.005 * scan.vertices,
        scan.triangles,
        landmarks={},
        inputs={"capture": hash_capture(dataclasses.replace(capture, views=kept)), "model": "m", **inputs},
        config={"views": [view.name for view in kept]},
    )
    return save_registration(registration, out)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_figures_of_the_registered_capture_are_stored(capture: Path, tmp_path: Path) -> None:
    out = register(capture, tmp_path / "out")
    evaluation = evaluate_folder(out, capture)
    stored = load_registration(out).figures
    assert stored == {**evaluation.metrics, "verdict": stored["verdict"]}
    assert stored["verdict"]["level"] == "look"  # half a millimetre
    assert evaluation.metrics["scan_to_mesh"]["face"]["mean_mm"] == pytest.approx(0.45, rel=0.1)


def test_a_registration_of_some_views_is_of_its_capture(capture: Path, tmp_path: Path) -> None:
    out = register(capture, tmp_path / "out", views=("cam0", "cam2", "cam4"))
    evaluate_folder(out, capture)
    assert "scan_to_mesh" in load_registration(out).figures


def test_a_scan_or_a_truth_that_came_later_changes_nothing(capture: Path, tmp_path: Path) -> None:
    scan, truth = ((capture / name).read_bytes() for name in ("scan.ply", "ground_truth.npz"))
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare)
    out = register(bare, tmp_path / "out")
    without = read_capture(bare)
    registration = load_registration(out)
    digest = hash_capture(dataclasses.replace(without, scan=None, ground_truth=None))
    save_registration(dataclasses.replace(registration, inputs={"capture": digest}), out)
    assert (bare / "scan.ply").read_bytes() == scan and (bare / "ground_truth.npz").read_bytes() == truth
    evaluate_folder(out, bare)
    assert "scan_to_mesh" in load_registration(out).figures


def other_scan(root: Path) -> None:
    scan = read_scan(root / "scan.ply")
    write_ply(root / "scan.ply", 1.001 * scan.vertices, scan.triangles)


def other_image(root: Path) -> None:
    first, second = (root / "images" / f"cam{k}.png" for k in (0, 1))
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


def other_landmark(root: Path) -> None:
    path = root / "landmarks" / "cam1.json"
    rows = json.loads(path.read_text())["68"]
    rows[5][0] += 1
    path.write_text(json.dumps({"68": rows}))


def other_subject(root: Path) -> None:
    path = root / "capture.toml"
    path.write_text(path.read_text().replace("ball", "another"))


@pytest.mark.parametrize("change", [other_scan, other_image, other_landmark, other_subject])
def test_another_capture_is_printed_and_nothing_is_stored(
    capture: Path, tmp_path: Path, change: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    out = register(capture, tmp_path / "out")
    other = tmp_path / "other"
    shutil.copytree(capture, other)
    change(other)
    before = contents(out)
    evaluation = evaluate_folder(out, other)
    assert contents(out) == before
    printed = capsys.readouterr().out
    assert "is not the capture that was registered" in printed and "nothing was stored" in printed
    assert evaluation.metrics["scan_to_mesh"]["face"]["points"] > 0 and "Scan to mesh" in printed


def test_a_scan_in_millimetres_is_refused(capture: Path, tmp_path: Path) -> None:
    out = register(capture, tmp_path / "out")
    scan = read_scan(capture / "scan.ply")
    write_ply(capture / "scan.ply", 1e3 * scan.vertices, scan.triangles)
    before = contents(out)
    with pytest.raises(InputError) as error:
        evaluate_folder(out, capture)
    assert "millimetres" in error.value.got and contents(out) == before


def drift_of(capture: Path, neutral_capture: Path, out: Path, neutral: Path) -> Registration:
    evaluate_folder(out, capture, neutral, neutral_capture)
    return load_registration(out)


def test_the_drift_is_stored_with_the_neutral_that_belongs_to_it(capture: Path, tmp_path: Path) -> None:
    neutral = register(capture, tmp_path / "neutral")
    out = register(capture, tmp_path / "out", neutral=hash_fields(load_registration(neutral)))
    assert "drift" in drift_of(capture, capture, out, neutral).figures
    evaluate_folder(out, capture)  # without the neutral: the drift is kept
    figures = load_registration(out).figures
    assert "drift" in figures and "drift" not in figures["unmeasured"]


@pytest.mark.parametrize("kind", ["another neutral", "another person", "another capture", "another model"])
def test_a_neutral_that_does_not_belong_to_it_is_told(
    capture: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(capture, other)
    if kind == "another person":
        other_subject(other)
    neutral = register(other, tmp_path / "neutral", **({"model": "n"} if kind == "another model" else {}))
    if kind == "another capture":
        other_image(other)
    start = hash_fields(load_registration(neutral))
    out = register(capture, tmp_path / "out", neutral="0" * 64 if kind == "another neutral" else start)
    assert "drift" not in drift_of(capture, other, out, neutral).figures
    printed = capsys.readouterr().out
    expected = {
        "another neutral": "started from another neutral",
        "another person": "the neutral shows another",
        "another capture": "is not the capture of the neutral",
        "another model": "with another model",
    }
    assert expected[kind] in printed and "nothing was stored" in printed
