"""Cameras of RealityScan and RealityCapture, as its CSV and XMP files both describe them.

"RealityCapture XMP camera math" (support.capturingreality.com): image coordinates count from the middle of the image in
units of its longer side, y down; `FocalLength35mm` / 36 and the principal point are in these units. Brown's models
distort the plane z = 1, before the calibration; the division model distorts image coordinates, after it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.formats.photogrammetry_lenses import brown_lens
from registration.formats.source import Distortion

FILM_MM = 36.0  # longer side of the film that focal lengths are equivalent to
MODELS = ("perspective", "brown3", "brown3t2", "brown4", "brown4t2", "division")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The values of a file."""

    focal_35mm: float
    px: float = 0.0
    py: float = 0.0
    aspect: float = 1.0
    skew: float = 0.0
    model: str = "brown4t2"  # one of MODELS
    coefficients: tuple[float, ...] = (0.0,) * 6  # k1 k2 k3 k4 t1 t2; of a division model k


def intrinsics(c: Calibration, width_px: int, height_px: int) -> Float[np.ndarray, "3 3"]:
    """Return K in px for an image of this size, centre of pixel (0, 0) at (0.5, 0.5)."""
    side = max(width_px, height_px)
    f = c.focal_35mm / FILM_MM * side
    return np.array(
        [
            [f, c.skew * side, width_px / 2 + c.px * side],
            [0, f * c.aspect, height_px / 2 + c.py * side],
            [0, 0, 1],
        ]
    )


def distortion(c: Calibration) -> Distortion:
    """Return the lens. Tangential terms are Brown's: t1 bends along x, and OpenCV has them exchanged."""
    if c.model == "perspective":
        return Distortion(model="none")
    if c.model == "division":
        k = c.coefficients[0]
        values = (k, c.focal_35mm / FILM_MM, c.aspect, c.skew, c.px, c.py)
        return Distortion(model="realityscan_division", coefficients=values) if k else Distortion(model="none")
    return brown_lens(c.coefficients[:4], c.coefficients[4:])
