"""Invalid captures that `gnmreg capture check` and `gnmreg register` must refuse before any computation."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.doctor.report import check_capture
from registration.errors import InputError
from tests.registration.capture.binary_model import to_binary
from tests.registration.capture.small import data_lines, make

Damage = Callable[[Path], None]
BAD: dict[str, tuple[Damage, str, str, str, str]] = {}  # name -> damage, what, where (its end), got, fix


def bad(what: str, *, where: str, got: str, fix: str) -> Callable[[Damage], Damage]:
    def register(damage: Damage) -> Damage:
        BAD[damage.__name__] = (damage, what, where, got, fix)
        return damage

    return register


def edit(path: Path, old: str, new: str, count: int = -1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def cut(path: Path, fraction: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])


def resize(path: Path) -> None:
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-1])


@bad("The capture folder is missing", where="capture", got="no such folder", fix="path")
def no_folder(root: Path) -> None:
    shutil.rmtree(root)


@bad("capture.toml is missing", where="capture.toml", got="no such file", fix="docs/formats.md")
def no_toml(root: Path) -> None:
    (root / "capture.toml").unlink()


@bad("capture.toml cannot be read", where="capture.toml", got="line 1", fix="docs/formats.md")
def broken_toml(root: Path) -> None:
    (root / "capture.toml").write_text("subject = ball")


@bad("The units are not metres", where="capture.toml", got="mm", fix="docs/formats.md")
def other_units(root: Path) -> None:
    edit(root / "capture.toml", '"m"', '"mm"')


@bad('capture.toml lacks "subject"', where="capture.toml", got="nothing", fix="docs/formats.md")
def no_subject(root: Path) -> None:
    edit(root / "capture.toml", '"subject"', '"object"')


@bad("The COLMAP model is missing", where="sparse", got="no such folder", fix="store the calibration")
def no_model(root: Path) -> None:
    shutil.rmtree(root / "sparse")


@bad("The COLMAP model cannot be read", where="images.txt, line 4", got="", fix="model_converter")
def damaged_model(root: Path) -> None:
    edit(root / "sparse" / "images.txt", "cam0.png", "")


@bad("The COLMAP model cannot be read", where="images.bin, byte 347", got="2", fix="model_converter")
def truncated_binary_model(root: Path) -> None:
    to_binary(root)
    cut(root / "sparse" / "images.bin")


@bad("The camera model is not supported", where="image cam3.png", got="OPENCV_FISHEYE", fix="gnmreg capture import")
def fisheye(root: Path) -> None:
    path = root / "sparse" / "cameras.txt"
    lines = data_lines(path)
    lines[3] = lines[3].replace("PINHOLE", "OPENCV_FISHEYE") + " 0.1 0.1 0.1 0.1"
    path.write_text("\n".join(lines))


@bad("The pose is singular or not finite", where="image cam0.png", got="quaternion", fix="calibrate")
def zero_quaternion(root: Path) -> None:
    replace_pose(root, "0 0 0 0 0 0 0.45")


@bad("The pose is singular or not finite", where="images.txt, line 1: image cam0.png", got="nan", fix="calibrate")
def pose_not_finite(root: Path) -> None:
    replace_pose(root, "1 0 0 0 0 nan 0.45")


@bad("The pose is singular or not finite", where="image cam0.png", got="inf", fix="calibrate")
def pose_not_finite_in_a_binary_model(root: Path) -> None:
    to_binary(root)
    path = root / "sparse" / "images.bin"
    content = bytearray(path.read_bytes())
    start = content.index(b"cam0.png\0") - 4 - 3 * 8  # before the name: translation, camera id
    struct.pack_into("<d", content, start, float("inf"))
    path.write_bytes(content)


def replace_pose(root: Path, pose: str) -> None:
    path = root / "sparse" / "images.txt"
    lines = data_lines(path)
    lines[0] = f"1 {pose} 1 cam0.png"
    path.write_text("\n".join(lines))


@bad("The intrinsics are singular or not finite", where="image cam0.png", got="0", fix="calibrate")
def no_focal_length(root: Path) -> None:
    path = root / "sparse" / "cameras.txt"
    path.write_text(path.read_text().replace("120 160 240 ", "120 160 0 "))


@bad("The intrinsics are singular or not finite", where="line 3: image cam0.png", got="nan", fix="calibrate")
def intrinsics_not_finite(root: Path) -> None:
    edit(root / "sparse" / "cameras.txt", "120 160 240 ", "120 160 nan ", 1)


@bad("eye corners are too close or too far", where="sparse", got="90 m", fix="0.001")
def model_in_millimetres(root: Path) -> None:
    path = root / "sparse" / "images.txt"
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines):
        if line and not line.startswith("#"):
            words = line.split()
            words[5:8] = [str(1000 * float(word)) for word in words[5:8]]
            lines[number] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")


@bad("There are too few views", where="capture", got="1", fix="add calibrated images")
def one_view(root: Path) -> None:
    path = root / "sparse" / "images.txt"
    path.write_text(data_lines(path)[0] + "\n\n")


@bad("The image is missing", where="images/cam2.png", got="no such file", fix="add the file")
def no_image(root: Path) -> None:
    (root / "images" / "cam2.png").unlink()


@bad("The image's size is not the camera's", where="images/cam1.png", got="120 x 159", fix="calibrated image")
def image_of_another_size(root: Path) -> None:
    resize(root / "images" / "cam1.png")


@bad("The image is not a readable image", where="images/cam1.png", got="a file that starts with", fix="again")
def image_that_is_none(root: Path) -> None:
    (root / "images" / "cam1.png").write_text("hello")


@bad("The image has too many pixels", where="images/cam1.png", got="exceeds limit", fix="scale it down")
def image_bomb(root: Path) -> None:
    path = root / "images" / "cam1.png"
    content = bytearray(path.read_bytes())
    struct.pack_into(">II", content, 16, 60_000, 60_000)
    struct.pack_into(">I", content, 29, zlib.crc32(content[12:29]))
    path.write_bytes(content)


@bad("The image is truncated", where="images/cam4.png", got="bytes", fix="again")
def truncated_image(root: Path) -> None:
    cut(root / "images" / "cam4.png")


@bad("The image is truncated", where="images/cam4.png", got="bytes", fix="again")
def image_without_its_last_bytes(root: Path) -> None:
    cut(root / "images" / "cam4.png", 0.9999)


@bad("The image cannot be decoded", where="images/cam4.png", got="libpng error", fix="again")
def damaged_image(root: Path) -> None:
    path = root / "images" / "cam4.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 64] = bytes(64)
    path.write_bytes(content)


@bad("The mask's size is not the camera's", where="masks/cam1.png", got="120 x 159", fix="calibrated image")
def mask_of_another_size(root: Path) -> None:
    resize(root / "masks" / "cam1.png")


@bad("The mask is truncated", where="masks/cam1.png", got="bytes", fix="again")
def truncated_mask(root: Path) -> None:
    cut(root / "masks" / "cam1.png")


@bad("The mask is empty", where="masks/cam3.png", got="no pixel above 0", fix="draw the mask")
def empty_mask(root: Path) -> None:
    cv2.imwrite(str(root / "masks" / "cam3.png"), np.zeros((160, 120), np.uint8))


@bad("The mask is too dark", where="masks/cam3.png", got="no pixel above 1", fix="255")
def mask_of_ones(root: Path) -> None:
    cv2.imwrite(str(root / "masks" / "cam3.png"), np.ones((160, 120), np.uint8))


@bad("The label map's size is not the camera's", where="segmentation/cam0.png", got="120 x 159", fix="calibrated")
def labels_of_another_size(root: Path) -> None:
    resize(root / "segmentation" / "cam0.png")


@bad("A label index has no name", where="segmentation/cam2.png", got="index 3", fix="classes")
def label_without_a_name(root: Path) -> None:
    path = root / "segmentation" / "cam2.png"
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    labels[80, 60] = 3
    cv2.imwrite(str(path), labels)


@bad("The label maps have no class names", where="capture.toml", got="nothing", fix="name every label")
def no_classes(root: Path) -> None:
    path = root / "capture.toml"
    path.write_text(path.read_text().split("[segmentation]")[0])


@bad("The label map is in colours, and no colour has a name", where="cam2.png", got="RGB", fix="class index")
def labels_in_colour(root: Path) -> None:
    path = root / "segmentation" / "cam2.png"
    Image.open(path).convert("RGB").save(path)


@bad("The normal map's size is not the camera's", where="normals/cam1.png", got="120 x 159", fix="calibrated")
def normals_of_another_size(root: Path) -> None:
    resize(root / "normals" / "cam1.png")


@bad("The normal map has too few bits", where="normals/cam1.png", got="8 bits", fix="16 bits")
def normals_of_8_bits(root: Path) -> None:
    path = root / "normals" / "cam1.png"
    cv2.imwrite(str(path), cv2.imread(str(path)))


@bad("The landmark file is malformed", where="landmarks/cam1.json", got="line 1", fix="scheme")
def landmarks_that_are_no_json(root: Path) -> None:
    cut(root / "landmarks" / "cam1.json")


@bad("The landmark file is malformed", where="landmarks/cam1.json", got="(68, 2)", fix="add a confidence")
def landmarks_without_confidence(root: Path) -> None:
    (root / "landmarks" / "cam1.json").write_text(json.dumps({"68": [[1, 2]] * 68}))


@bad("The landmark file is malformed", where="landmarks/cam1.json", got="list", fix="scheme")
def landmarks_without_a_scheme(root: Path) -> None:
    (root / "landmarks" / "cam1.json").write_text(json.dumps([[1, 2, 1]] * 68))


@bad("The landmark file is malformed", where="landmarks/cam1.json", got="point 7", fix="scheme")
def landmark_not_finite(root: Path) -> None:
    rows = [[1.0, 2.0, 1.0]] * 7 + [[float("nan"), 2.0, 1.0]] + [[1.0, 2.0, 1.0]] * 60
    (root / "landmarks" / "cam1.json").write_text(json.dumps({"68": rows}))


@bad('The landmark scheme "68" has another length', where="landmarks", got="67", fix="another name")
def sixty_seven_landmarks(root: Path) -> None:
    for path in (root / "landmarks").iterdir():
        path.write_text(json.dumps({"68": json.loads(path.read_text())["68"][:67]}))


@bad("The scan cannot be used", where="scan.ply", got="length", fix="PLY")
def truncated_scan(root: Path) -> None:
    cut(root / "scan.ply")


@bad("The scan cannot be used", where="scan.ply", got="vertex 0 is not", fix="PLY")
def scan_not_finite(root: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (root / "scan.ply").write_text(head + "nan 0 0\n1 0 0\n0 1 0\n")


@bad("ground truth's field 'extra' cannot be read", where="ground_truth.npz", got="unpickled", fix="np.savez")
def ground_truth_with_a_pickle(root: Path) -> None:
    np.savez(root / "ground_truth.npz", vertices=np.zeros((3, 3)), extra=np.array([{}], object))


@bad("ground truth's field 'vertices' is missing", where="ground_truth.npz", got="missing: vertices", fix="np.savez")
def ground_truth_without_vertices(root: Path) -> None:
    np.savez(root / "ground_truth.npz", points=np.zeros((3, 3)))


@bad("ground truth's field 'vertices' has a wrong value", where="ground_truth.npz", got="at (1, 1)", fix="np.savez")
def ground_truth_not_finite(root: Path) -> None:
    np.savez(root / "ground_truth.npz", vertices=np.array([[0, 0, 0], [0, np.inf, 0.0]]))


def state(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path): (path.stat().st_size if path.is_file() else 0, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("good") / "capture")


@pytest.mark.parametrize("name", BAD)
def test_bad_input(good: Path, tmp_path: Path, name: str) -> None:
    damage, what, where, got, fix = BAD[name]
    root = shutil.copytree(good, tmp_path / "capture")
    damage(root)
    before = state(tmp_path)
    with pytest.raises(InputError) as caught:
        check_capture(root, sheet=tmp_path / "sheet.png")
    error = caught.value
    assert what in error.what and got in error.got and fix in error.fix
    assert error.where.endswith(where) and str(root) in error.where
    assert error.expected and error.got
    assert all(part in str(error) for part in (error.what, error.where, error.expected, error.got, error.fix))
    assert state(tmp_path) == before
