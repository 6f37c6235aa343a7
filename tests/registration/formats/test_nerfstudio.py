"""Variants of transforms.json, and files that cannot be used."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from registration.capture import native
from registration.errors import InputError
from registration.formats.nerfstudio import FORMAT, read
from registration.formats.source import Distortion, ReadOptions
from registration.types import Capture
from tests.fixtures.formats import nerfstudio
from tests.registration.capture.small import make


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "capture"))


@pytest.fixture
def folder(capture: Capture, tmp_path: Path) -> Path:
    nerfstudio.write(capture, tmp_path)
    return tmp_path


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    return folder


def without(*names: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for name in names:
                frame.pop(name, None)

    return change


def first(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["frames"][0].update(values)


def top(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(values)


def test_values_at_the_top_stand_for_those_that_frames_lack(folder: Path, capture: Capture) -> None:
    def change(content: dict[str, Any]) -> None:
        without("fl_x", "fl_y")(content)
        content.update({"fl_x": 321.0, "fl_y": 322.0})
        content["frames"][1]["fl_x"] = 300.0

    views = read(edit(folder, change), ReadOptions()).views
    assert [view.intrinsics[0, 0] for view in views] == [321, 300, 321, 321, 321]
    assert {view.intrinsics[1, 1] for view in views} == {322.0}


def test_applied_transform_and_scale_are_undone(folder: Path, capture: Capture) -> None:
    applied = np.array([[0, 1.0, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1], [0, 0, 0, 1]])

    def change(content: dict[str, Any]) -> None:
        content.update({"applied_transform": applied[:3].tolist(), "applied_scale": 0.25})
        for frame in content["frames"]:
            T = applied @ np.array(frame["transform_matrix"])
            T[:3, 3] *= 0.25
            frame["transform_matrix"] = T.tolist()

    source = read(edit(folder, change), ReadOptions())
    for view, expected in zip(source.views, capture.views, strict=True):
        np.testing.assert_allclose(view.T_cam_world, expected.camera.T_cam_world, atol=1e-12)
    assert any("undone" in note for note in source.notes)


def test_blenders_files(folder: Path, capture: Capture) -> None:
    """A field of view for all, no sizes, no suffixes, and a file for each split."""
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for frame in content["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    frames = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in content["frames"]]
    for split, part in (("train", frames[:3]), ("test", frames[3:])):
        text = json.dumps({"camera_angle_x": 0.5, "frames": part})
        (folder / f"transforms_{split}.json").write_text(text)
    assert FORMAT.detect(folder)
    source = read(folder, ReadOptions())
    assert [view.name for view in source.views] == [view.name for view in capture.views]
    focal = 0.5 * 120 / np.tan(0.25)
    np.testing.assert_allclose(source.views[0].intrinsics, [[focal, 0, 60], [0, focal, 80], [0, 0, 1]])
    assert len([note for note in source.notes if "sizes" in note or "principal" in note]) == 2


@pytest.mark.parametrize("key", [{"camera_model": "OPENCV_FISHEYE"}, {"camera_model": None, "is_fisheye": True}])
def test_fisheye_lenses(key: dict[str, Any], folder: Path) -> None:
    source = read(edit(folder, lambda content: content.update(key) or first(k1=0.1, k4=0.01)(content)), ReadOptions())
    assert source.views[0].distortion == Distortion(model="opencv_fisheye", coefficients=(0.1, 0, 0, 0.01))


def test_what_is_not_read_is_named(folder: Path) -> None:
    source = read(edit(folder, first(depth_file_path="depth/a.png", time=0.5)), ReadOptions())
    assert any("depth maps" in note and "time stamps" in note for note in source.notes)


def test_paths_of_another_machine_are_found(folder: Path) -> None:
    source = read(edit(folder, first(file_path=r"C:\rig\images\cam0.png")), ReadOptions())
    assert source.views[0].name == "cam0"


BAD: dict[str, tuple[Callable[[dict[str, Any]], None], str, str]] = {
    "no frames": (lambda content: content.pop("frames"), "frames", "nothing"),
    "empty": (top(frames=[]), "frames", "none"),
    "frames that are none": (top(frames=[1]), "frames", "list"),
    "no image": (first(file_path="images/none.png"), "file_path", "none.png"),
    "a folder": (first(file_path="images"), "file_path", "images"),
    "a number": (first(file_path=3), "file_path", "3"),
    "no pose": (first(transform_matrix=None), "transform_matrix", "nothing"),
    "a short pose": (first(transform_matrix=[[1, 0], [0, 1]]), "transform_matrix", "(2, 2)"),
    "a ragged pose": (first(transform_matrix=[[1, 0], [0]]), "transform_matrix", "lengths"),
    "a singular pose": (first(transform_matrix=np.zeros((4, 4)).tolist()), "transform_matrix", "0.0"),
    "no focal length": (without("fl_x"), "fl_x", "neither"),
    "a text": (first(fl_x="long"), "fl_x", "long"),
    "half a principal point": (without("cx"), "cx", "one of them"),
    "half a size": (without("w"), "w", "nothing"),
    "no size": (first(w=0.5), "w", "0.5"),
    "an angle": (lambda content: without("fl_x")(content) or top(camera_angle_x=4)(content), "camera_angle_x", "4"),
    "panorama": (top(camera_model="EQUIRECTANGULAR"), "camera_model", "EQUIRECTANGULAR"),
    "a distorted pinhole": (lambda c: top(camera_model="PINHOLE")(c) or first(k1=0.1)(c), "camera_model", "0.1"),
    "k4": (first(k4=0.1), "k4", "0.1"),
    "a fisheye's tangent": (lambda c: top(camera_model="OPENCV_FISHEYE")(c) or first(p1=0.1)(c), "p1", "0.1"),
    "scale": (top(applied_scale=0), "applied_scale", "0"),
    "transform": (top(applied_transform=np.zeros((3, 4)).tolist()), "applied_transform", "0.0"),
    "no mask": (first(mask_path="masks/none.png"), "mask_path", "none.png"),
    "twice": (lambda content: content["frames"].append(content["frames"][0]), "", "cam0"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_with_their_entry(name: str, folder: Path) -> None:
    change, entry, got = BAD[name]
    with pytest.raises(InputError) as caught:
        read(edit(folder, change), ReadOptions())
    assert entry in caught.value.where and got in caught.value.got


@pytest.mark.parametrize("text", ["", "[]", "{", '{"frames": NaN}', '{"frames": []}' * 2, "\0", '{"a": 1, "a": 2}'])
def test_files_that_are_no_json_object_are_refused(text: str, folder: Path) -> None:
    (folder / "transforms.json").write_text(text)
    with pytest.raises(InputError, match="transforms.json"):
        read(folder, ReadOptions())
