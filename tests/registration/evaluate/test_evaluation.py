"""Metrics with known values: spheres at known distances, ground truths translated by known amounts."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rich.console import Console

from registration.capture.native import read_capture
from registration.capture.scan import read_scan, read_truth
from registration.errors import InputError
from registration.evaluate.console_table import print_assessment, print_metrics
from registration.evaluate.evaluation import evaluate_registration
from registration.evaluate.folder import evaluate_folder
from registration.evaluate.residuals import residual_figures
from registration.storage.hashing import hash_capture
from registration.storage.mesh import write_ply
from registration.storage.registration_folder import load_registration, save_registration
from registration.types import Camera, Capture, Registration, View
from tests.conftest import SHARED, needs_shared

RADIUS = 0.1
BALL = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
POINTS, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)


def a_camera(angle: float) -> Camera:
    """A metre from the origin in the x-z plane, looking at it; angle 0 is +z."""
    back = np.array([np.sin(angle), 0, np.cos(angle)])
    right = np.array([np.cos(angle), 0, -np.sin(angle)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, [0, -1, 0], -back])
    pose[2, 3] = 1.0
    intrinsics = np.array([[1000.0, 0, 150], [0, 1000, 150], [0, 0, 1]])
    return Camera(width_px=300, height_px=300, intrinsics=intrinsics, T_cam_world=pose)


def landmarks() -> np.ndarray:
    """A face on the sphere's +z side: sphere centre (0, 0, 0.1), radius 1.4 (0.06 + 0.04) / 2 = 0.07."""
    points = np.zeros((68, 3), np.float32)
    points[33], points[27] = [0, -0.012, 0.1], [0, 0.028, 0.1]
    points[36], points[45] = [-0.03, 0, 0.1], [0.03, 0, 0.1]
    return points


def a_registration(vertices=POINTS, triangles=FACES, **changes) -> Registration:
    def zeros(*shape):
        return np.zeros(shape, np.float32)

    fields = dict(
        status="converged",
        reason="",
        identity=zeros(1),
        expression=zeros(1),
        rotations=zeros(1, 3),
        translation=zeros(3),
        scale=np.array(1, np.float32),
        offsets=zeros(len(vertices), 3),
        vertices=vertices.astype(np.float32),
        triangles=triangles.astype(np.int32),
        confidence=zeros(len(vertices)),
        texture=zeros(2, 2, 3),
        corner_uvs=zeros(len(triangles), 3, 2),
        landmarks={"68": landmarks()},
    )
    return Registration(**{**fields, **changes})


def a_capture(root: Path, scan=POINTS, faces=FACES, truth=None, angles=(-0.4, 0.0, 0.4)) -> Capture:
    root.mkdir(parents=True, exist_ok=True)
    write_ply(root / "scan.ply", scan, faces)
    if truth is not None:
        np.savez(root / "ground_truth.npz", vertices=truth.astype(np.float32))
    views = tuple(View(name=f"{a}", camera=a_camera(a), image=root / "unread.png") for a in angles)
    ground = root / "ground_truth.npz" if truth is not None else None
    return Capture(root=root, subject="s", expression="e", views=views, scan=root / "scan.ply", ground_truth=ground)


@pytest.mark.parametrize("grown_mm", [-2.0, 0.5])
def test_spheres_at_a_known_distance(tmp_path, grown_mm):
    grown = POINTS * (1 + grown_mm * 1e-3 / RADIUS)
    evaluation = evaluate_registration(a_registration(grown), a_capture(tmp_path))
    for kind, where in [("scan_to_mesh", "face"), ("scan_to_mesh", "seen"), ("mesh_to_scan", "face")]:
        row = evaluation.metrics[kind][where]
        assert row["mean_mm"] == pytest.approx(abs(grown_mm), rel=0.01), (kind, where)
        assert row["median_mm"] == pytest.approx(abs(grown_mm), rel=0.01) and row["std_mm"] < 0.01
    by_area = evaluation.metrics["scan_to_mesh_by_area"]["face"]
    assert by_area["mean_mm"] == pytest.approx(abs(grown_mm), rel=0.01)
    assert by_area["points"] == 100_000 and by_area["dropped_normals"] == by_area["dropped_boundary"] == 0


def test_the_face_is_visible_to_two_cameras_and_in_the_sphere(tmp_path):
    evaluation = evaluate_registration(a_registration(), a_capture(tmp_path, angles=(0.0, 1.0, 2.5)))
    normals = POINTS / RADIUS
    eyes = np.stack([a_camera(a).centre for a in (0.0, 1.0, 2.5)])
    towards = eyes[:, None] - POINTS
    facing = (towards * normals).sum(-1) / np.linalg.norm(towards, axis=-1)
    clear = (np.abs(facing) > 0.1).all(0)
    np.testing.assert_array_equal(evaluation.scan_visible[clear], ((facing > 0).sum(0) >= 2)[clear])
    near = np.linalg.norm(POINTS - [0, 0, 0.1], axis=1) <= 0.07
    np.testing.assert_array_equal(evaluation.scan_face, evaluation.scan_visible & near)
    assert evaluation.metrics["scan_to_mesh"]["face"]["points"] == evaluation.scan_face.sum() > 100
    assert evaluation.metrics["face_ball"]["radius_mm"] == pytest.approx(70, rel=1e-5)
    np.testing.assert_array_equal(np.isfinite(evaluation.vertex_distance_mm)[clear], evaluation.scan_visible[clear])


def test_sliding_gives_no_distance_but_a_vertex_error(tmp_path):
    rotation = trimesh.transformations.rotation_matrix(0.01, [0, 1, 0])[:3, :3]
    evaluation = evaluate_registration(a_registration(POINTS @ rotation.T), a_capture(tmp_path, truth=POINTS))
    assert evaluation.metrics["scan_to_mesh"]["face"]["mean_mm"] < 0.05
    across = np.linalg.norm(POINTS[evaluation.scan_face][:, [0, 2]], axis=1)
    expected = 2 * np.sin(0.005) * across * 1e3
    assert evaluation.metrics["vertex_error"]["face"]["mean_mm"] == pytest.approx(expected.mean(), rel=1e-3)
    assert evaluation.metrics["vertex_error"]["face"]["points"] == evaluation.scan_face.sum()


def test_figures_do_not_depend_on_the_worlds_origin(tmp_path):
    shift = np.array([512345.25, 5403210.5, 412.125])
    grown = (POINTS * (1 + 0.5e-3 / RADIUS)).astype(np.float32)
    capture, near = a_capture(tmp_path / "near", truth=POINTS), a_registration(grown)
    far = dataclasses.replace(near, vertices=grown + shift, landmarks={"68": landmarks() + shift})
    np.savez(tmp_path / "near" / "ground_truth.npz", vertices=POINTS)
    far_capture = a_capture(tmp_path / "far", scan=POINTS + shift).cameras_relative_to(-shift)
    np.savez(tmp_path / "far" / "ground_truth.npz", vertices=POINTS + shift)
    far_capture = dataclasses.replace(far_capture, ground_truth=tmp_path / "far" / "ground_truth.npz")
    a, b = evaluate_registration(near, capture).metrics, evaluate_registration(far, far_capture).metrics
    assert a.keys() == b.keys() and "vertex_error" in a
    np.testing.assert_allclose(np.subtract(b["face_ball"]["centre"], shift), a["face_ball"]["centre"], atol=1e-7)
    for figure in a.keys() - {"face_ball"}:
        for where, row in a[figure].items():
            assert b[figure][where] == pytest.approx(row, abs=1e-3), (figure, where)


def test_a_hole_in_the_scan_shows_only_from_the_mesh(tmp_path):
    hole = np.linalg.norm(POINTS[FACES].mean(1) - [0, 0, RADIUS], axis=1) < 0.02
    whole = evaluate_registration(a_registration(), a_capture(tmp_path / "whole")).metrics
    holed = evaluate_registration(a_registration(), a_capture(tmp_path / "holed", faces=FACES[~hole])).metrics
    assert holed["scan_to_mesh"]["face"]["mean_mm"] < 1e-4
    assert whole["mesh_to_scan"]["face"]["p95_mm"] < 1e-4
    assert holed["mesh_to_scan"]["face"]["p95_mm"] > 5


def test_turned_normals_and_the_mesh_boundary_are_excluded_and_counted(tmp_path):
    capture = a_capture(tmp_path)

    def by_area(triangles: np.ndarray) -> dict:
        evaluation = evaluate_registration(a_registration(triangles=triangles), capture)
        return evaluation.metrics["scan_to_mesh_by_area"]["face"]

    half = FACES[POINTS[FACES].mean(1)[:, 0] < 0]  # the mesh ends at x = 0, in the middle of the face
    cut = by_area(half)
    assert 0.4 < cut["dropped_boundary"] < 0.6 and cut["dropped_normals"] == 0
    assert cut["mean_mm"] < 0.01 and cut["points"] == round(100_000 * (1 - cut["dropped_boundary"]))
    inside_out = by_area(FACES[:, ::-1])  # of the registration, which is a defect
    assert inside_out["dropped_normals"] == 1 and inside_out["mean_mm"] is None


@pytest.mark.parametrize("share", [1, 2])
def test_the_winding_of_a_scan_makes_no_difference(tmp_path, share):
    wound = FACES.copy()
    wound[::share] = wound[::share, ::-1]
    expected, turned = (
        evaluate_registration(a_registration(1.01 * POINTS), a_capture(tmp_path / name, faces=faces)).metrics
        for name, faces in (("as it is", FACES), ("turned", wound))
    )
    assert turned["scan_to_mesh_by_area"]["face"]["dropped_normals"] == 0
    for kind in ("scan_to_mesh", "scan_to_mesh_by_area", "mesh_to_scan"):
        assert turned[kind]["face"]["mean_mm"] == pytest.approx(expected[kind]["face"]["mean_mm"], rel=1e-3)


def test_a_missing_metric_has_a_reason(tmp_path):
    far = evaluate_registration(a_registration(), a_capture(tmp_path / "far", scan=POINTS + [0, 0.5, 0])).metrics
    assert far["scan_to_mesh"]["face"]["mean_mm"] is None
    assert "no vertex of the scan lies in the face" in far["unmeasured"]["scan_to_mesh"]
    assert far["unmeasured"].keys() >= {"scan_to_mesh", "scan_to_mesh_by_area", "vertex_error", "drift"}
    plain = evaluate_registration(a_registration(), a_capture(tmp_path / "plain")).metrics["unmeasured"]
    assert plain.keys() == {"vertex_error", "drift"} and "no ground_truth.npz" in plain["drift"]
    short = a_capture(tmp_path / "short", truth=POINTS[:-1])
    unmeasured = evaluate_registration(a_registration(), short).metrics["unmeasured"]
    assert f"{len(POINTS) - 1} vertices, the mesh {len(POINTS)}" in unmeasured["vertex_error"]
    assert "needs the registration and the capture" in unmeasured["drift"]
    others = [short, dataclasses.replace(short, ground_truth=None), dataclasses.replace(short, scan=None)]
    for neutral_capture, why in zip(others, ("", "no ground_truth.npz", "no scan"), strict=True):
        metrics = evaluate_registration(
            a_registration(), short, neutral=a_registration(), neutral_capture=neutral_capture
        ).metrics
        assert ("drift" in metrics) == (why == "") and why in metrics["unmeasured"].get("drift", "")
    inside = evaluate_registration(a_registration(triangles=FACES[:, ::-1]), a_capture(tmp_path / "in")).metrics
    assert "100% for their normals" in inside["unmeasured"]["scan_to_mesh_by_area"]
    console = Console(file=io.StringIO(), width=200)
    print_metrics(far, "title", console)
    assert "Scan to mesh: not measured: no vertex of the scan lies in the face" in console.file.getvalue()


def test_regions_split_mesh_to_scan(tmp_path):
    pushed = POINTS * np.where(POINTS[:, :1] > 0, 1.01, 1.0)
    regions = {"left": POINTS[:, 0] > 0.01, "right": POINTS[:, 0] < -0.01, "nothing": np.zeros(len(POINTS), bool)}
    evaluation = evaluate_registration(a_registration(pushed), a_capture(tmp_path), regions=regions)
    metrics = evaluation.metrics["mesh_to_scan"]
    assert metrics["left"]["mean_mm"] == pytest.approx(1, rel=0.02) and metrics["right"]["mean_mm"] < 0.01
    assert metrics["nothing"] == {"points": 0, "mean_mm": None, "median_mm": None, "std_mm": None, "p95_mm": None}


def test_a_point_cloud_has_distances_and_no_surface_metrics(tmp_path):
    evaluation = evaluate_registration(a_registration(POINTS * 1.01), a_capture(tmp_path, faces=np.zeros((0, 3), int)))
    assert evaluation.metrics["scan_to_mesh"]["face"]["mean_mm"] == pytest.approx(1, rel=0.02)
    assert set(evaluation.metrics) == {"face_ball", "scan_to_mesh", "unmeasured"}
    assert np.isnan(evaluation.vertex_distance_mm).all()
    for name in ("scan_to_mesh_by_area", "mesh_to_scan"):
        assert "point cloud" in evaluation.metrics["unmeasured"][name]
    assert 0.2 < evaluation.scan_visible.mean() < 0.6  # the far side is hidden by the registered surface


def test_drift_is_motion_of_the_mesh_against_the_truth(tmp_path):
    """Another topology for the truth: a finer sphere. Truth and registration move by known amounts."""
    fine = np.asarray(trimesh.creation.icosphere(subdivisions=5, radius=RADIUS).vertices)
    start = a_capture(tmp_path / "0", truth=fine)
    end = a_capture(tmp_path / "1", scan=POINTS + [0, 0.01, 0], truth=fine + [0, 0.01, 0])
    neutral = a_registration()
    follows = a_registration(POINTS + [0, 0.01, 0])
    slides = a_registration(POINTS + [0.002, 0.01, 0])

    def drift(registration):
        return evaluate_registration(registration, end, neutral=neutral, neutral_capture=start).metrics["drift"]["face"]

    assert drift(follows)["mean_mm"] == pytest.approx(drift(follows)["carried_mm"], abs=1e-4)
    assert drift(follows)["mean_mm"] < 0.1  # the facets' depth
    assert drift(slides)["mean_mm"] == pytest.approx(2, abs=0.1)
    assert "vertex_error" not in evaluate_registration(follows, end).metrics  # the truth is of another topology


def test_what_cannot_be_evaluated(tmp_path):
    capture = a_capture(tmp_path, truth=POINTS)
    with pytest.raises(InputError, match="no scan"):
        evaluate_registration(a_registration(), dataclasses.replace(capture, scan=None))
    with pytest.raises(InputError, match="face cannot be located"):
        evaluate_registration(a_registration(landmarks={}), capture)
    with pytest.raises(InputError, match="neutral is incomplete"):
        evaluate_registration(a_registration(), capture, neutral=a_registration())
    with pytest.raises(InputError, match="different topologies"):
        other = a_registration(triangles=FACES[1:])
        evaluate_registration(a_registration(), capture, neutral=other, neutral_capture=capture)


def test_the_table_prints_every_metric(tmp_path):
    metrics = evaluate_registration(a_registration(POINTS * 1.01), a_capture(tmp_path, truth=POINTS)).metrics
    console = Console(file=io.StringIO(), width=120)
    print_metrics(metrics, "title", console)
    text = console.file.getvalue()
    for name in ("Scan to mesh", "Scan to mesh, by area", "Mesh to scan", "Vertex error", "1.000"):
        assert name in text
    assert "Drift from the neutral: not measured" in text


def test_residuals_and_the_verdict_are_printed():
    views = {"cam00": {"silhouette_px": 0.5}, "cam[b]01": {"silhouette_px": 1.5}}
    figures = {"residuals": residual_figures(views), "verdict": {"level": "look", "reasons": ["first", "second"]}}
    console = Console(file=io.StringIO(), width=120)
    print_assessment(figures, console)
    text = console.file.getvalue().replace("\N{NO-BREAK SPACE}", " ")
    assert "silhouette" in text and "1.0 px" in text and "1.5 px" in text and "cam[b]01" in text
    assert "normals" not in text and "verdict: look at it: first; second" in text
    print_assessment({}, silent := Console(file=io.StringIO()))
    assert silent.file.getvalue() == ""


def truth_registration(capture: Capture) -> Registration:
    with np.load(SHARED / "data/gnm/gnm_head_reconstructed.npz") as model:
        triangles = model["triangles"]
    return a_registration(read_truth(capture.ground_truth), triangles, landmarks={})


@needs_shared
def test_the_truth_has_no_error_and_metrics_are_stored(tmp_path, capsys):
    root = SHARED / "data/captures/gnm_identity_a/neutral"
    capture = read_capture(root)
    registration = dataclasses.replace(truth_registration(capture), inputs={"capture": hash_capture(capture)})
    save_registration(registration, tmp_path / "r", report_html="kept")
    evaluation = evaluate_folder(tmp_path / "r", root)
    stored = load_registration(tmp_path / "r").figures
    assert stored["vertex_error"]["face"]["mean_mm"] == 0 and stored["scan_to_mesh"]["face"]["p95_mm"] < 1e-6
    assert stored["face_ball"]["landmarks"] == "capture"
    assert 4000 < stored["scan_to_mesh"]["face"]["points"] < 7000
    assert stored.pop("verdict")["level"] == "good"
    assert stored == evaluation.metrics and "Vertex error" in capsys.readouterr().out
    assert (tmp_path / "r" / "report.html").read_text() == "kept"


@needs_shared
@pytest.mark.slow
def test_truths_of_two_expressions_do_not_drift():
    neutral, happy = (read_capture(SHARED / f"data/captures/gnm_identity_a/{name}") for name in ("neutral", "happy"))
    evaluation = evaluate_registration(
        truth_registration(happy), happy, neutral=truth_registration(neutral), neutral_capture=neutral
    ).metrics
    assert evaluation["drift"]["face"]["mean_mm"] == 0 and evaluation["vertex_error"]["face"]["mean_mm"] == 0


@needs_shared
@pytest.mark.slow
def test_another_topology_has_drift_but_no_vertex_error():
    neutral, smile = (read_capture(SHARED / f"data/captures/ict_dev/{name}") for name in ("neutral", "smile"))
    meshes = [read_scan(capture.scan) for capture in (neutral, smile)]
    start, end = (a_registration(m.vertices, m.triangles, landmarks={}) for m in meshes)
    metrics = evaluate_registration(end, smile, neutral=start, neutral_capture=neutral).metrics
    assert metrics["scan_to_mesh"]["face"]["mean_mm"] < 1e-4 and "vertex_error" not in metrics
    assert metrics["drift"]["face"]["mean_mm"] < 1e-3
