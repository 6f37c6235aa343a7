"""One folder or one video per camera, with a frame number, of formats whose cameras are in a file of their own."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.errors import InputError
from registration.formats.convert import import_capture
from registration.formats.registry import read_source
from registration.formats.source import ReadOptions, VideoFrame
from tests.registration.formats.projecting import image, video

CAMERAS = ("left", "right")


def write_cameras(folder: Path) -> Path:
    """`cameras.npz` of two cameras by name."""
    K = np.array([[200, 0, 60], [0, 200, 80], [0, 0, 1.0]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = -0.1
    folder.mkdir()
    np.savez(folder / "cameras.npz", K=np.stack([K, K]), T_cam_world=poses, names=np.array(CAMERAS), unit_m=1.0)
    return folder


def greys(folder: Path, out: Path, frame: int | None) -> list[int]:
    """The grey values of the views of an imported frame."""
    import_capture(read_source(folder, ReadOptions(frame=frame)), out)
    capture = read_capture(out)
    assert [view.name for view in capture.views] == list(CAMERAS)
    return [round(float(cv2.imread(str(view.image)).mean())) for view in capture.views]


def test_folders_of_cameras_hold_numbered_images(tmp_path: Path) -> None:
    folder = write_cameras(tmp_path / "rig")
    for number in (3, 12):
        for index, camera in enumerate(CAMERAS):
            image(folder / "images" / camera / f"frame_{number:04d}.png", 120, 160, grey=10 * number + index)
            image(folder / "masks" / camera / f"frame_{number:04d}.png", 120, 160, grey=255)
    assert greys(folder, tmp_path / "a", None) == [30, 31]
    assert greys(folder, tmp_path / "b", 12) == [120, 121]
    assert all(view.mask is not None for view in read_capture(tmp_path / "b").views)
    with pytest.raises(InputError, match="3 to 12"):
        read_source(folder, ReadOptions(frame=4))
    image(folder / "images" / "left" / "frame_0012.jpg", 120, 160)
    with pytest.raises(InputError, match="one image of frame 12"):
        read_source(folder, ReadOptions(frame=12))


def test_videos_of_cameras_give_exact_frames(tmp_path: Path) -> None:
    folder = write_cameras(tmp_path / "rig")
    for camera in CAMERAS:
        video(folder / "videos" / f"{camera}.mp4", 120, 160, frames=4)
    source = read_source(folder, ReadOptions(frame=2))
    assert all(isinstance(view.image, VideoFrame) and view.image.index == 2 for view in source.views)
    np.testing.assert_allclose(greys(folder, tmp_path / "a", 2), [80, 80], atol=3)
    with pytest.raises(InputError, match="0 to 3"):
        read_source(folder, ReadOptions(frame=4))
    (folder / "videos" / "right.mp4").unlink()
    with pytest.raises(InputError, match="right"):
        read_source(folder, ReadOptions(frame=1))


def test_an_easymocap_rig_may_have_videos(tmp_path: Path) -> None:
    for camera in CAMERAS:
        video(tmp_path / "videos" / f"{camera}.mp4", 120, 160, frames=3)
    for name, values in (
        ("intri", {"K": np.diag([200.0, 200, 1])}),
        ("extri", {"Rot": np.eye(3), "T": np.zeros((3, 1))}),
    ):
        storage = cv2.FileStorage(str(tmp_path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for camera in CAMERAS:
            storage.write("", camera)
        storage.endWriteStruct()
        for camera in CAMERAS:
            for part, matrix in values.items():
                storage.write(f"{part}_{camera}", matrix)
        storage.release()
    source = read_source(tmp_path, ReadOptions(frame=1))
    assert [view.image for view in source.views] == [
        VideoFrame(file=tmp_path / "videos" / f"{camera}.mp4", index=1) for camera in CAMERAS
    ]
    assert (source.views[0].width_px, source.views[0].height_px) == (120, 160)
