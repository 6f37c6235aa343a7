"""A scan as it is used: without what programs leave behind in the file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.capture.scan import read_scan, read_truth, unread_scans
from registration.errors import InputError
from registration.storage.mesh import write_ply

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
POINTS, FACES = np.asarray(BALL.vertices).astype(np.float32).astype(np.float64), np.asarray(BALL.faces)


def test_vertices_that_no_face_uses_are_left_out_and_counted(tmp_path: Path) -> None:
    stray = 1.04 * POINTS[:40]
    write_ply(tmp_path / "scan.ply", np.concatenate([stray[:20], POINTS, stray[20:]]), FACES + 20)
    scan = read_scan(tmp_path / "scan.ply")
    np.testing.assert_array_equal(scan.vertices, POINTS)
    np.testing.assert_array_equal(scan.triangles, FACES)
    assert scan.unused_vertices == 40 and scan.unused_faces == 0


def test_stray_vertices_need_not_be_finite(tmp_path: Path) -> None:
    write_ply(tmp_path / "scan.ply", np.concatenate([POINTS, np.full((3, 3), np.nan)]), FACES)
    assert read_scan(tmp_path / "scan.ply").unused_vertices == 3


def test_repeated_and_degenerate_faces_are_left_out_and_counted(tmp_path: Path) -> None:
    turned, points = np.roll(FACES[:30], 1, 1)[:, ::-1], np.repeat(FACES[:20, :1], 3, 1)
    lines = FACES[:10, [0, 1, 0]]
    write_ply(tmp_path / "scan.ply", POINTS, np.concatenate([points, FACES, turned, lines, FACES[:5]]))
    scan = read_scan(tmp_path / "scan.ply")
    np.testing.assert_array_equal(scan.triangles, FACES)
    assert scan.unused_faces == 20 + 30 + 10 + 5 and scan.unused_vertices == 0


def test_faces_without_any_area_leave_a_point_cloud(tmp_path: Path) -> None:
    write_ply(tmp_path / "scan.ply", POINTS, np.repeat(FACES[:, :1], 3, 1))
    scan = read_scan(tmp_path / "scan.ply")
    np.testing.assert_array_equal(scan.vertices, POINTS)
    assert not len(scan.triangles) and scan.unused_faces == len(FACES) and scan.unused_vertices == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_vertex_that_cannot_be_measured_is_refused(tmp_path: Path, value: float) -> None:
    points = POINTS.copy()
    points[7, 1] = value
    write_ply(tmp_path / "scan.ply", points, FACES)
    with pytest.raises(InputError) as error:
        read_scan(tmp_path / "scan.ply")
    assert "vertex 7" in error.value.got


@pytest.mark.parametrize("corner", [-1, len(POINTS)])
def test_indices_of_missing_vertices_are_refused(tmp_path: Path, corner: int) -> None:
    faces = FACES.copy()
    faces[3, 2] = corner
    write_ply(tmp_path / "scan.ply", POINTS, faces)
    with pytest.raises(InputError) as error:
        read_scan(tmp_path / "scan.ply")
    assert str(corner) in error.value.got


def test_files_that_look_like_a_scan_but_are_not_read_are_named(tmp_path: Path) -> None:
    names = ["SCAN.PLY", "head.stl", "scan.ply.gz", "scan.stl"]
    for name in (
        *names,
        "scan.ply",
        "scan.obj",
        "scan.glb",
        "capture.toml",
        "ground_truth.npz",
        "scan.png",
        "notes.txt.gz",
    ):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "meshes.obj").mkdir()
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "scan.ply").write_bytes(b"")
    assert unread_scans(tmp_path) == [*names, "scans/scan.ply"]


def test_a_ground_truth_without_vertices_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "ground_truth.npz", vertices=np.zeros((0, 3)))
    with pytest.raises(InputError):
        read_truth(tmp_path / "ground_truth.npz")
