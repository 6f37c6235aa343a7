"""Views through lenses that no native camera holds, against the same views rendered by a pinhole."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture import native, pixels
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.errors import InputError
from registration.formats.convert import import_capture
from registration.formats.registry import read_source
from registration.formats.source import Distortion, ReadOptions, SourceView
from registration.formats.undistort import turned, undistortion
from registration.types import Camera
from tests.registration.capture.small import CLASSES, YAWS_RAD, Lens, camera, data_lines, synthetic_view

FISHEYE = (0.4, -0.3, 0.1, 0.2)
SKEW = 3.0


def fisheye_plane(cam: Camera, grid: np.ndarray) -> np.ndarray:
    return cv2.fisheye.undistortPoints(grid[:, None], cam.intrinsics, np.array(FISHEYE))[:, 0]


def fisheye_pixels(cam: Camera, points: np.ndarray) -> np.ndarray:
    rotation, translation = cv2.Rodrigues(cam.T_cam_world[:3, :3])[0], cam.T_cam_world[:3, 3]
    return cv2.fisheye.projectPoints(points[:, None], rotation, translation, cam.intrinsics, np.array(FISHEYE))[0][:, 0]


@pytest.fixture(scope="module")
def fisheye(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A native capture whose cameras have OpenCV's fisheye lens."""
    root = tmp_path_factory.mktemp("fisheye") / "capture"
    lens = Lens(plane=fisheye_plane, project=fisheye_pixels)
    views = [synthetic_view(f"cam{i}", camera(yaw_rad), lens) for i, yaw_rad in enumerate(YAWS_RAD)]
    write_capture(root, views, CaptureDescription(subject="ball", expression="neutral", classes=CLASSES), bits=16)
    lines = [line.replace("PINHOLE", "OPENCV_FISHEYE") for line in data_lines(root / "sparse" / "cameras.txt")]
    (root / "sparse" / "cameras.txt").write_text("\n".join(f"{line} {' '.join(map(str, FISHEYE))}" for line in lines))
    return root


def test_a_fisheye_capture_is_that_of_pinholes(fisheye: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not supported"):
        native.read_capture(fisheye)
    done = import_capture(read_source(fisheye, ReadOptions()), tmp_path / "native")
    assert any("5 of 5 views were undistorted" in note and "opencv_fisheye" in note for note in done.notes)
    capture = native.read_capture(tmp_path / "native")
    for view in capture.views:
        truth = synthetic_view(view.name, view.camera)
        assert view.mask is not None and view.normals is not None and view.segmentation is not None
        got = pixels.read_view(view, capture)
        assert got.mask is not None and got.normals is not None
        inside = cv2.erode(truth.mask.astype(np.uint8), np.ones((5, 5))) > 0
        assert np.abs(got.rgb - truth.rgb)[inside].max() < 0.01
        edge = cv2.dilate(truth.mask.astype(np.uint8), np.ones((3, 3))) - cv2.erode(
            truth.mask.astype(np.uint8), np.ones((3, 3))
        )
        assert (np.abs(got.mask - truth.mask) > 0.02)[edge == 0].sum() == 0
        assert np.abs(got.mask.sum() - truth.mask.sum()) < 0.01 * truth.mask.sum()
        angles = np.degrees(np.arccos(np.clip((got.normals * truth.normals).sum(-1), -1, 1)))
        assert angles[inside].max() < 0.5
        labels = pixels.read_labels(view.segmentation, view.camera, capture.classes)
        assert (labels != truth.labels)[inside].mean() < 0.02  # the border between two classes
        np.testing.assert_allclose(view.landmarks["68"][:, :2], truth.landmarks["68"][:, :2], atol=1e-5)


def test_skew_is_taken_out(tmp_path: Path) -> None:
    plain = camera(0.3)
    K = plain.intrinsics.copy()
    K[0, 1] = SKEW
    source = SourceView(
        name="a",
        image=tmp_path / "a.png",
        width_px=plain.width_px,
        height_px=plain.height_px,
        intrinsics=K,
        T_cam_world=plain.T_cam_world,
        landmarks={},
    )
    lens = undistortion(source)
    assert lens.camera.intrinsics[0, 1] == 0
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (20, 3))
    straight, _ = lens.camera.project(points)
    local = points @ plain.T_cam_world[:3, :3].T + plain.T_cam_world[:3, 3]
    skewed = local @ K.T
    np.testing.assert_allclose(lens.sources(straight), skewed[:, :2] / skewed[:, 2:], atol=1e-9)


def test_the_new_image_has_a_source_everywhere(fisheye: Path) -> None:
    for view in read_source(fisheye, ReadOptions()).views:
        lens = undistortion(view)
        K = lens.camera
        x, y = np.meshgrid(np.arange(K.width_px) + 0.5, np.arange(K.height_px) + 0.5)
        source = lens.sources(np.stack([x.ravel(), y.ravel()], -1))
        assert (source > 0).all() and (source < [view.width_px, view.height_px]).all()
        assert K.width_px >= 0.9 * view.width_px


def test_a_wide_lens_gives_at_most_twice_the_size() -> None:
    K = np.array([[100.0, 0, 160], [0, 100.0, 160], [0, 0, 1]])  # the corner is 130 degrees off the axis
    view = SourceView(
        name="a",
        image=Path("a.png"),
        width_px=320,
        height_px=320,
        intrinsics=K,
        T_cam_world=np.eye(4),
        distortion=Distortion(model="opencv_fisheye"),
    )
    lens = undistortion(view)
    assert lens.camera.width_px <= 640 and lens.camera.height_px <= 640


def test_a_lens_that_folds_is_refused() -> None:
    view = SourceView(
        name="a",
        image=Path("a.png"),
        width_px=320,
        height_px=240,
        intrinsics=np.array([[200.0, 1, 160], [0, 200.0, 120], [0, 0, 1]]),
        T_cam_world=np.eye(4),
        distortion=Distortion(model="opencv", coefficients=(-3.0,)),
    )
    with pytest.raises(InputError, match="cannot be undistorted"):
        undistortion(view)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_is_what_pillow_does(orientation: int, tmp_path: Path) -> None:
    from PIL import ImageOps

    rgb = np.random.default_rng(1).integers(0, 255, (6, 4, 3), np.uint8)
    image = Image.fromarray(rgb)
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as stored:
        expected = np.array(ImageOps.exif_transpose(stored))
    np.testing.assert_array_equal(turned(rgb, orientation), expected)
