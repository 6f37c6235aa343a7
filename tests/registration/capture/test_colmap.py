"""Our reader and writer of COLMAP models: against pycolmap where that is installed, and against damaged files."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.capture.colmap import read_cameras, read_points, write_model
from registration.capture.colmap_model import PARAMETER_COUNTS
from registration.errors import InputError
from registration.types import Camera
from tests.registration.capture.binary_model import write_binary

NAMES = ("cam0.png", "left/cam 1 (ü).png", "cam2.png")
POINTS = np.array([[0.1, -0.2, 0.3], [1 / 3, 2e-9, -4.0]])
COLOURS = np.array([[1, 2, 3], [250, 251, 252]], np.uint8)


def cameras() -> dict[str, Camera]:
    rng = np.random.default_rng(0)
    by_name = {}
    for number, name in enumerate(NAMES):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T[:3, 3] = rng.normal(size=3)
        intrinsics = np.array([[600.5 + number, 0, 119.25], [0, 601.75, 160.125], [0, 0, 1.0]])
        distortion = ((), (0.1, -0.2, 0.001, 0.002), (0.1, -0.2, 0.001, 0.002, 0.03))[number]
        by_name[name] = Camera(width_px=240, height_px=320, intrinsics=intrinsics, T_cam_world=T, distortion=distortion)
    return by_name


@pytest.fixture
def sparse(tmp_path: Path) -> Path:
    write_model(tmp_path / "sparse", cameras(), POINTS, COLOURS)
    return tmp_path / "sparse"


def assert_same(actual: dict[str, Camera], expected: dict[str, Camera]) -> None:
    assert actual.keys() == expected.keys()
    for name, camera in expected.items():
        np.testing.assert_allclose(actual[name].T_cam_world, camera.T_cam_world, atol=1e-14)
        np.testing.assert_array_equal(actual[name].intrinsics, camera.intrinsics)
        read, written = actual[name].distortion, camera.distortion
        assert (*read, *[0.0] * 8)[:8] == (*written, *[0.0] * 8)[:8]


def test_a_written_model_is_read_back_equal(sparse: Path) -> None:
    assert_same(read_cameras(sparse), cameras())
    points, colours = read_points(sparse)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)


def test_binary_files_are_read(sparse: Path, tmp_path: Path) -> None:
    copy = write_binary(sparse, tmp_path / "binary")
    assert_same(read_cameras(copy), cameras())
    np.testing.assert_array_equal(read_points(copy)[0], POINTS)


def test_our_files_and_those_of_pycolmap_are_interchangeable(sparse: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: make setup-optional")
    text = sparse / "images.txt"
    text.write_text(text.read_text().replace("left/cam 1 (ü).png", "cam1.png"))  # it cuts names at a space
    expected = {name.replace("left/cam 1 (ü).png", "cam1.png"): camera for name, camera in cameras().items()}
    model = pycolmap.Reconstruction(str(sparse))
    for image in model.images.values():
        matrix = expected[image.name].T_cam_world[:3]
        np.testing.assert_allclose(image.cam_from_world().matrix(), matrix, atol=1e-14)
    for kind in ("text", "binary"):
        theirs = tmp_path / kind
        theirs.mkdir()
        getattr(model, f"write_{kind}")(str(theirs))
        assert {"rigs", "frames"} <= {file.stem for file in theirs.iterdir()}
        assert_same(read_cameras(theirs), expected)
        np.testing.assert_allclose(np.sort(read_points(theirs)[0], 0), np.sort(POINTS, 0))


def test_parameter_counts_are_pycolmaps() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: make setup-optional")
    numbers = {name: int(number) for name, number in pycolmap.CameraModelId.__members__.items() if int(number) >= 0}
    assert {name: number for number, name in enumerate(PARAMETER_COUNTS)} == numbers
    for name, count in PARAMETER_COUNTS.items():
        assert len(pycolmap.Camera.create_from_model_name(1, name, 1.0, 10, 10).params) == count


def test_a_rigs_poses_are_the_images(sparse: Path) -> None:
    """Two cameras on one rig, the second with a pose in it: consistent, then displaced."""
    first, second = (cameras()[name].T_cam_world for name in (NAMES[0], NAMES[2]))
    numbers = {image.split()[-1]: image.split()[0] for image in (sparse / "images.txt").read_text().splitlines()[3::2]}
    assert numbers["cam2.png"] == "3"

    def pose(T: np.ndarray) -> str:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        return " ".join(map(repr, map(float, (w, x, y, z, *T[:3, 3]))))

    rig = sparse / "rigs.txt"
    rig.write_text(f"5 2 CAMERA 1 CAMERA 3 1 {pose(second @ np.linalg.inv(first))}\n")
    (sparse / "frames.txt").write_text(f"9 5 {pose(first)} 2 CAMERA 1 1 CAMERA 3 3\n")
    assert_same(read_cameras(sparse), cameras())
    translation = np.eye(4)
    translation[0, 3] = 0.01
    rig.write_text(f"5 2 CAMERA 1 CAMERA 3 1 {pose(translation @ second @ np.linalg.inv(first))}\n")
    with pytest.raises(InputError, match="not that of its frame") as caught:
        read_cameras(sparse)
    assert "cam2.png" in str(caught.value)


@pytest.mark.parametrize("keep_last", [True, False])
def test_images_without_a_line_of_points_all_count(sparse: Path, keep_last: bool) -> None:
    file = sparse / "images.txt"
    lines = [line for line in file.read_text("utf-8").splitlines() if line.strip()]
    file.write_text("\n".join(lines) + ("\n1.5 2.5 -1\n" if keep_last else ""), "utf-8")
    assert_same(read_cameras(sparse), cameras())


def test_points_may_be_missing_and_a_model_may_lie_in_folder_0(sparse: Path) -> None:
    (sparse / "points3D.txt").unlink()
    (sparse / "0").mkdir()
    for file in sparse.glob("*.txt"):
        file.rename(sparse / "0" / file.name)
    assert_same(read_cameras(sparse), cameras())
    assert read_points(sparse)[0].shape == (0, 3)
    (sparse / "1").mkdir()
    for file in (sparse / "0").iterdir():
        (sparse / "1" / file.name).write_bytes(file.read_bytes())
    with pytest.raises(InputError, match="several COLMAP models"):
        read_cameras(sparse)


def test_text_and_binary_must_agree(sparse: Path, tmp_path: Path) -> None:
    text = (sparse / "cameras.txt").read_text()
    (sparse / "cameras.txt").write_text(
        "\n".join(
            line if line.startswith("#") else f"{line.split()[0]} FULL_OPENCV " + " ".join(line.split()[2:])
            for line in text.splitlines()
        )
    )
    lines = (sparse / "cameras.txt").read_text().splitlines()
    padded = [line if line[0] == "#" else line + " 0" * (16 - len(line.split())) for line in lines]
    (sparse / "cameras.txt").write_text("\n".join(padded))
    copy = write_binary(sparse, tmp_path / "binary")
    for file in copy.iterdir():
        (sparse / file.name).write_bytes(file.read_bytes())
    assert_same(read_cameras(sparse), cameras())
    (sparse / "cameras.txt").write_text("\n".join(padded).replace("600.5", "650.5"))
    with pytest.raises(InputError, match="there twice") as caught:
        read_cameras(sparse)
    assert "cam0.png" in str(caught.value)


def edit(file: str, old: str, new: str) -> Callable[[Path], None]:
    def change(sparse: Path) -> None:
        path = sparse / file
        text = path.read_text("utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), "utf-8")

    return change


def test_errors_name_the_malformed_line_of_a_text_file(sparse: Path) -> None:
    damages = {
        "cameras.txt, line 3": [
            edit("cameras.txt", "PINHOLE 240", "PINHOLE wide"),
            edit("cameras.txt", "160.125", ""),
            edit("cameras.txt", "160.125", "160.125 7"),
        ],
        "images.txt, line 4": [edit("images.txt", " 1 cam0.png", ""), edit("images.txt", " 1 cam0.png", " a cam0.png")],
        "images.txt, line 5": [edit("images.txt", "cam0.png\n", "cam0.png\n1 2 3 4")],
        "cameras.txt": [lambda sparse: (sparse / "cameras.txt").write_bytes(b"1 PINHOLE \xff\xfe")],
    }
    originals = {file.name: file.read_bytes() for file in sparse.iterdir()}
    for where, changes in damages.items():
        for change in changes:
            for name, content in originals.items():
                (sparse / name).write_bytes(content)
            change(sparse)
            with pytest.raises(InputError, match="cannot be read") as caught:
                read_cameras(sparse)
            assert where in str(caught.value), where


def test_every_truncation_of_a_binary_file_is_refused(sparse: Path, tmp_path: Path) -> None:
    copy = write_binary(sparse, tmp_path / "binary")
    for name, read in (("cameras.bin", read_cameras), ("images.bin", read_cameras), ("points3D.bin", read_points)):
        whole = (copy / name).read_bytes()
        for size in range(0, len(whole), 5):
            (copy / name).write_bytes(whole[:size])
            with pytest.raises(InputError, match="cannot be read") as caught:
                read(copy)
            assert name in str(caught.value)
        (copy / name).write_bytes(whole)
    assert_same(read_cameras(copy), cameras())


def test_counts_are_compared_with_the_files_size(sparse: Path, tmp_path: Path) -> None:
    copy = write_binary(sparse, tmp_path / "binary")
    for name, read in (("cameras.bin", read_cameras), ("images.bin", read_cameras), ("points3D.bin", read_points)):
        whole = (copy / name).read_bytes()
        (copy / name).write_bytes(struct.pack("<Q", 2**60) + whole[8:])
        with pytest.raises(InputError, match="cannot be read") as caught:
            read(copy)
        assert str(2**60) in str(caught.value)
        (copy / name).write_bytes(whole)


def test_an_image_without_its_camera_is_refused(sparse: Path) -> None:
    edit("images.txt", " 1 cam0.png", " 9 cam0.png")(sparse)
    with pytest.raises(InputError, match="has no camera"):
        read_cameras(sparse)


def test_frames_without_rigs_must_have_the_images_poses(sparse: Path) -> None:
    images = [line.split() for line in (sparse / "images.txt").read_text().splitlines()[3::2]]
    rows = [f"{n} 1 {' '.join(words[1:8])} 1 CAMERA {words[8]} {words[0]}\n" for n, words in enumerate(images)]
    (sparse / "frames.txt").write_text("".join(rows))
    assert_same(read_cameras(sparse), cameras())
    edit("frames.txt", images[0][5], "7.5")(sparse)
    with pytest.raises(InputError, match="not that of its frame"):
        read_cameras(sparse)


def test_a_second_model_in_folder_0_must_be_the_same(sparse: Path) -> None:
    (sparse / "0").mkdir()
    for file in sparse.glob("*.txt"):
        (sparse / "0" / file.name).write_bytes(file.read_bytes())
    assert_same(read_cameras(sparse), cameras())
    edit("cameras.txt", "600.5", "650.5")(sparse / "0")
    with pytest.raises(InputError, match="there twice") as caught:
        read_cameras(sparse)
    assert "0/images.txt" in caught.value.got


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_text_files_of_other_systems_are_read(sparse: Path, ending: str) -> None:
    for file in sparse.iterdir():
        text = file.read_text("utf-8").replace("\n", ending)
        file.write_bytes("# f\xfcr".encode("latin-1") + ending.encode() + text.encode())
    assert_same(read_cameras(sparse), cameras())
    file = sparse / "images.txt"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert_same(read_cameras(sparse), cameras())


@pytest.mark.parametrize(
    "name", ["Kopf Süd (1) v1.png", "a%20b#1.png", "rig\\cam.png", "a\u2028b  c.png", "a\x0bb.png"]
)
def test_names_are_whole(sparse: Path, name: str) -> None:
    edit("images.txt", NAMES[0], name)(sparse)
    assert name in read_cameras(sparse)


def test_a_fisheye_lens_is_refused_with_the_way_out(sparse: Path) -> None:
    edit("cameras.txt", "PINHOLE", "OPENCV_FISHEYE")(sparse)
    edit("cameras.txt", "160.125", "160.125 0.1 0 0 0")(sparse)
    with pytest.raises(InputError, match="camera model is not supported") as caught:
        read_cameras(sparse)
    assert "gnmreg capture import" in caught.value.fix and "masks" in caught.value.fix
