"""What of an image, a folder, a video or a capture is fitted, and how; nothing heavy is imported here."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from registration.errors import InputError

DETECTOR = "face478"
MeshFormat = Literal["obj", "glb"]
_OPTIONAL = "(optional)"


@dataclass(frozen=True, kw_only=True)
class FootageOptions:
    """What is fitted, and how.

    Attributes:
        landmarks: Landmarks of any program or person instead of detected ones: NAME.json or a folder of them, as in a
            capture's landmarks/, or for a video an NPZ file with points, frames x landmarks x 2 or 3.
        detector: What detects landmarks: face478, or the import path MODULE:FUNCTION of a provider.
        face: Which of several faces, 1 for the largest, 2 for the next; the largest without it. In a video, of its
            first frame with a face.
        focal: Focal length of all cameras in pixels, if it is known. Otherwise it is estimated, about the one in the
            EXIF data where an image has it.
        principal_point: Estimate the principal point, which else is the centre of the image.
        distortion: Estimate a coefficient of radial distortion.
        expression_sigma: Standard deviation that is expected of expression coefficients.
        identity_from: The known identity of the subject: a registration's folder, or what this command wrote.
        temporal: Treat the frames of a video as independent of one another.
        every: Use every Nth frame of a video.
        start: First frame of a video, counted from 0.
        end: Frame of a video before which to stop; the last one without it.
        meshes: Write meshes of the --frames, of all if none are named, in this format.
        frames: Numbers of frames in the video, separated by commas, whose meshes are written.
        video: Write no video of the fit.
    """

    landmarks: Annotated[Path | None, arg(metavar="FILE|DIR", help_behavior_hint=_OPTIONAL)] = None
    detector: Annotated[str, arg(metavar="NAME")] = DETECTOR
    face: Annotated[int | None, arg(metavar="N", help_behavior_hint=_OPTIONAL)] = None
    focal: Annotated[float | None, arg(metavar="PX", help_behavior_hint=_OPTIONAL)] = None
    principal_point: bool = False
    distortion: bool = False
    expression_sigma: Annotated[float, arg(metavar="S")] = 0.5
    identity_from: Annotated[Path | None, arg(metavar="FIT|REG", help_behavior_hint=_OPTIONAL)] = None
    temporal: bool = True
    every: Annotated[int, arg(metavar="N")] = 1
    start: Annotated[int, arg(metavar="N")] = 0
    end: Annotated[int | None, arg(metavar="N", help_behavior_hint=_OPTIONAL)] = None
    meshes: Annotated[MeshFormat | None, arg(help_behavior_hint=_OPTIONAL)] = None
    frames: Annotated[str | None, arg(metavar="N,N,...", help_behavior_hint=_OPTIONAL)] = None
    video: bool = True

    def __post_init__(self) -> None:
        """Refuse values out of range. Raises InputError."""
        if self.focal is not None and not (math.isfinite(self.focal) and self.focal > 0):
            raise _out_of_range("--focal", "a focal length in pixels, above 0", self.focal)
        if not (math.isfinite(self.expression_sigma) and 0 < self.expression_sigma <= 100):
            raise _out_of_range("--expression-sigma", "a number above 0, at most 100", self.expression_sigma)
        if self.face is not None and self.face < 1:
            raise _out_of_range("--face", "1 for the largest face, or more", self.face)
        if self.every < 1:
            raise _out_of_range("--every", "1 or more", self.every)
        if self.start < 0:
            raise _out_of_range("--start", "0 or more", self.start)
        if self.end is not None and self.end <= self.start:
            raise _out_of_range("--end", f"more than --start, {self.start}", self.end)
        self.mesh_frames()

    def mesh_frames(self) -> tuple[int, ...] | None:
        """Return the numbers of `frames`; None: all. Raises InputError if they are no numbers."""
        if self.frames is None:
            return None
        words = self.frames.split(",")
        if not all(word.strip().isdecimal() for word in words):
            raise _out_of_range("--frames", "numbers of frames, as 0,10,20", self.frames)
        return tuple(int(word) for word in words)


def _out_of_range(name: str, expected: str, got: object) -> InputError:
    return InputError("An option is out of range", where=name, expected=expected, got=got, fix="choose another value")
