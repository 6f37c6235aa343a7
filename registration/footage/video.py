"""The frames of a video file, decoded by OpenCV one after another."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from registration.errors import InputError
from registration.footage.options import FootageOptions
from registration.formats.videos import read_video_header

_DEFAULT_RATE = 25.0  # frames a second, where the file states none
_MAX_RATE = 1000.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One frame."""

    number: int  # in the file, from 0
    time_s: float
    pixels: UInt8[np.ndarray, "H W 3"]  # sRGB


@dataclass(frozen=True, kw_only=True)
class Video:
    """A video file, and which of its frames are used."""

    file: Path
    width_px: int
    height_px: int
    rate: float  # frames a second
    declared: int  # frames that the file declares, 0 if it declares none
    start: int = 0
    end: int | None = None
    every: int = 1

    @property
    def expected(self) -> int:
        """How many frames are used, by what the file declares; 0 if it declares nothing."""
        last = self.declared if self.end is None else min(self.end, self.declared or self.end)
        return max(0, -(-(last - self.start) // self.every))

    def frames(self) -> Iterator[Frame]:
        """Yield the used frames in order.

        Raises:
            InputError: a frame has another size than the first one, or a decoded frame is damaged.
        """
        video = cv2.VideoCapture(str(self.file))
        try:
            number = 0
            while (self.end is None or number < self.end) and video.grab():
                if number >= self.start and (number - self.start) % self.every == 0:
                    whole, pixels = video.retrieve()
                    if not whole:
                        break
                    self._check(pixels, number)
                    time_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                    usable = np.isfinite(time_s) and time_s > 0
                    yield Frame(
                        number=number,
                        time_s=float(time_s) if usable else number / self.rate,
                        pixels=cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB),
                    )
                number += 1
        finally:
            video.release()

    def _check(self, pixels: np.ndarray, number: int) -> None:
        size = pixels.shape[1::-1]
        if size != (self.width_px, self.height_px):
            raise InputError(
                "The frames of the video have different sizes",
                where=f"frame {number} of {self.file}",
                expected=f"{self.width_px} x {self.height_px}, as its first frame",
                got=f"{size[0]} x {size[1]}",
                fix="cut the video where its size changes, and fit the parts",
            )


def open_video(file: Path, options: FootageOptions) -> Video:
    """Read what a video declares, and decode its first frame.

    Raises:
        InputError: it cannot be decoded, or has no frame from `--start` on.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    header = read_video_header(file)
    video = cv2.VideoCapture(str(file))
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
        whole, pixels = video.read()
    finally:
        video.release()
    if not whole:
        raise InputError(
            "The video cannot be decoded",
            where=file,
            expected="a first frame",
            got="none that can be decoded",
            fix="convert it to MP4 (H.264), or repair it",
        )
    declared = header.frames if header.frames < 2**31 else 0
    if declared and options.start >= declared:
        raise InputError(
            "The video ends before --start",
            where=file,
            expected=f"--start below {declared}, its number of frames",
            got=options.start,
            fix="choose an earlier frame",
        )
    return Video(
        file=file,
        width_px=pixels.shape[1],
        height_px=pixels.shape[0],
        rate=float(rate) if 0 < rate < _MAX_RATE else _DEFAULT_RATE,
        declared=declared,
        start=options.start,
        end=options.end,
        every=options.every,
    )
