"""Lens models as functions from undistorted to distorted points of the plane z = 1.

Undistorting an image needs only this direction: each pixel of the new image is projected through the lens. The models
beyond OpenCV's are COLMAP's, https://colmap.github.io/cameras.html; its fisheye models first scale a point from the
tangent of its angle to the angle itself (Kannala and Brandt 2006).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.formats.photogrammetry_lenses import LENSES
from registration.formats.source import Distortion

Points = Float[np.ndarray, "P 2"]
Coefficients = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class DistortionModel:
    """A lens model.

    Attributes:
        names: of the coefficients, in their order; missing ones at the end are 0.
        distort: coefficients and undistorted points to distorted points; NaN where the lens sees nothing.
        opencv: coefficients in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]] that are the same lens; None: there are none,
            and images are undistorted when they are imported.
    """

    names: tuple[str, ...]
    distort: Callable[[Coefficients, Points], Points]
    opencv: Callable[[Coefficients], Coefficients] | None = None


def distort(distortion: Distortion, points: Points) -> Points:
    """Return the distorted points of undistorted ones. Raises KeyError for an unknown model."""
    model = MODELS[distortion.model]
    missing = len(model.names) - len(distortion.coefficients)
    return model.distort((*distortion.coefficients, *[0.0] * missing), points)


def _brown(coefficients: Coefficients, points: Points) -> Points:
    """OpenCV's rational model with tangential distortion."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def _ratio(numerator: np.ndarray, denominator: np.ndarray, limit: float) -> np.ndarray:
    """A quotient with its limit where both are about 0."""
    small = np.abs(denominator) < 1e-9
    return np.where(small, limit, numerator / np.where(small, 1.0, denominator))


def _equidistant(points: Points) -> Points:
    """From the tangent of the angle to the optical axis to the angle."""
    r = np.linalg.norm(points, axis=-1)
    return points * _ratio(np.arctan(r), r, 1.0)[:, None]


def _fisheye(k: Coefficients, points: Points) -> Points:
    """OpenCV's fisheye model: a polynomial of the angle."""
    angles = _equidistant(points)
    t2 = (angles * angles).sum(-1, keepdims=True)
    return angles * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


def _thin_prism_fisheye(coefficients: Coefficients, points: Points) -> Points:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
    u, v = _equidistant(points).T
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2
    y = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2
    return np.stack([x, y], -1)


def _rad_tan_thin_prism_fisheye(coefficients: Coefficients, points: Points) -> Points:
    """That of Project Aria's cameras: the tangential and prism terms follow the radial ones."""
    *k, p0, p1, s0, s1, s2, s3 = coefficients
    angles = _equidistant(points)
    t2 = (angles * angles).sum(-1, keepdims=True)
    radial = 1 + sum(value * t2**power for power, value in enumerate(k, 1))
    x, y = (angles * radial).T
    r2 = x * x + y * y
    dx = 2 * p1 * x * y + p0 * (r2 + 2 * x * x) + r2 * (s0 + s1 * r2)
    dy = 2 * p0 * x * y + p1 * (r2 + 2 * y * y) + r2 * (s2 + s3 * r2)
    return np.stack([x + dx, y + dy], -1)


def _fov(coefficients: Coefficients, points: Points) -> Points:
    """Devernay and Faugeras 2001."""
    (omega,) = coefficients
    if abs(omega) < 1e-9:
        return points
    r = np.linalg.norm(points, axis=-1)
    twice = 2 * np.tan(omega / 2)
    return points * _ratio(np.arctan(r * twice), r * omega, float(twice / omega))[:, None]


def _division(coefficients: Coefficients, points: Points) -> Points:
    """The undistorted point is the distorted one divided by 1 + k r2 (Fitzgibbon 2001)."""
    (k,) = coefficients
    square = 1 - 4 * k * (points * points).sum(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return 2 * points / (1 + np.sqrt(square))


def _eucm(coefficients: Coefficients, points: Points) -> Points:
    """The extended unified camera model (Khomutenko et al. 2016)."""
    alpha, beta = coefficients
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = alpha * np.sqrt(1 + beta * (points * points).sum(-1, keepdims=True)) + 1 - alpha
        return np.where(depth > 1e-12, points / depth, np.nan)


MODELS: Mapping[str, DistortionModel] = {
    "none": DistortionModel(names=(), distort=lambda _, points: points, opencv=lambda _: ()),
    "opencv": DistortionModel(
        names=("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), distort=_brown, opencv=lambda coefficients: coefficients
    ),
    "opencv_fisheye": DistortionModel(names=("k1", "k2", "k3", "k4"), distort=_fisheye),
    "thin_prism_fisheye": DistortionModel(
        names=("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), distort=_thin_prism_fisheye
    ),
    "rad_tan_thin_prism_fisheye": DistortionModel(
        names=("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
        distort=_rad_tan_thin_prism_fisheye,
    ),
    "fov": DistortionModel(names=("omega",), distort=_fov),
    "division": DistortionModel(names=("k",), distort=_division),
    "eucm": DistortionModel(names=("alpha", "beta"), distort=_eucm),
    **{name: DistortionModel(names=names, distort=lens) for name, (names, lens) in LENSES.items()},
}
