import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.capture.scan import read_scan, read_truth
from registration.errors import InputError
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.binary_model import to_binary
from tests.registration.capture.small import (
    CLASSES,
    DISTORTIONS,
    YAWS_RAD,
    ball,
    camera,
    landmarks_68,
    make,
    synthetic_view,
)


def test_round_trip(tmp_path: Path) -> None:
    capture = native.read_capture(make(tmp_path / "capture", distortion=DISTORTIONS["OPENCV"]))
    assert (capture.subject, capture.expression, capture.classes) == ("ball", "neutral", CLASSES)
    assert capture.tags == {"age": 30, "notes": 'with "quotes"', "lists": [1.5, 2.5], "real": False}
    assert [view.name for view in capture.views] == [f"cam{i}" for i in range(len(YAWS_RAD))]
    for view, yaw_rad in zip(capture.views, YAWS_RAD, strict=True):
        expected = synthetic_view(view.name, camera(yaw_rad, distortion=DISTORTIONS["OPENCV"]))
        assert view.camera.distortion == expected.camera.distortion
        np.testing.assert_array_equal(view.camera.intrinsics, expected.camera.intrinsics)
        np.testing.assert_allclose(view.camera.T_cam_world, expected.camera.T_cam_world, atol=1e-14)
        np.testing.assert_array_equal(view.landmarks["68"], expected.landmarks["68"])
        assert all((view.mask, view.normals, view.segmentation))
    assert capture.scan is not None and capture.ground_truth is not None
    np.testing.assert_allclose(read_scan(capture.scan).vertices, ball().vertices, atol=1e-8)
    np.testing.assert_array_equal(read_scan(capture.scan).triangles, ball().triangles)
    np.testing.assert_array_equal(read_truth(capture.ground_truth), landmarks_68())


def test_a_binary_model_reads_as_its_text(tmp_path: Path) -> None:
    root = make(tmp_path / "capture", distortion=DISTORTIONS["FULL_OPENCV"])
    text = native.read_capture(root)
    to_binary(root)
    assert {path.suffix for path in (root / "sparse").iterdir()} == {".bin"}
    for a, b in zip(text.views, native.read_capture(root).views, strict=True):
        assert (a.name, a.camera.distortion) == (b.name, b.camera.distortion)
        np.testing.assert_array_equal(a.camera.intrinsics, b.camera.intrinsics)
        np.testing.assert_allclose(a.camera.T_cam_world, b.camera.T_cam_world, atol=1e-14)


@pytest.mark.parametrize(
    "model, parameters",
    [
        ("SIMPLE_PINHOLE", "600 61 77"),
        ("PINHOLE", "600 610 61 77"),
        ("SIMPLE_RADIAL", "600 61 77 0.4"),
        ("RADIAL", "600 61 77 0.4 -0.9"),
        ("OPENCV", "600 610 61 77 0.4 -0.9 0.03 -0.02"),
        ("FULL_OPENCV", "600 610 61 77 0.4 -0.9 0.03 -0.02 0.5 0.2 0.3 -0.4"),
    ],
)
def test_every_camera_model_projects_as_in_colmap(tmp_path: Path, model: str, parameters: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: make setup-optional")
    root = make(tmp_path / "capture")
    (root / "sparse" / "cameras.txt").write_text(
        "".join(f"{i} {model} 120 160 {parameters}\n" for i in range(1, 1 + len(YAWS_RAD)))
    )
    ours = native.read_capture(root).views[0].camera
    points = np.random.default_rng(0).uniform([-0.1, -0.12, 0.9], [0.1, 0.12, 1.1], (50, 3))
    theirs = pycolmap.Camera.create_from_model_name(1, model, 600, 120, 160)
    theirs.params = np.array(parameters.split(), float)
    expected = np.array([theirs.img_from_cam(point) for point in points]).reshape(-1, 2)
    coefficients = np.array(ours.distortion) if ours.distortion else None
    projected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), ours.intrinsics, coefficients)[0][:, 0]
    np.testing.assert_allclose(projected, expected, atol=1e-6)
    assert bool(ours.distortion) == (model not in ("PINHOLE", "SIMPLE_PINHOLE"))


def test_names_hold_subfolders_other_suffixes_and_natural_order(tmp_path: Path) -> None:
    names = ["right/cam10", "right/cam2", "left/cam1"]
    views = [synthetic_view(name, camera(yaw_rad)) for name, yaw_rad in zip(names, YAWS_RAD, strict=False)]
    root = write_capture(tmp_path / "capture", views, CaptureDescription(subject="s", expression="e", classes=CLASSES))
    image = root / "images" / "right" / "cam2.png"
    cv2.imwrite(str(image.with_suffix(".jpg")), cv2.imread(str(image)))
    image.unlink()
    listing = root / "sparse" / "images.txt"
    listing.write_text(listing.read_text().replace("right/cam2.png", "right/cam2.jpg"))
    capture = native.read_capture(root)
    assert [view.name for view in capture.views] == ["left/cam1", "right/cam2", "right/cam10"]
    assert capture.views[1].image == root / "images" / "right" / "cam2.jpg"
    assert capture.views[1].mask == root / "masks" / "right" / "cam2.png"
    assert len(capture.views[1].landmarks["68"]) == 68


def test_optional_parts_may_be_missing(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    (root / "masks" / "cam1.png").unlink()
    shutil.rmtree(root / "normals")
    shutil.rmtree(root / "landmarks")
    (root / "scan.ply").unlink()
    (root / "ground_truth.npz").unlink()
    capture = native.read_capture(root)
    assert [view.mask is None for view in capture.views] == [False, True, False, False, False]
    assert all(view.normals is None and not view.landmarks for view in capture.views)
    assert capture.scan is None and capture.ground_truth is None


@pytest.mark.parametrize("name", ["../cam0.png", "/etc/cam0.png", "cam0"])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    root = make(tmp_path / "capture")
    listing = root / "sparse" / "images.txt"
    listing.write_text(listing.read_text().replace("cam0.png", name))
    with pytest.raises(InputError, match="An image name cannot be used") as caught:
        native.read_capture(root)
    assert caught.value.got == name


def test_names_that_differ_in_their_suffix_only_are_found_wherever_they_sort(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    listing = root / "sparse" / "images.txt"
    text = listing.read_text()
    for old, new in (("cam0.png", "a.jpg"), ("cam1.png", "a.k.png"), ("cam2.png", "a.png")):
        text = text.replace(old, new)
        image = cv2.imread(str(root / "images" / old))
        cv2.imwrite(str(root / "images" / new), image)
    listing.write_text(text)
    with pytest.raises(InputError, match="differ in their suffix only") as caught:
        native.read_capture(root)
    assert caught.value.got == "a.jpg and a.png"
    listing.write_text(text.replace("a.png", "b.png").replace("a.jpg", "./a.k.png"))
    cv2.imwrite(str(root / "images" / "b.png"), image)
    with pytest.raises(InputError, match="differ in their suffix only"):
        native.read_capture(root)


def test_schemes_must_have_one_length(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    path = root / "landmarks" / "cam3.json"
    path.write_text(json.dumps({"68": [[1, 2, 1.0]]}))
    with pytest.raises(InputError, match="two lengths") as caught:
        native.read_capture(root)
    assert caught.value.where == str(path)


def test_a_failed_write_leaves_no_files(tmp_path: Path) -> None:
    good = synthetic_view("cam0", camera())
    bad = replace(good, name="cam1", camera=camera(width_px=60))
    with pytest.raises(ValueError, match="images of cam1"):
        write_capture(tmp_path / "capture", [good, bad], CaptureDescription(subject="s", expression="e"))
    assert not list(tmp_path.iterdir())


def test_the_writer_never_replaces_a_folder(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    before = (root / "capture.toml").read_bytes()
    with pytest.raises(InputError, match="exists already"):
        make(root)
    assert (root / "capture.toml").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_srgb_integers_are_written_unchanged(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 2**16, (160, 120, 3), dtype=np.uint16)
    view = ViewArrays(name="a", camera=camera(), rgb=rgb)
    root = write_capture(tmp_path / "capture", [view], CaptureDescription(subject="s", expression="e"))
    np.testing.assert_array_equal(cv2.imread(str(root / "images" / "a.png"), cv2.IMREAD_UNCHANGED)[..., ::-1], rgb)


@needs_shared
def test_shared_captures_are_read() -> None:
    folders = sorted(path.parent for path in (SHARED / "data" / "captures").glob("*/*/capture.toml"))
    assert folders
    for folder in folders:
        capture = native.read_capture(folder)
        if folder.parent.name == "real_two_view":  # photographs and a scan, nothing extracted from them
            assert len(capture.views) == 2 and capture.scan and not capture.classes
            assert not any(view.mask or view.normals or view.segmentation or view.landmarks for view in capture.views)
            continue
        assert len(capture.views) in (7, 22) and len(capture.classes) == 9
        assert all(
            view.mask and view.normals and view.segmentation and "68" in view.landmarks for view in capture.views
        )
