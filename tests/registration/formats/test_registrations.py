"""A registration does not depend on the format in which the capture came: the proof for every format."""

import shutil
from dataclasses import replace
from pathlib import Path

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
OTHER = ("normals", "segmentation", "landmarks")  # channels that formats of cameras do not hold


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four views, with one focal length each, so that every format can hold them."""
    whole = with_square_pixels(native.read_capture(SHARED / "data" / "captures" / "ict_dev" / "neutral"))
    views = [whole.views[i] for i in np.linspace(0, len(whole.views) - 1, VIEWS).astype(int)]
    root = tmp_path_factory.mktemp("original") / "capture"
    for view in views:
        for folder, suffix in (("images", ".png"), ("masks", ".png"), ("normals", ".png"), ("segmentation", ".png")):
            _copy(whole.root / folder / f"{view.name}{suffix}", root / folder / f"{view.name}{suffix}")
        _copy(whole.root / "landmarks" / f"{view.name}.json", root / "landmarks" / f"{view.name}.json")
    write_model(root / "sparse", {f"{view.name}.png": view.camera for view in views}, np.zeros((0, 3)))
    _copy(whole.root / "capture.toml", root / "capture.toml")
    return native.read_capture(root)


@pytest.fixture(scope="module")
def expected(original: Capture, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return registration.register(original.root, MODEL, tmp_path_factory.mktemp("expected") / "out", OPTIONS).vertices


@pytest.mark.parametrize("name", [name for name in NAMES if name != "native"])
def test_a_registration_is_that_of_the_native_capture(
    name: str, original: Capture, expected: np.ndarray, tmp_path: Path
) -> None:
    back = written_and_imported(name, original, tmp_path)
    _copy(original.root / "capture.toml", back.root / "capture.toml")  # some formats say that images are linear
    for view, other in zip(original.views, written_names(writer_of(name), original), strict=True):
        for channel in ("masks", *OTHER):
            suffix = ".json" if channel == "landmarks" else ".png"
            _copy(original.root / channel / f"{view.name}{suffix}", back.root / channel / f"{other}{suffix}")
    ours = registration.register(back.root, MODEL, tmp_path / "out", OPTIONS).vertices
    moved_mm = 1e3 * float(np.linalg.norm(ours - expected, axis=-1).max())
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
    ours = registration.register(root, MODEL, tmp_path / "out", OPTIONS).vertices
    assert 1e3 * float(np.linalg.norm(ours - expected, axis=-1).max()) > MAX_MM
