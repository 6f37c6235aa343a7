"""A mesh in another unit or frame than the cameras must be refused with the reason, or warned of; no other mesh may be.

The mesh is a bumpy ellipsoid without any symmetry, which lies to one side of the world's origin.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from jaxtyping import Float

from registration.capture.native import read_capture
from registration.capture.scan import Scan, read_scan
from registration.doctor.report import check_capture
from registration.doctor.scan_checks import scan_facts, scan_warnings
from registration.doctor.scan_frame import require_frame, surface_landmarks
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.storage.mesh import write_ply
from registration.types import Capture, View
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.small import YAWS_RAD, camera, make

BALL = trimesh.creation.icosphere(subdivisions=5)
FACES = np.asarray(BALL.faces)
NONE = np.zeros((0, 3))
Points = Float[np.ndarray, "P 3"]


def head() -> Points:
    unit = np.asarray(BALL.vertices)
    x, y, z = unit.T
    bumps = 1 + 0.12 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.1 * np.exp(-20 * ((x - 0.2) ** 2 + y**2)) * (z > 0)
    return bumps[:, None] * unit * [0.07, 0.1, 0.085] + [0.02, 0.03, 0.01]


HEAD = head()
LANDMARKS = HEAD[HEAD[:, 2] > 0.06][::20]


def a_capture(root: Path, masks: bool = False) -> Capture:
    views = []
    for number, yaw_rad in enumerate(YAWS_RAD):
        view = View(name=f"cam{number}", camera=camera(yaw_rad), image=root / "unread.png")
        if masks:
            root.mkdir(exist_ok=True)
            xy = view.camera.project(HEAD)[0].astype(np.int32)
            mask = np.zeros((view.camera.height_px, view.camera.width_px), np.uint8)
            cv2.fillConvexPoly(mask, cv2.convexHull(xy), 255)
            cv2.imwrite(str(root / f"cam{number}.png"), mask)
            view = replace(view, mask=root / f"cam{number}.png")
        views.append(view)
    return Capture(root=root, subject="s", expression="e", views=tuple(views))


EXPORTS: dict[str, tuple[Callable[[Points], Points], str]] = {
    "millimetres": (lambda v: 1e3 * v, "it is in millimetres"),
    "centimetres": (lambda v: 1e2 * v, "it is in centimetres"),
    "kilometres": (lambda v: 1e-3 * v, "it is in kilometres"),
    "inches": (lambda v: v / 0.0254, "it is in inches"),
    "z up": (lambda v: v[:, [0, 2, 1]] * [1, -1, 1], "it is turned: the world is its (x, z, -y)"),
    "z up in millimetres": (
        lambda v: 1e3 * v[:, [0, 2, 1]] * [1, -1, 1],
        "it is in millimetres and turned: the world is its (x, z, -y)",
    ),
    "axes exchanged": (lambda v: v[:, [2, 0, 1]], "it is turned: the world is its (y, z, x)"),
    "y and z down": (lambda v: v * [1, -1, -1], "it is turned: the world is its (x, -y, -z)"),
    "elsewhere": (lambda v: v + [0, 1.0, 0], "in another unit or frame"),
    "with its own origin, in millimetres": (lambda v: 1e3 * v + [0, 0, 900], "in another unit or frame"),
}


@pytest.mark.parametrize("export", EXPORTS)
def test_a_mesh_that_is_not_at_the_landmarks_is_refused(tmp_path: Path, export: str) -> None:
    change, message = EXPORTS[export]
    with pytest.raises(InputError) as error:
        require_frame("scan", tmp_path / "scan.ply", change(HEAD), a_capture(tmp_path), LANDMARKS)
    assert message in str(error.value) and "metres" in error.value.fix


@pytest.mark.parametrize("export", ["millimetres", "centimetres", "z up in millimetres", "elsewhere"])
@pytest.mark.parametrize("masks", [True, False])
def test_without_landmarks_the_cameras_tell(tmp_path: Path, export: str, masks: bool) -> None:
    change, message = EXPORTS[export]
    with pytest.raises(InputError) as error:
        require_frame("scan", tmp_path / "scan.ply", change(HEAD), a_capture(tmp_path / "capture", masks), NONE)
    if not masks:  # in whatever axes, the images hold it
        message = message.split(" and ")[0]
    assert message in str(error.value)


PARTS: dict[str, Callable[[Points], Points]] = {
    "whole": lambda v: v,
    "the face": lambda v: v[v[:, 2] > 0.03],
    "one side": lambda v: v[v[:, 0] > 0],
    "few points": lambda v: v[::400],
    "head and shoulders": lambda v: np.concatenate([v, 2 * v - [0, 0.2, 0.05]]),
    "head and body": lambda v: np.concatenate([v, *(1.5 * v - [0, 0.1 * k, 0.05] for k in range(1, 15))]),
    "landmarks off by a few millimetres": lambda v: v + 0.004,
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("landmarks", [LANDMARKS, NONE], ids=["landmarks", "none"])
@pytest.mark.parametrize("masks", [True, False])
def test_parts_of_a_head_are_accepted(tmp_path: Path, part: str, landmarks: Points, masks: bool) -> None:
    capture = a_capture(tmp_path / "capture", masks)
    require_frame("scan", tmp_path / "scan.ply", PARTS[part](HEAD), capture, landmarks)


def warnings(root: Path, vertices: Points, faces: np.ndarray = FACES, landmarks: Points = LANDMARKS) -> list[str]:
    scan = Scan(vertices=vertices, triangles=faces)
    return [finding.line for finding in scan_warnings(a_capture(root, masks=not len(landmarks)), scan, landmarks)]


def test_a_good_scan_has_no_warnings(tmp_path: Path) -> None:
    assert warnings(tmp_path, HEAD) == []
    assert warnings(tmp_path, HEAD, FACES[:0]) == []
    assert warnings(tmp_path, HEAD, landmarks=NONE) == []
    assert warnings(tmp_path, HEAD[HEAD[:, 2] > 0.02], FACES[:0]) == []


@pytest.mark.parametrize("export", ["z up", "axes exchanged"])
def test_the_masks_tell_that_a_scan_is_turned(tmp_path: Path, export: str) -> None:
    change, message = EXPORTS[export]
    (line,) = warnings(tmp_path, change(HEAD), landmarks=NONE)
    assert message in line


def test_a_scan_that_was_only_moved_is_not_called_turned(tmp_path: Path) -> None:
    (line,) = warnings(tmp_path, HEAD + [0.03, 0, 0])
    assert line.startswith("the scan fits if it is moved by (-30, ") and line.endswith("check its frame and unit")


@pytest.mark.parametrize("kind", ["folder", "pipe", "broken link"])
def test_a_scan_that_is_no_file_is_refused(tmp_path: Path, kind: str) -> None:
    root = make(tmp_path / "capture")
    (root / "scan.ply").unlink()
    if kind == "folder":
        (root / "scan.ply").mkdir()
    elif kind == "pipe":
        os.mkfifo(root / "scan.ply")
    else:
        (root / "scan.ply").symlink_to(root / "nothing.ply")
    with pytest.raises(InputError) as error:
        check_capture(root)
    assert error.value.where.endswith("scan.ply")


def test_a_mirrored_scan_is_told_whether_its_winding_was_mended_or_not(tmp_path: Path) -> None:
    mirrored = HEAD * [-1, 1, 1]
    (line,) = warnings(tmp_path, mirrored)
    assert "mirrored: the world is its (-x, y, z)" in line
    (line,) = warnings(tmp_path, mirrored, FACES[:, ::-1])
    assert "mirrored: the world is its (-x, y, z)" in line


def test_an_inside_out_scan_is_told(tmp_path: Path) -> None:
    (line,) = warnings(tmp_path, HEAD, FACES[:, ::-1])
    assert "point inwards" in line


def test_faces_wound_in_both_directions_are_told(tmp_path: Path) -> None:
    faces = FACES.copy()
    faces[::3] = faces[::3, ::-1]
    (line,) = warnings(tmp_path, HEAD, faces)
    assert "wound in both directions" in line


def test_floating_pieces_are_told(tmp_path: Path) -> None:
    crumb = HEAD[0] + np.arange(6)[:, None] * 1e-3
    crumbs = np.concatenate([HEAD, crumb + [0, 0, 2.5], crumb - [0.5, 0, 0]])
    (line,) = warnings(tmp_path, crumbs)
    assert line.startswith("12 vertices of the scan, in 2 pieces") and "2.4" in line


def test_what_of_a_file_is_not_measured_is_told(tmp_path: Path) -> None:
    write_ply(tmp_path / "scan.ply", np.concatenate([HEAD, HEAD + 0.03]), np.concatenate([FACES, FACES[:9]]))
    scan = read_scan(tmp_path / "scan.ply")
    (line,) = (finding.line for finding in scan_warnings(a_capture(tmp_path), scan, LANDMARKS))
    assert line.startswith(f"{len(HEAD)} of the scan's {2 * len(HEAD)} vertices are not measured")
    assert "9 repeated or degenerate faces" in scan_facts(scan)
    strips = replace(scan, triangles=FACES[:0], unused_vertices=0, unused_faces=0, unread={"tristrips": 1})
    (line,) = (finding.line for finding in scan_warnings(a_capture(tmp_path), strips, LANDMARKS))
    assert "counts as a point cloud" in line and "tristrips" in line


@pytest.mark.parametrize("file", ["scan.ply", "ground_truth.npz"])
def test_register_refuses_meshes_in_another_unit_before_the_fit(tmp_path: Path, file: str) -> None:
    root = make(tmp_path / "capture")
    if file == "scan.ply":
        scan = read_scan(root / file)
        write_ply(root / file, 1e3 * scan.vertices, scan.triangles)
    else:
        np.savez(root / file, vertices=1e3 * np.load(root / file)["vertices"])
    with pytest.raises(InputError) as error:
        validate_capture(read_capture(root))
    assert error.value.where.endswith(file) and "millimetres" in error.value.got


@needs_shared
@pytest.mark.parametrize(
    "name", ["gnm_identity_a/happy", "ict_dev/jaw_open", "ict_pop_00/neutral", "real_two_view/neutral"]
)
def test_real_captures_raise_no_false_alarm(name: str) -> None:
    capture = read_capture(SHARED / "data/captures" / name)
    assert capture.scan is not None
    scan, landmarks = read_scan(capture.scan), surface_landmarks(capture)
    for points in (landmarks, NONE):
        require_frame("scan", capture.scan, scan.vertices, capture, points)
        assert scan_warnings(capture, scan, points) == []
