"""Rigs that record one folder of numbered images, or one video, per camera."""

import re
from collections.abc import Sequence
from pathlib import Path

from registration.formats.files import Error, stored_size
from registration.formats.source import VideoFrame
from registration.formats.videos import SUFFIXES as VIDEOS
from registration.formats.videos import read_video_header

FOLDERS = ("videos", "video")  # of one video per camera, besides those of images
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_NUMBER = re.compile(r"(\d+)$")


def find_frame(folders: Sequence[Path], camera: str, frame: int | None, error: Error) -> Path | VideoFrame | None:
    """Return a frame of a camera: an image of the folder `camera`, or of the video `camera.mp4`.

    Args:
        folders: that are searched, in order.
        camera: its name, that of the folder or of the video without its suffix.
        frame: the number at the end of an image's name, or the index in a video, from 0; None: the first.
        error: makes the error of an entry, what was expected and what was found.

    Returns:
        The image or the frame; None if there is neither folder nor video.

    Raises:
        InputError: there is no such frame, it is there twice, or the video cannot be read.
    """
    for parent in folders:
        if (parent / camera).is_dir():
            return _image(parent / camera, camera, frame, error)
        videos = [file for suffix in VIDEOS if (file := parent / f"{camera}{suffix}").is_file()]
        if videos:
            count = read_video_header(videos[0]).frames
            if frame is not None and count and frame >= count:
                raise error(camera, f"frame {frame} of {videos[0].name}", f"0 to {count - 1}")
            return VideoFrame(file=videos[0], index=frame or 0)
    return None


def frame_size(image: Path | VideoFrame) -> tuple[int, int]:
    """Return width and height (px) of an image, or of a video's frames. Raises InputError if it cannot be read."""
    if isinstance(image, Path):
        return stored_size(image)
    header = read_video_header(image.file)
    return header.width_px, header.height_px


def _image(folder: Path, camera: str, frame: int | None, error: Error) -> Path:
    numbered: dict[int, list[Path]] = {}
    for file in sorted(folder.iterdir()):
        found = _NUMBER.search(file.stem)
        if file.suffix.lower() in _IMAGES and found is not None:
            numbered.setdefault(int(found[1]), []).append(file)
    if not numbered:
        raise error(camera, f"images in {folder} whose names end in a frame's number", "none")
    number = min(numbered) if frame is None else frame
    if number not in numbered:
        raise error(camera, f"an image of frame {frame} in {folder}", f"{min(numbered)} to {max(numbered)}")
    if len(numbered[number]) > 1:
        raise error(camera, f"one image of frame {number}", ", ".join(file.name for file in numbered[number][:2]))
    return numbered[number][0]
