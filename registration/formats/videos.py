"""Video files as sources of images: their size and number of frames, from the header alone."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from registration.errors import InputError
from registration.storage.image_files import MAX_PIXELS
from registration.storage.reading import open_file

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm")
MAX_FRAME = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class VideoHeader:
    """What a video file declares; `frames` may be inexact, 0 if it declares none."""

    width_px: int
    height_px: int
    frames: int


def read_video_header(file: Path) -> VideoHeader:
    """Read what a video file declares; nothing is decoded but its first packets.

    Raises:
        InputError: it is missing, no video, or its frames are larger than an image may be.
    """
    import cv2

    fix = "convert it to MP4 (H.264), or to images"
    refuse = partial(InputError, "The video cannot be read", where=file, fix=fix)
    open_file(file, refuse).close()
    video = cv2.VideoCapture(str(file))
    try:
        opened = video.isOpened()
        width_px, height_px, frames = (
            int(video.get(key)) if opened else 0
            for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
        )
    finally:
        video.release()
    if width_px <= 0 or height_px <= 0:
        raise refuse(expected="a video that OpenCV can decode", got="a file that it cannot")
    if width_px * height_px > MAX_PIXELS:
        raise refuse(expected=f"frames of at most {MAX_PIXELS} pixels", got=f"{width_px} x {height_px}")
    return VideoHeader(width_px=width_px, height_px=height_px, frames=max(0, frames))
