"""Videos that browsers play, by the encoder that OpenCV carries: VP8 in WebM (libvpx, BSD; see docs/adr/0015)."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from registration.storage.image_files import quiet_decoders

SUFFIX = ".webm"
_CODEC = "VP80"


class VideoWriter:
    """Writes frames of one size, until `close`.

    Args:
        file: to write, `*.webm`.
        size_px: width and height of the frames; both even.
        rate: frames a second.

    Raises:
        OSError: this OpenCV has no such encoder, or the file cannot be written.
    """

    def __init__(self, file: Path, size_px: tuple[int, int], rate: float) -> None:
        with quiet_decoders():  # it complains about the name of the codec, which WebM does not need
            fourcc = cv2.VideoWriter.fourcc(*_CODEC)
            self._writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, fourcc, rate, size_px)
        if not self._writer.isOpened():
            raise OSError(f"OpenCV {cv2.__version__} cannot write {_CODEC} videos")

    def add(self, frame: UInt8[np.ndarray, "_ _ 3"]) -> None:
        """Append a frame, sRGB."""
        self._writer.write(np.ascontiguousarray(frame[..., ::-1]))

    def close(self) -> None:
        """Finish the file."""
        self._writer.release()


def even_size(width_px: int, height_px: int, longest_px: int) -> tuple[int, int]:
    """Return a size of even numbers, whose longer side is at most `longest_px`."""
    scale = min(1.0, longest_px / max(width_px, height_px))
    return max(2, 2 * round(width_px * scale / 2)), max(2, 2 * round(height_px * scale / 2))
