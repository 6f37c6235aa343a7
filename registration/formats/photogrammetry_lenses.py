"""Lenses of photogrammetry programs as functions from undistorted to distorted points of the plane z = 1.

Coefficients are in the programs' own order. Brown's model has the tangential terms as in the literature and in
Metashape, RealityScan and BlocksExchange: p1 bends along x, p2 along y. OpenCV has the two exchanged.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from registration.formats.source import Distortion

Points = Float[np.ndarray, "P 2"]
BROWN_NAMES = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
DIVISION_NAMES = ("k", "f", "aspect", "skew", "px", "py")


def brown_lens(radial: Sequence[float], tangential: Sequence[float]) -> Distortion:
    """Return the lens of Brown's model with up to four radial and four tangential coefficients.

    Args:
        radial: k1 to k4; missing ones are 0.
        tangential: p1 to p4; missing ones are 0. p3 and p4 are factors of the tangential terms.

    Returns:
        OpenCV's model where it is the same lens, with p1 and p2 exchanged.
    """
    k1, k2, k3, k4 = (*radial, *[0.0] * (4 - len(radial)))
    p1, p2, p3, p4 = (*tangential, *[0.0] * (4 - len(tangential)))
    if k4 or ((p3 or p4) and (p1 or p2)):
        return Distortion(model="brown", coefficients=(k1, k2, k3, k4, p1, p2, p3, p4))
    if not any((k1, k2, k3, p1, p2)):
        return Distortion(model="none")
    return Distortion(model="opencv", coefficients=(k1, k2, p2, p1, k3))


def brown(coefficients: tuple[float, ...], points: Points) -> Points:
    """Brown's model, Metashape's "frame" camera: `BROWN_NAMES`."""
    k1, k2, k3, k4, p1, p2, p3, p4 = coefficients
    x, y = points.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    factor = 1 + r2 * (p3 + r2 * p4)
    return np.stack(
        [
            x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * factor,
            y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * factor,
        ],
        -1,
    )


def equidistant_brown(coefficients: tuple[float, ...], points: Points) -> Points:
    """Metashape's "fisheye" camera: the angle from the axis as radius, then Brown's model."""
    return brown(coefficients, _with_radius(points, np.arctan))


def equisolid_brown(coefficients: tuple[float, ...], points: Points) -> Points:
    """Metashape's "equisolid fisheye" camera: twice the sine of half the angle as radius, then Brown's model."""
    return brown(coefficients, _with_radius(points, lambda r: 2 * np.sin(np.arctan(r) / 2)))


def division(coefficients: tuple[float, ...], points: Points) -> Points:
    """RealityScan's division model: `DIVISION_NAMES`.

    It distorts image coordinates, in units of the longer side and from the image's middle: undistorted ones are
    distorted ones divided by 1 + k r^2. Points that no ray of the lens reaches are NaN.
    """
    k, f, aspect, skew, px, py = coefficients
    K = np.array([[f, skew, px], [0, f * aspect, py], [0, 0, 1]])
    image = points @ K[:2, :2].T + K[:2, 2]
    r2 = (image**2).sum(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1 - 4 * k * r2)  # of k r_u r_d^2 - r_d + r_u = 0, the solution that is r_u for k = 0
    distorted = image * 2 / (1 + root)
    return (distorted - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T


def _with_radius(points: Points, radius_of: Callable[[np.ndarray], np.ndarray]) -> Points:
    r = np.linalg.norm(points, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return points * np.where(r > 1e-12, radius_of(r) / r, 1.0)


Lens = Callable[[tuple[float, ...], Points], Points]
LENSES: Mapping[str, tuple[tuple[str, ...], Lens]] = {  # names of the coefficients, the lens
    "brown": (BROWN_NAMES, brown),
    "equidistant_brown": (BROWN_NAMES, equidistant_brown),
    "equisolid_brown": (BROWN_NAMES, equisolid_brown),
    "realityscan_division": (DIVISION_NAMES, division),
}
