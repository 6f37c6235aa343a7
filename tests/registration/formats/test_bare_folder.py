"""Folders with cameras.npz, and arrays that cannot be used."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.errors import InputError
from registration.formats.bare_folder import FORMAT, read
from registration.formats.source import ReadOptions
from registration.types import Capture
from tests.fixtures.formats import bare
from tests.registration.capture.small import make

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "capture"))


@pytest.fixture
def folder(capture: Capture, tmp_path: Path) -> Path:
    bare.write(capture, tmp_path)
    return tmp_path


def edit(folder: Path, change: Callable[[Arrays], object]) -> Path:
    with np.load(folder / "cameras.npz") as file:
        arrays = dict(file)
    change(arrays)
    np.savez(folder / "cameras.npz", **arrays)
    return folder


def without(*names: str) -> Callable[[Arrays], object]:
    return lambda arrays: [arrays.pop(name) for name in names]


def test_world_to_camera_with_opencv_axes(folder: Path, capture: Capture) -> None:
    poses = np.array([view.camera.T_cam_world[:3] for view in capture.views])

    def change(arrays: Arrays) -> None:
        without("T_world_cam", "axes", "pixel_centre", "unit_m", "sizes", "distortion")(arrays)
        arrays |= {"T_cam_world": poses, "K": np.array([view.camera.intrinsics for view in capture.views])}

    source = read(edit(folder, change), ReadOptions())
    assert source.unit_m is None and any("no sizes" in note for note in source.notes)
    for view, expected in zip(source.views, capture.views, strict=True):
        np.testing.assert_array_equal(view.T_cam_world[:3], expected.camera.T_cam_world[:3])
        np.testing.assert_array_equal(view.intrinsics, expected.camera.intrinsics)


def test_one_camera_that_took_all_images_must_be_said(folder: Path) -> None:
    def change(arrays: Arrays) -> None:
        arrays["K"] = arrays["K"][0]

    with pytest.raises(InputError) as caught:
        read(edit(folder, change), ReadOptions())
    assert "shared_intrinsics" in caught.value.expected
    views = read(edit(folder, lambda arrays: arrays.update(shared_intrinsics=True)), ReadOptions()).views
    assert len({view.intrinsics.tobytes() for view in views}) == 1
    cv2.imwrite(str(folder / "images" / "cam4.png"), np.zeros((80, 60, 3), np.uint8))
    with pytest.raises(InputError) as caught:
        read(edit(folder, without("sizes")), ReadOptions())
    assert "60 x 80" in caught.value.got and "several" in caught.value.expected


def test_names_may_lie_beside_the_file_and_lack_suffixes(folder: Path) -> None:
    (folder / "images" / "cam0.png").rename(folder / "cam0.png")

    def change(arrays: Arrays) -> None:
        arrays["names"] = np.array(["cam0", *arrays["names"][1:]])

    source = read(edit(folder, change), ReadOptions())
    assert source.views[0].image == folder / "cam0.png"


def set_row(name: str, value: float) -> Callable[[Arrays], object]:
    def change(arrays: Arrays) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][0] = value

    return change


BAD: dict[str, tuple[Callable[[Arrays], object], str]] = {
    "no K": (without("K"), "none"),
    "no pose": (without("T_world_cam"), "neither"),
    "two poses": (lambda arrays: arrays.update(T_cam_world=arrays["T_world_cam"]), "both"),
    "no names": (without("names"), "none"),
    "names that are none": (lambda arrays: arrays.update(names=np.arange(5)), "int64"),
    "few names": (lambda arrays: arrays.update(names=arrays["names"][:4]), "5 rows"),
    "missing image": (lambda arrays: arrays.update(names=np.array(["x.png", *arrays["names"][1:]])), "x.png"),
    "repeated image": (lambda arrays: arrays.update(names=arrays["names"][[0, 0, 1, 2, 3]]), "cam0"),
    "few K": (lambda arrays: arrays.update(K=arrays["K"][:4]), "4 rows"),
    "flat K": (lambda arrays: arrays.update(K=arrays["K"].reshape(5, 9)), "(5, 9)"),
    "text": (lambda arrays: arrays.update(K=np.array(["a"] * 5)), "a"),
    "not finite": (set_row("K", np.nan), "nan"),
    "singular": (set_row("T_world_cam", 0), "row 0"),
    "three coefficients": (lambda arrays: arrays.update(distortion=np.zeros((5, 3))), "(5, 3)"),
    "axes": (lambda arrays: arrays.update(axes="blender"), "blender"),
    "pixel centre": (lambda arrays: arrays.update(pixel_centre=1.0), "1"),
    "unit": (lambda arrays: arrays.update(unit_m=-1.0), "-1"),
    "unknown": (lambda arrays: arrays.update(extrinsics=np.eye(4)), "extrinsics"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arrays_are_refused(name: str, folder: Path) -> None:
    change, got = BAD[name]
    with pytest.raises(InputError) as caught:
        read(edit(folder, change), ReadOptions())
    assert got in caught.value.got


def test_files_that_are_no_npz(folder: Path) -> None:
    for content in (b"", b"PK\x03\x04", (folder / "cameras.npz").read_bytes()[:-40]):
        (folder / "cameras.npz").write_bytes(content)
        assert not FORMAT.detect(folder)
        with pytest.raises(InputError, match="camera file"):
            read(folder, ReadOptions())


def test_pickled_arrays_are_never_loaded(folder: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(edit(folder, lambda arrays: arrays.update(names=np.array([{}] * 5, object))), ReadOptions())
    assert "unpickled" in caught.value.got or "object" in caught.value.got.lower()
