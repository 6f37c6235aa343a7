from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from registration.capture import native, pixels
from registration.errors import InputError
from tests.conftest import needs_shared
from tests.registration.capture.small import make
from tests.registration.doctor import faulty

REFUSED: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str, str]] = {
    "OpenGL": (lambda n: n * [1, -1, -1], "OpenGL", "store (x, -y, -z)"),
    "y up": (lambda n: n * [1, -1, 1], "with y up", "store (x, -y, z)"),
    "x to the left": (lambda n: n * [-1, 1, 1], "with x to the left", "store (-x, y, z)"),
    "z to the camera": (lambda n: n * [1, 1, -1], "z towards the camera", "store (x, y, -z)"),
    "inwards": (lambda n: -n, "pointing into the subject", "store (-x, -y, -z)"),
    "channels reversed": (lambda n: n[..., ::-1], "blue, green, red", "store (z, y, x)"),
    "cyclic": (lambda n: n[..., [1, 2, 0]], "as z, x, y", "store (z, x, y)"),
    "constant": (lambda n: np.zeros_like(n) + [0, 0, -1.0], "the same normal everywhere", "encode"),
    "half as long": (lambda n: n * 0.5, "length of 0.50", "encode"),
}


@needs_shared
@pytest.mark.parametrize("name", REFUSED)
def test_normals_in_other_axes_are_refused_with_the_conversion(tmp_path: Path, name: str) -> None:
    change, got, fix = REFUSED[name]
    root = faulty.copy(tmp_path)
    faulty.normals(root, change)
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert got in caught.value.got and fix in caught.value.fix and caught.value.where == str(root / "normals")


@needs_shared
@pytest.mark.parametrize("axes, got", [((0, 1, 2), "world's frame:"), ((0, 2, 1), "world's frame, as x, z, y")])
def test_normals_in_a_world_frame_are_refused(tmp_path: Path, axes: tuple[int, ...], got: str) -> None:
    root = faulty.copy(tmp_path)
    for view in native.read_capture(root).views:
        R = view.camera.T_cam_world[:3, :3]
        faulty.normals(root, lambda n, R=R: (n @ R)[..., axes], [view.name])
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert got in caught.value.got and "rotation of each view's pose" in caught.value.fix


@needs_shared
def test_eight_bit_values_in_16_bit_files_are_named(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    faulty.images(root, "normals", lambda pixels: pixels // 257)
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert "no value above 255 of 65535" in caught.value.got


@needs_shared
def test_one_view_in_other_axes_is_warned_of(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    faulty.normals(root, lambda n: n * [1, -1, 1], ["cam07"])
    assert "cam07: its normals seem to be with y up" in faulty.warnings(root)


@needs_shared
@pytest.mark.parametrize("background", [32768, 65535])
def test_noise_and_other_backgrounds_are_accepted(tmp_path: Path, background: int) -> None:
    rng = np.random.default_rng(0)
    root = faulty.copy(tmp_path)

    def filled(pixels: np.ndarray) -> np.ndarray:
        pixels[(pixels == 0).all(-1)] = background
        return pixels

    faulty.normals(root, lambda n: n + rng.normal(0, 0.2, n.shape))
    faulty.images(root, "normals", filled)
    assert faulty.warnings(root) == ""


def test_normals_of_a_ball_are_in_the_cameras_axes(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    assert faulty.warnings(root) == ""
    faulty.normals(root, lambda n: n * [1, -1, -1])
    with pytest.raises(InputError, match="other axes"):
        faulty.warnings(root)


def stored_in(root: Path, frame: str) -> None:
    """Convert the normal maps of a capture to other axes."""
    for view in native.read_capture(root).views:
        R = view.camera.T_cam_world[:3, :3]
        faulty.normals(root, lambda n, R=R: n @ R if frame == "world" else n * [1, -1, -1], [view.name])


def state(root: Path, frame: str) -> None:
    with (root / "capture.toml").open("a", encoding="utf-8") as file:
        file.write(f'\n[normals]\nframe = "{frame}"\n')


@needs_shared
@pytest.mark.parametrize("frame", ["camera_opengl", "world"])
def test_stated_axes_are_converted(tmp_path: Path, frame: str) -> None:
    root = faulty.copy(tmp_path)
    stored_in(root, frame)
    with pytest.raises(InputError, match="in other axes") as caught:
        faulty.warnings(root)
    assert f'write [normals] frame = "{frame}" into capture.toml' in caught.value.fix
    state(root, frame)
    assert faulty.warnings(root) == ""


def test_converted_normals_are_those_of_the_camera(tmp_path: Path) -> None:
    expected = native.read_capture(make(tmp_path / "camera"))
    for frame in ("camera_opengl", "world"):
        root = make(tmp_path / frame)
        stored_in(root, frame)
        state(root, frame)
        found = native.read_capture(root)
        for first, second in zip(expected.views, found.views, strict=True):
            ours, theirs = (pixels.read_view(v, c).normals for v, c in ((first, expected), (second, found)))
            np.testing.assert_allclose(ours, theirs, atol=1e-4)


@needs_shared
def test_axes_that_are_stated_wrongly_are_refused(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    state(root, "camera_opengl")
    with pytest.raises(InputError, match="in other axes") as caught:
        faulty.warnings(root)
    assert caught.value.fix.startswith('write [normals] frame = "camera_opencv" into capture.toml')


@pytest.mark.parametrize("table", ['[normals]\nframe = "opengl"', '[normals]\naxes = "world"', 'normals = "world"'])
def test_a_statement_that_is_none_is_refused(tmp_path: Path, table: str) -> None:
    root = make(tmp_path / "capture")
    path = root / "capture.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(f"{table}\n{text}" if table.startswith("normals") else f"{text}\n{table}\n", encoding="utf-8")
    with pytest.raises(InputError, match="stated wrongly") as caught:
        native.read_capture(root)
    assert 'frame = "camera_opengl"' in caught.value.expected
