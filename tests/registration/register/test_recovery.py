"""A registration of a synthetic capture recovers its ground truth."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from registration.model.gnm import GNM
from registration.model.gnm_npz import read
from registration.model.regions import group, neck_other
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.render import backend
from registration.storage.registration_folder import FILES, load_registration
from registration.types import Parameters, Registration
from tests.registration.register.conftest import RegisterProcess, Run
from tests.registration.register.synthetic import GAINS, MODEL
from workflows.cli.app import main

VIEWS = 8


def face(run: Run) -> np.ndarray:
    """Skin within 9 cm of the bridge of the nose, where most cameras look."""
    data = read(MODEL)
    bridge = run.result.landmarks["68"][27]
    near = np.linalg.norm(run.truth.vertices - bridge, axis=1) < 0.09
    return near & (group(data, "skin_exterior") > 0.5) & ~neck_other(data)


def scan_to_mesh(run: Run) -> dict[str, float]:
    return run.result.figures["scan_to_mesh"]["face"]


def same_mesh(result: Registration, vertices: np.ndarray) -> float:
    """The largest difference (m) between `vertices` and the model's, evaluated in double precision."""
    names = ("identity", "expression", "rotations", "translation", "scale")
    parameters = Parameters(**{name: torch.tensor(getattr(result, name), dtype=torch.float64) for name in names})
    model = GNM(read(MODEL), torch.float64)
    rebuilt = model(parameters, torch.tensor(result.offsets, dtype=torch.float64)).numpy()
    return float(np.abs(rebuilt - vertices).max())


def test_surface_vertices_and_status(registered: Run):
    skin = registered.error_mm[face(registered)]
    print(f"face: vertices {skin.mean():.3f} mm, scan to mesh {scan_to_mesh(registered)}")
    assert registered.result.status == "converged", registered.result.reason
    assert scan_to_mesh(registered)["mean_mm"] < 0.12
    assert skin.mean() < 0.45


def test_the_fit_needs_offsets(registered: Run):
    """The ground truth has bumps of a millimetre on the model: a fit without offsets must miss them."""
    result = registered.result
    model = GNM(read(MODEL))
    names = ("identity", "expression", "rotations", "translation", "scale")
    parameters = Parameters(**{name: torch.tensor(getattr(result, name)) for name in names})
    plain = model(parameters).numpy()
    normal_error = np.linalg.norm(plain - registered.truth.vertices, axis=1)[face(registered)] * 1e3
    assert normal_error.mean() > 2 * registered.error_mm[face(registered)].mean()


def test_camera_gains_are_recovered(registered: Run):
    gains = np.array(registered.result.figures["camera_gains"])
    assert gains.shape == (VIEWS, 3)
    relative = gains / np.exp(np.log(gains).mean(0))
    truth = GAINS / np.exp(np.log(GAINS).mean())
    error = np.abs(relative / truth[:, None] - 1)
    print(f"gains: error {100 * error.mean():.2f} % in the mean, {100 * error.max():.2f} % at most")
    assert error.max() < 0.06


def test_parameters_reproduce_the_vertices(registered: Run, smile: Run):
    for run in (registered, smile):
        assert same_mesh(run.result, run.result.vertices) < 1e-5


def test_files_of_the_registration_folder(registered: Run):
    out, result, data = registered.out, registered.result, read(MODEL)
    assert sorted(file.name for file in out.iterdir()) == sorted(FILES)
    stored = load_registration(out)
    for name in ("identity", "expression", "rotations", "translation", "scale", "offsets", "vertices", "confidence"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(result, name))
    assert stored.triangles.tolist() == data.triangles.tolist()
    mesh = trimesh.load(out / "mesh.ply", process=False, maintain_order=True)
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), result.vertices)
    assert mesh.faces.tolist() == data.triangles.tolist()


def test_the_manifest_records_inputs_and_configuration(registered: Run):
    manifest = json.loads((registered.out / "manifest.json").read_text())
    stages = [stage["name"] for stage in manifest["config"]["recipe"]["stages"]]
    assert manifest["config"]["seed"] == 0
    assert manifest["config"]["views"] == [f"cam{i}" for i in range(VIEWS)]
    assert {"targets", "start", *stages} == set(manifest["seconds"])
    assert all(seconds > 0 for seconds in manifest["seconds"].values())
    assert {"mitsuba", "drjit", "torch", "gnm-registration", "python"} <= set(manifest["versions"])
    assert {"capture", "model", "landmarks 68"} == set(manifest["inputs"])
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in manifest["inputs"].values())
    assert {"scan_to_mesh", "vertex_error", "landmark_residual_px", "motion_mm"} <= set(manifest["figures"])
    assert list(registered.result.history) == stages
    assert registered.progress.stages == ["reading views", *stages]


def test_the_report_is_self_contained(registered: Run):
    page = (registered.out / "report.html").read_text()
    assert page.count("data:image/") >= 3 * VIEWS
    links = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', page)
    files = {file.name for file in registered.out.iterdir()}  # the page links them and works without them
    assert [link for link in links if not link.startswith(("data:", "#")) and link not in files] == []
    assert not re.search(r"<script[^>]+src|@import|url\((?!['\"]?(?:data:|#))", page)


class Computing(Exception):
    """The renderer was about to start."""


@pytest.fixture
def no_compute(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*args, **kwargs):
        raise Computing

    monkeypatch.setattr(backend, "activate", stop)


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {file.name: (file.stat().st_mtime_ns, file.read_bytes()) for file in folder.iterdir()}


def test_equal_inputs_return_the_existing_result(registered: Run, no_compute: None):
    before = contents(registered.out)
    result = register(registered.truth.root, MODEL, registered.out)
    np.testing.assert_array_equal(result.vertices, registered.result.vertices)
    assert contents(registered.out) == before


@pytest.mark.parametrize(
    "change", [{"force": True}, {"seed": 1}, {"views": 4}, {"recipe": "studio"}, {"deterministic": True}]
)
def test_force_and_changed_settings_compute_again(change: dict, registered: Run, no_compute: None):
    before = contents(registered.out)
    with pytest.raises(Computing):
        force = "force" in change
        register(registered.truth.root, MODEL, registered.out, RegisterOptions(**{} if force else change), force=force)
    assert contents(registered.out) == before


def test_equal_seeds_give_equal_results(registered: Run, again: Run):
    motion = 1e3 * np.linalg.norm(registered.result.vertices - again.result.vertices, axis=1)
    print(f"two runs: vertices {motion.max():.5f} mm apart at most")
    assert motion.max() < 0.01


@pytest.mark.slow
def test_deterministic_runs_are_bitwise_equal(deterministic: list[RegisterProcess]):
    first, second = (process.run().out for process in deterministic)
    with np.load(first / "registration.npz") as a, np.load(second / "registration.npz") as b:
        assert a.files == b.files
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    for name in ("texture.png", "mesh.ply", "mesh.obj", "history.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    ids = {json.loads((out / "manifest.json").read_text())["content_id"] for out in (first, second)}
    assert len(ids) == 1


def test_the_command_prints_and_uses_the_requested_views(deterministic: list[RegisterProcess]):
    ended = deterministic[0].run()
    result, log = ended.result, "\n".join(ended.progress.notes)
    assert deterministic[0].stdout.endswith(f"{result.status}: {result.reason}\n{ended.out}\n")
    assert "verdict: " in deterministic[0].stdout and "residuals" in deterministic[0].stdout
    assert "reading views: 0/3" in log and "offsets" in log
    assert len(result.config["views"]) == 3 and result.config["views"][0] == "cam0"
    assert result.config["seed"] == 5 and result.config["deterministic"] is True
    assert len(result.figures["camera_gains"]) == 3
    assert scan_to_mesh(ended)["mean_mm"] < 0.5


def test_evaluate_prints_and_stores_the_drift(registered: Run, smile: Run, tmp_path: Path, capsys):
    out = shutil.copytree(smile.out, tmp_path / "smile")
    neutral = ["--neutral", str(registered.out), "--neutral-capture", str(registered.truth.root)]
    assert main(["evaluate", str(out), "--capture", str(smile.truth.root), *neutral]) == 0
    drift = json.loads((out / "manifest.json").read_text())["figures"]["drift"]["face"]
    print(f"smile: drift {drift}")
    assert "drift" in capsys.readouterr().out
    assert 0 < drift["mean_mm"] < 0.6
    assert load_registration(out).figures["scan_to_mesh"] == smile.result.figures["scan_to_mesh"]


def test_expression_from_its_neutral(registered: Run, smile: Run):
    start, result = registered.result, smile.result
    np.testing.assert_array_equal(result.identity, start.identity)
    assert result.scale == start.scale
    skin = face(smile)
    offset_change_mm = 1e3 * np.linalg.norm(result.offsets - start.offsets, axis=1)[skin]
    error = smile.error_mm[skin]
    print(
        f"smile: vertices {error.mean():.3f} mm, offset change {offset_change_mm.mean():.3f} mm, {scan_to_mesh(smile)}"
    )
    assert result.status == "converged", result.reason
    assert scan_to_mesh(smile)["mean_mm"] < 0.15
    assert error.mean() < 0.6
    assert offset_change_mm.mean() < 0.5
    jaw = list(read(MODEL).expression_names).index("lower_face_region_000")
    assert result.expression[jaw] - start.expression[jaw] == pytest.approx(0.35, abs=0.25)
    free = {name for stage in result.config["recipe"]["stages"] for name, _ in stage["free"]}
    assert free.isdisjoint({"identity", "scale"})
    assert set(result.inputs) == {"capture", "model", "landmarks 68", "neutral"}


def test_registration_without_landmarks(registered: Run, without_landmarks: Run):
    assert any("no landmarks: best of 24 head poses" in message for message in without_landmarks.progress.notes)
    error = without_landmarks.error_mm[face(without_landmarks)]
    print(f"without landmarks: vertices {error.mean():.3f} mm, {scan_to_mesh(without_landmarks)}")
    assert without_landmarks.result.status == "converged", without_landmarks.result.reason
    assert scan_to_mesh(without_landmarks)["mean_mm"] < scan_to_mesh(registered)["mean_mm"] + 0.05
    assert error.mean() < 0.8
