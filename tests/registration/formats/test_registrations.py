"""A registration does not depend on the format in which the capture came: the proof for every format."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import registration
from registration.capture import native
from registration.capture.colmap import write_model
from registration.types import Capture
from tests.conftest import SHARED, needs_shared
from tests.registration.formats.writers import NAMES, with_square_pixels, writer_of, written_and_imported, written_names

pytestmark = [pytest.mark.slow, needs_shared]
MODEL = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"
OPTIONS = registration.RegisterOptions(recipe="preview", deterministic=True)
VIEWS = 4
MAX_MM = 0.01
CHANNELS = ("images", "masks", "normals", "segmentation", "landmarks")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four views, with one focal length each, so that nearly every format can hold them."""
    whole = with_square_pixels(native.read_capture(SHARED / "data" / "captures" / "ict_dev" / "neutral"))
    views = [whole.views[i] for i in np.linspace(0, len(whole.views) - 1, VIEWS).astype(int)]
    root = tmp_path_factory.mktemp("original") / "capture"
    for view in views:
        for folder in CHANNELS:
            name = f"{view.name}{'.json' if folder == 'landmarks' else '.png'}"
            _copy(whole.root / folder / name, root / folder / name)
    write_model(root / "sparse", {f"{view.name}.png": view.camera for view in views}, np.zeros((0, 3)))
    _copy(whole.root / "capture.toml", root / "capture.toml")
    return native.read_capture(root)


@pytest.fixture(scope="module")
def one_camera(original: Capture, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The same, all views resampled to the first one's K, for the format that has one K."""
    root = shutil.copytree(original.root, tmp_path_factory.mktemp("one") / "capture")
    shutil.rmtree(root / "sparse")
    K = original.views[0].camera.intrinsics
    for view in original.views:
        warp = K @ np.linalg.inv(view.camera.intrinsics)
        shift = 0.5 * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        pixels = (np.eye(3) - shift) @ warp @ (np.eye(3) + shift)  # OpenCV's first pixel is at 0
        for folder in CHANNELS[:-1]:
            file = root / folder / f"{view.name}.png"
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            how = cv2.INTER_LINEAR if folder == "images" else cv2.INTER_NEAREST
            cv2.imwrite(str(file), cv2.warpPerspective(image, pixels, image.shape[1::-1], flags=how))
        points = {}
        for scheme, rows in view.landmarks.items():
            moved = np.column_stack([rows[:, :2], np.ones(len(rows))]) @ warp.T
            points[scheme] = np.column_stack([moved[:, :2], rows[:, 2]]).tolist()
        (root / "landmarks" / f"{view.name}.json").write_text(json.dumps(points))
    cameras = {f"{view.name}.png": replace(view.camera, intrinsics=K) for view in original.views}
    write_model(root / "sparse", cameras, np.zeros((0, 3)))
    return native.read_capture(root)


def registered(capture: Capture, out: Path) -> np.ndarray:
    result = registration.register(capture.root, MODEL, out, OPTIONS)
    assert result.status == "converged"
    return result.vertices


@pytest.fixture(scope="module")
def expected(original: Capture, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return registered(original, tmp_path_factory.mktemp("expected") / "out")


@pytest.fixture(scope="module")
def expected_of_one_camera(one_camera: Capture, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return registered(one_camera, tmp_path_factory.mktemp("expected") / "out")


@pytest.mark.parametrize("name", [name for name in NAMES if name != "native"])
def test_a_registration_is_that_of_the_native_capture(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    one = getattr(writer_of(name), "ONE_CAMERA", False)
    original: Capture = request.getfixturevalue("one_camera" if one else "original")
    expected: np.ndarray = request.getfixturevalue("expected_of_one_camera" if one else "expected")
    back = written_and_imported(name, original, tmp_path)
    _copy(original.root / "capture.toml", back.root / "capture.toml")  # some formats say that images are linear
    for view, other in zip(original.views, written_names(writer_of(name), original), strict=True):
        for channel in CHANNELS[1:]:  # those that formats of cameras do not hold
            suffix = ".json" if channel == "landmarks" else ".png"
            _copy(original.root / channel / f"{view.name}{suffix}", back.root / channel / f"{other}{suffix}")
    moved_mm = 1e3 * float(np.linalg.norm(registered(back, tmp_path / "out") - expected, axis=-1).max())
    print(f"{name}: vertices differ by at most {moved_mm:.2g} mm")
    assert moved_mm <= MAX_MM


def _copy(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)


def test_the_difference_would_be_seen(original: Capture, expected: np.ndarray, tmp_path: Path) -> None:
    """Cameras moved by a tenth of a millimetre give another result."""
    root = shutil.copytree(original.root, tmp_path / "moved")
    shutil.rmtree(root / "sparse")
    cameras = {}
    for number, view in enumerate(original.views):
        T = view.camera.T_cam_world.copy()
        T[0, 3] += 1e-4 * (-1) ** number
        cameras[f"{view.name}.png"] = replace(view.camera, T_cam_world=T)
    write_model(root / "sparse", cameras, np.zeros((0, 3)))
    ours = registered(native.read_capture(root), tmp_path / "out")
    assert 1e3 * float(np.linalg.norm(ours - expected, axis=-1).max()) > MAX_MM
