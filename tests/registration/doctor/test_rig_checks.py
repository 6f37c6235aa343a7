"""Poses of another convention and worlds of another unit are refused with the edit that mends them."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.capture import native
from registration.capture.colmap import write_model
from registration.capture.pixels import read_mask
from registration.doctor.report import check_capture
from registration.doctor.rig_checks import check_landmark_rays, check_landmark_size, check_mask_rays, mask_box
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.types import Capture
from tests.conftest import SHARED, needs_shared
from tests.fixtures.far_world import moved
from tests.registration.capture.small import landmarks_68, make

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
FAR = np.array([0.02, 0.3, -0.4])  # of the subject from the origin, or transposed poses of a ring would look at it


def pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def centre(T: np.ndarray) -> np.ndarray:
    return -T[:3, :3].T @ T[:3, 3]


def scalar_last(T: np.ndarray) -> np.ndarray:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return pose(Rotation.from_quat([y, z, w, x]).as_matrix(), T[:3, 3])  # read as w x y z


WRITTEN: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str, str]] = {
    "OpenGL": (lambda T: FLIP @ T, "OpenGL's camera axes", "diag(1, -1, -1)"),
    "inverted": (lambda T: np.linalg.inv(T), "camera to world", "invert each pose"),
    "nerfstudio": (lambda T: np.linalg.inv(FLIP @ T), "nerfstudio", "invert each pose and turn its axes"),
    "centre": (lambda T: pose(T[:3, :3], centre(T)), "centre in place of the translation", "t' = -R t"),
    "OpenGL centre": (lambda T: pose(FLIP[:3, :3] @ T[:3, :3], centre(T)), "in OpenGL's axes", "t' = -R' t"),
    "transposed": (lambda T: pose(T[:3, :3].T, T[:3, 3]), "transposed rotations", "transpose each rotation"),
    "x y z w": (scalar_last, "quaternions as x y z w", "w x y z"),
    "PyTorch3D": (lambda T: np.diag([-1.0, -1.0, 1.0, 1.0]) @ T, "PyTorch3D", "diag(-1, -1, 1)"),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("rig") / "capture")


def with_poses(root: Path, target: Path, edit: Callable[[np.ndarray], np.ndarray]) -> Capture:
    shutil.copytree(root, target)
    cameras = {view.image.name: view.camera for view in native.read_capture(root).views}
    moved = {
        name: replace(camera, T_cam_world=edit(camera.T_cam_world @ pose(np.eye(3), -FAR)))
        for name, camera in cameras.items()
    }
    shutil.rmtree(target / "sparse")
    write_model(target / "sparse", moved, np.zeros((0, 3)))
    (target / "scan.ply").unlink()
    (target / "ground_truth.npz").unlink()
    return native.read_capture(target)


def test_good_poses_pass(good: Path, tmp_path: Path) -> None:
    capture = with_poses(good, tmp_path / "capture", lambda T: T)
    assert check_landmark_rays(capture)
    validate_capture(capture)
    validate_capture(without(capture, "landmarks"))


def without(capture: Capture, *folders: str) -> Capture:
    """The capture after folders were removed."""
    for folder in folders:
        shutil.rmtree(capture.root / folder)
    return native.read_capture(capture.root)


@pytest.mark.parametrize("convention", WRITTEN)
def test_the_convention_of_the_poses_is_named(good: Path, tmp_path: Path, convention: str) -> None:
    edit, name, mend = WRITTEN[convention]
    with pytest.raises(InputError, match="do not look at one subject") as caught:
        validate_capture(with_poses(good, tmp_path / "capture", edit))
    assert name in caught.value.got and mend in caught.value.fix


@pytest.mark.parametrize("convention", ["OpenGL", "inverted", "nerfstudio", "centre", "x y z w"])
def test_masks_alone_show_that_cameras_look_elsewhere(good: Path, tmp_path: Path, convention: str) -> None:
    capture = without(with_poses(good, tmp_path / "capture", WRITTEN[convention][0]), "landmarks")
    with pytest.raises(InputError, match="do not look at one subject") as caught:
        validate_capture(capture)
    if convention == "OpenGL":
        assert "behind all cameras" in caught.value.got and "diag(1, -1, -1)" in caught.value.fix


@pytest.mark.parametrize("factor", [1e-3, 0.1, 10.0, 39.37, 100.0, 1000.0])
def test_other_units_are_refused_without_landmarks_too(good: Path, tmp_path: Path, factor: float) -> None:
    capture = with_poses(good, tmp_path / "capture", lambda T: pose(T[:3, :3], factor * T[:3, 3]))
    with pytest.raises(InputError, match="units are metres"):
        validate_capture(capture)
    if factor in (0.1, 10.0):
        return  # a ball of 1.8 cm or 1.8 m may be a part of a subject or a whole one
    with pytest.raises(InputError, match="not in metres") as caught:
        validate_capture(without(capture, "landmarks"))
    assert f"by {0.0254 if factor == 39.37 else 1 / factor:g} " in caught.value.fix
    with pytest.raises(InputError, match="not in metres"):
        check_landmark_size(capture, "dense", factor * landmarks_68())


def test_a_far_world_needs_all_digits(good: Path, tmp_path: Path) -> None:
    root = moved(good, tmp_path / "far")
    validate_capture(native.read_capture(root))
    listing = root / "sparse" / "images.txt"
    rounded = [" ".join(_rounded(line.split())) if line else "" for line in listing.read_text().splitlines()]
    listing.write_text("\n".join(rounded) + "\n")
    with pytest.raises(InputError, match="too few digits") as caught:
        native.read_capture(root)
    assert "17 digits" in caught.value.fix and "origin near the subject" in caught.value.fix


def _rounded(words: list[str]) -> list[str]:
    """The words of an image's line with numbers of eight digits."""
    return (
        [f"{float(word):.8g}" if 1 <= i <= 7 else word for i, word in enumerate(words)]
        if words[0].isdecimal()
        else words
    )


def test_a_single_camera_that_looks_away_is_named(good: Path, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    shutil.copytree(good, root)
    cameras = {view.image.name: view.camera for view in native.read_capture(good).views}
    shutil.rmtree(root / "sparse")
    turned = replace(cameras["cam3.png"], T_cam_world=FLIP @ cameras["cam3.png"].T_cam_world)
    write_model(root / "sparse", {**cameras, "cam3.png": turned}, np.zeros((0, 3)))
    assert any("is not in the view of cam3; check the pose" in warning for warning in check_capture(root).warnings)


def test_cameras_in_one_place_are_refused(good: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="in one place"):
        validate_capture(with_poses(good, tmp_path / "capture", lambda T: pose(T[:3, :3], np.zeros(3))))


def test_a_masks_box_has_no_specks() -> None:
    mask = np.zeros((200, 100), bool)
    mask[50:150, 20:60] = True
    mask[3, 95] = True
    box = mask_box(mask)
    assert box is not None
    assert box.low.tolist() == [20, 50] and box.high.tolist() == [60, 150]
    assert mask_box(np.zeros((4, 4), bool)) is None


@needs_shared
@pytest.mark.parametrize(
    "name", ["ict_dev/jaw_open", "gnm_identity_a/happy", "ict_pop_00/neutral", "real_two_view/neutral"]
)
def test_shared_captures_pass(name: str) -> None:
    capture = native.read_capture(SHARED / "data" / "captures" / name)
    validate_capture(capture)
    masks = {view.name: read_mask(view.mask, view.camera) > 127 for view in capture.views if view.mask is not None}
    check_mask_rays(capture, {name: mask_box(mask) for name, mask in masks.items()}, poses=True, size=True)
