"""Normal maps in other axes, depth maps, and COLMAP's dense maps arrive in the camera's axes and in metres."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native, pixels
from registration.capture.dense_maps import read_depth
from registration.formats.colmap_project import read as read_colmap
from registration.formats.convert import import_capture
from registration.formats.native_source import read
from registration.formats.source import ReadOptions
from registration.types import Capture, View
from tests.fixtures.formats import colmap
from tests.registration.capture.small import make

UNIT_M = 0.25
DEPTH_M = np.linspace(0.3, 0.5, 120 * 160).reshape(160, 120).astype(np.float32)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make(tmp_path / "capture")


def normals(view: View) -> np.ndarray:
    assert view.normals is not None
    return pixels.in_camera(pixels.decode_normals(pixels.read_normals(view.normals, view.camera)), view)


def colmap_map(file: Path, values: np.ndarray) -> None:
    """As https://colmap.github.io/format.html says: width&height&channels&, then float32, column first."""
    file.parent.mkdir(parents=True, exist_ok=True)
    height, width, channels = values.shape
    content = values.transpose(2, 0, 1).astype("<f4").tobytes()
    file.write_bytes(f"{width}&{height}&{channels}&".encode("ascii") + content)


@pytest.mark.parametrize("frame", ["camera_opengl", "world"])
def test_normals_in_other_axes(frame: str, root: Path, tmp_path: Path) -> None:
    original = native.read_capture(root)
    for view in original.views:
        values = normals(view)
        turn = np.diag([1.0, -1, -1]) if frame == "camera_opengl" else view.camera.T_cam_world[:3, :3]
        encoded = np.round((values @ turn + 1) / 2 * 65535).astype(np.uint16)
        encoded[~values.any(-1)] = 0
        cv2.imwrite(str(view.normals), encoded[..., ::-1])
    with (root / "capture.toml").open("a") as file:
        file.write(f'\n[normals]\nframe = "{frame}"\n')
    import_capture(read(root, ReadOptions()), tmp_path / "native")
    for view, expected in zip(native.read_capture(tmp_path / "native").views, original.views, strict=True):
        assert view.normals_frame == "camera_opencv"
        np.testing.assert_allclose(normals(view), normals(native_view(root, expected.name, frame)), atol=1e-4)


def native_view(root: Path, name: str, frame: str) -> View:
    view = next(view for view in native.read_capture(root).views if view.name == name)
    assert view.normals_frame == frame
    return view


def test_depths_in_millimetres(root: Path, tmp_path: Path) -> None:
    (root / "depth").mkdir()
    for view in native.read_capture(root).views:
        cv2.imwrite(str(root / "depth" / f"{view.name}.png"), np.round(DEPTH_M * 1000).astype(np.uint16))
    with (root / "capture.toml").open("a") as file:
        file.write('\n[depth]\nunit = "mm"\n')
    import_capture(read(root, ReadOptions()), tmp_path / "native")
    for view in native.read_capture(tmp_path / "native").views:
        np.testing.assert_allclose(read_depth(view), DEPTH_M, atol=5.1e-4)


def in_units(capture: Capture, folder: Path) -> None:
    """Write the capture as an undistorted workspace whose world has units of `UNIT_M`."""
    colmap.write(capture, folder)
    file = folder / "sparse" / "0" / "images.txt"
    lines = []
    for line in file.read_text().splitlines():
        words = line.split()
        if len(words) == 10:
            words[5:8] = [repr(float(word) / UNIT_M) for word in words[5:8]]
        lines.append(" ".join(words))
    file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("kind", ["geometric", "photometric"])
def test_dense_maps_of_colmap(kind: str, root: Path, tmp_path: Path) -> None:
    original = native.read_capture(root)
    folder = tmp_path / "dense"
    in_units(original, folder)
    for view in original.views:
        name = f"{view.name}.png.{kind}.bin"
        colmap_map(folder / "stereo" / "normal_maps" / name, normals(view))
        colmap_map(folder / "stereo" / "depth_maps" / name, DEPTH_M[..., None] / UNIT_M)
    import_capture(read_colmap(folder, ReadOptions()), tmp_path / "native", unit_m=UNIT_M)
    shutil.rmtree(folder)
    for view, expected in zip(native.read_capture(tmp_path / "native").views, original.views, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, expected.camera.T_cam_world, atol=1e-12)
        np.testing.assert_allclose(normals(view), normals(expected), atol=1e-6)
        np.testing.assert_allclose(read_depth(view), DEPTH_M, atol=1e-6)
