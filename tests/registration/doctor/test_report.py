import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.capture.scan import Scan
from registration.doctor.contact_sheet import CAPTION_PX, TILE_WIDTH_PX
from registration.doctor.report import NO_TOPOLOGY, check_capture
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.storage.mesh import write_ply
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.small import (
    CLASSES,
    DISTORTIONS,
    YAWS_RAD,
    ball,
    camera,
    data_lines,
    landmarks_68,
    make,
    synthetic_view,
)

GREEN, MAGENTA, RED, YELLOW, BLUE = (70, 255, 90), (255, 90, 220), (255, 50, 40), (255, 210, 60), (60, 200, 255)


def test_the_report_of_a_good_capture(tmp_path: Path) -> None:
    report = check_capture(make(tmp_path / "capture", distortion=DISTORTIONS["OPENCV"]))
    assert report.warnings == ()
    assert report.schemes == {"68": (68, 68)}
    assert report.eye_distance_mm == pytest.approx(90, abs=1e-6)
    assert report.sheet is None and list(tmp_path.iterdir()) == [tmp_path / "capture"]
    for view, yaw_rad in zip(report.views, YAWS_RAD, strict=True):
        plain = synthetic_view(view.name, camera(yaw_rad, distortion=DISTORTIONS["OPENCV"]))
        assert plain.mask is not None and view.coverage == pytest.approx(plain.mask.mean(), abs=1e-6)
        assert view.landmarks == (plain.landmarks["68"][:, 2] > 0.5).sum() and view.residual_px < 1e-3
        assert view.outliers == ()
    text = str(report)
    for part in (
        "ball, neutral",
        "cam4",
        "120 x 160",
        "k1 k2 p1 p2",
        "age: 30",
        "68 of 68",
        "90.0 mm",
        "180 x 180 x 180",
    ):
        assert part in text
    assert "warning" not in text


def test_the_report_says_when_the_topology_of_the_scan_is_not_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    assert f"scan's topology: {NO_TOPOLOGY}" in str(check_capture(make(tmp_path / "capture")))


def edit_landmarks(root: Path, name: str, change: Callable[[np.ndarray], None]) -> None:
    path = root / "landmarks" / f"{name}.json"
    rows = np.array(json.loads(path.read_text())["68"])
    change(rows)
    path.write_text(json.dumps({"68": rows.tolist()}))


def test_landmarks_that_contradict_other_views_are_reported(tmp_path: Path) -> None:
    def move(rows: np.ndarray) -> None:
        rows[[36, 37], 0] += 9

    root = make(tmp_path / "capture")
    edit_landmarks(root, "cam2", move)
    report = check_capture(root)
    assert report.warnings == ("cam2: landmarks that contradict the other views: 36, 37",)
    assert [view.outliers for view in report.views] == [(), (), (36, 37), (), ()]
    assert report.eye_distance_mm == pytest.approx(90, abs=1e-6)


@pytest.mark.parametrize("first", [2, 10])
def test_a_jaw_in_the_wrong_order_is_reported(first: int, tmp_path: Path) -> None:
    def reverse(rows: np.ndarray) -> None:
        rows[first : first + 5] = rows[first : first + 5][::-1].copy()

    root = make(tmp_path / "capture")
    for number in range(len(YAWS_RAD)):
        edit_landmarks(root, f"cam{number}", reverse)
    report = check_capture(root)
    known = first == 2  # the order of Google's first file: all points count
    assert any("10, 11, 12, 13, 14 go backwards" in warning for warning in report.warnings) == (not known)
    assert ("points 2-6 of the right jaw are in reverse, and read" in str(report)) == known


def test_landmarks_seen_by_one_view_are_reported(tmp_path: Path) -> None:
    def hide(rows: np.ndarray) -> None:
        rows[[45, 50], 2] = 0.5

    root = make(tmp_path / "capture")
    for number in range(1, len(YAWS_RAD)):
        edit_landmarks(root, f"cam{number}", hide)
    report = check_capture(root)
    assert report.schemes == {"68": (68, 66)} and report.eye_distance_mm is None
    assert report.warnings == (
        "landmarks 68: not triangulated, fewer than two views see 45, 50; the others say null or a low confidence",
    )


def test_missing_parts_are_reported(tmp_path: Path) -> None:
    root = make(tmp_path / "capture", drop=("normals", "landmarks"))
    (root / "masks" / "cam1.png").unlink()
    (root / "scan.ply").unlink()
    report = check_capture(root, sheet=tmp_path / "sheet.png")
    assert report.warnings == (
        "1 of 5 views without a mask: cam1",
        "5 of 5 views without normals: cam0, cam1, cam2, cam3, cam4",
        "5 of 5 views without landmarks: cam0, cam1, cam2, cam3, cam4",
        "no scan: distances to it cannot be evaluated",
    )
    assert report.schemes == {} and report.eye_distance_mm is None
    assert (tmp_path / "sheet.png").is_file()


def test_landmark_schemes_may_have_different_lengths(tmp_path: Path) -> None:
    views = []
    for number, yaw_rad in enumerate(YAWS_RAD):
        view = synthetic_view(f"cam{number}", camera(yaw_rad))
        views.append(replace(view, landmarks={"5": view.landmarks["68"][:5], **view.landmarks}))
    root = write_capture(
        tmp_path / "capture", views, CaptureDescription(subject="s", expression="e", classes=CLASSES), scan=ball()
    )
    report = check_capture(root)
    assert report.schemes == {"5": (5, 5), "68": (68, 68)} and report.eye_distance_mm == pytest.approx(90)


def test_a_scan_that_is_not_at_the_landmarks_is_reported(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    write_ply(root / "scan.ply", ball(0.7).vertices, ball().triangles)
    (warning,) = check_capture(root).warnings
    assert "check its frame and unit" in warning


def test_distortion_that_folds_is_reported(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    path = root / "sparse" / "cameras.txt"
    lines = data_lines(path)
    words = lines[1].split()
    lines[1] = " ".join([words[0], "OPENCV", *words[2:], "-6 0 0 0"])
    path.write_text("\n".join(lines) + "\n")
    warning = "the distortion folds the image over itself: cam1; check the coefficients"
    assert any(line.startswith(warning) for line in check_capture(root).warnings)


def test_cheap_checks_of_all_views_come_before_any_decoding(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    cv2.imwrite(str(root / "masks" / "cam0.png"), np.zeros((160, 120), np.uint8))
    (root / "images" / "cam4.png").write_bytes((root / "images" / "cam4.png").read_bytes()[:-20])
    with pytest.raises(InputError, match="The image is truncated"):
        check_capture(root)


def test_png_files_with_trailing_bytes_are_valid(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    for path in (root / "images").iterdir():
        path.write_bytes(path.read_bytes() + b"appended by a camera")
    assert check_capture(root).warnings == ()


def test_captures_from_other_readers_are_checked(tmp_path: Path) -> None:
    capture = native.read_capture(make(tmp_path / "capture"))
    first = capture.views[0]
    for name, value, what in (
        ("T_cam_world", np.diag([1.0, 1.0, 0.0, 1.0]), "The pose is singular"),
        ("T_cam_world", np.full((4, 4), np.nan), "The pose is singular"),
        ("T_cam_world", np.diag([1.0, 1.0, -1.0, 1.0]), "The pose is singular"),
        ("intrinsics", np.zeros((3, 3)), "The intrinsics are singular"),
        ("distortion", (np.inf, 0.0, 0.0, 0.0), "The intrinsics are singular"),
    ):
        broken = replace(first, camera=replace(first.camera, **{name: value}))
        with pytest.raises(InputError, match=what):
            validate_capture(replace(capture, views=(broken, *capture.views[1:])))


def near(pixels: np.ndarray, x: float, y: float, colour: tuple[int, int, int], reach_px: int = 2) -> bool:
    """Whether the colour (nearly) lies within `reach_px` of a point."""
    row, column = round(y - 0.5), round(x - 0.5)
    patch = pixels[row - reach_px : row + reach_px + 1, column - reach_px : column + reach_px + 1].astype(int)
    return bool((np.abs(patch - colour).max(-1) < 30).any())


def test_the_contact_sheet_shows_landmarks_scan_and_mask_in_position(tmp_path: Path) -> None:
    """Landmarks, scan points and mask outline, in a distorted capture, in the first tile."""

    def move(rows: np.ndarray) -> None:
        rows[36, 0] -= 9

    root = make(tmp_path / "capture", distortion=DISTORTIONS["OPENCV"])
    edit_landmarks(root, "cam0", move)
    report = check_capture(root, sheet=tmp_path / "new" / "sheet.png")
    assert list((tmp_path / "new").iterdir()) == [tmp_path / "new" / "sheet.png"] and report.sheet is not None
    sheet = cv2.imread(str(report.sheet))[..., ::-1]
    height = round(TILE_WIDTH_PX * 160 / 120)
    tile = sheet[72 : 72 + height, 8 : 8 + TILE_WIDTH_PX]
    cam = replace(report.views[0].camera, distortion=()).scaled(TILE_WIDTH_PX, height)
    points = landmarks_68()
    xy = cam.project(points)[0]
    shown = ((cam.centre - points) * points).sum(-1) > 0
    assert shown.sum() > 20
    for index in np.flatnonzero(shown & (np.arange(68) != 36)):
        assert near(tile, *xy[index], GREEN)
    assert near(tile, *xy[36], MAGENTA, reach_px=5) and not near(tile, *xy[36], GREEN, reach_px=3)
    assert near(tile, (xy[36][0] + xy[36][0] - 9 * TILE_WIDTH_PX / 120) / 2, xy[36][1], RED, reach_px=4)
    outline_point = np.array([[0, 0.09 * np.sqrt(1 - (0.09 / 0.45) ** 2), 0]])  # near the top of the ball's outline
    x, y = cam.project(outline_point)[0][0]
    assert any(near(tile, x, y + offset, YELLOW) for offset in range(-8, 9, 2))
    blue = (np.abs(tile.astype(int) - BLUE).max(-1) < 30).nonzero()
    assert len(blue[0]) > 300
    centre = cam.project(np.zeros((1, 3)))[0][0]
    assert np.abs(np.array([blue[1].mean(), blue[0].mean()]) - centre).max() < 8
    assert sheet.shape[0] >= 72 + height + CAPTION_PX


def test_the_contact_sheet_shows_a_point_cloud(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    cloud: Scan = replace(ball(), triangles=np.zeros((0, 3), np.int64))
    write_ply(root / "scan.ply", cloud.vertices, cloud.triangles)
    report = check_capture(root, sheet=tmp_path / "sheet.png")
    assert report.scan is not None and len(report.scan.triangles) == 0
    sheet = cv2.imread(str(tmp_path / "sheet.png"))[..., ::-1]
    assert (np.abs(sheet.astype(int) - BLUE).max(-1) < 30).sum() > 1000


def test_hidden_scan_points_are_not_drawn(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    check_capture(root, sheet=tmp_path / "sheet.png")
    with_core = np.concatenate([ball().vertices, 0.5 * ball().vertices])
    write_ply(root / "scan.ply", with_core, ball().triangles)
    check_capture(root, sheet=tmp_path / "again.png")
    assert (tmp_path / "sheet.png").read_bytes() == (tmp_path / "again.png").read_bytes()


@needs_shared
def test_shared_captures_pass(tmp_path: Path) -> None:
    captures = SHARED / "data" / "captures"
    report = check_capture(captures / "ict_dev" / "neutral", sheet=tmp_path / "sheet.png")
    assert report.warnings == () and report.eye_distance_mm == pytest.approx(92, abs=1)
    report = check_capture(captures / "gnm_identity_a" / "neutral")
    assert report.warnings == () and "points 2-6 of the right jaw are in reverse" in str(report)
