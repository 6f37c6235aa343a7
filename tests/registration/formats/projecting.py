"""What the tests of single formats share: small images, and the projection of a point by a view that was read."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from registration.formats.distortions import distort
from registration.formats.source import SourceView


def image(file: Path, width_px: int, height_px: int, grey: int = 128) -> Path:
    """Write a grey image."""
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), np.full((height_px, width_px, 3), grey, np.uint8))
    return file


def video(file: Path, width_px: int, height_px: int, frames: int) -> Path:
    """Write a video whose frame number i has the grey value 40 + 20 i."""
    file.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 25, (width_px, height_px))
    assert writer.isOpened()
    for index in range(frames):
        writer.write(np.full((height_px, width_px, 3), 40 + 20 * index, np.uint8))
    writer.release()
    return file


def project(view: SourceView, *point: float) -> Float[np.ndarray, "2"]:
    """Return the pixel of a point of the source's world."""
    local = view.T_cam_world[:3, :3] @ point + view.T_cam_world[:3, 3]
    assert local[2] > 0, "behind the camera"
    plane = distort(view.distortion, (local[:2] / local[2])[None])[0]
    return (view.intrinsics @ [*plane, 1.0])[:2]
