"""How photographs are calibrated; nothing heavy is imported here."""

import math
from dataclasses import dataclass
from typing import Literal

from registration.errors import InputError

GroupBy = Literal["camera", "size", "folder", "view"]


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """How photographs are calibrated.

    Attributes:
        focal_px: The focal length of all cameras in pixels, if it is known. Otherwise it is estimated, from the one in
            the photographs' EXIF data if they have it.
        group_by: Which photographs share a focal length: those of one camera and setting (by EXIF data and size), of
            one size, of one folder and size, or none (view).
        focal_spread: How much focal lengths differ within a group: their standard deviation as a fraction, 0 if they
            are equal.
        distortion: Estimate a coefficient of radial distortion for each group.
        pupil_distance_mm: The distance of the person's pupils, as opticians measure it, which gives the scale.
            Otherwise the head model does, to some percent.
        camera_distance: The names of two photographs and the distance of their cameras in metres, which gives the
            scale.
        provider: What detects the landmarks: face478, or the import path MODULE:FUNCTION of a provider.
        subject: Name of the subject; the folder's name if none is given.
        expression: Name of the expression.
    """

    focal_px: float | None = None
    group_by: GroupBy = "camera"
    focal_spread: float = 0.02
    distortion: bool = False
    pupil_distance_mm: float | None = None
    camera_distance: tuple[str, str, float] | None = None
    provider: str = "face478"
    subject: str | None = None
    expression: str = "neutral"

    def __post_init__(self) -> None:
        """Refuse values out of range. Raises InputError."""
        if self.focal_px is not None and not (math.isfinite(self.focal_px) and self.focal_px > 1):
            raise _out_of_range("--focal-px", "a focal length in pixels", self.focal_px)
        if not 0 <= self.focal_spread <= 0.5:
            raise _out_of_range("--focal-spread", "a fraction from 0 to 0.5", self.focal_spread)
        if self.pupil_distance_mm is not None and not 20 <= self.pupil_distance_mm <= 120:
            raise _out_of_range("--pupil-distance-mm", "20 to 120 mm", self.pupil_distance_mm)
        if self.camera_distance is not None and not 1e-3 <= self.camera_distance[2] <= 1e3:
            raise _out_of_range("--camera-distance", "0.001 to 1000 metres", self.camera_distance[2])


def _out_of_range(name: str, expected: str, got: float) -> InputError:
    return InputError("An option is out of range", where=name, expected=expected, got=got, fix="choose another value")
