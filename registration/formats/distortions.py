"""Lens models as functions from undistorted to distorted points of the plane z = 1.

Undistorting an image needs only this direction: each pixel of the new image is projected through the lens.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.formats.source import Distortion

Points = Float[np.ndarray, "P 2"]


@dataclass(frozen=True, kw_only=True)
class DistortionModel:
    """A lens model.

    Attributes:
        names: of the coefficients, in their order.
        distort: coefficients and undistorted points to distorted points.
        opencv: coefficients in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]] that are the same lens; None: there are none,
            and images are undistorted when they are imported.
    """

    names: tuple[str, ...]
    distort: Callable[[tuple[float, ...], Points], Points]
    opencv: Callable[[tuple[float, ...]], tuple[float, ...]] | None = None


def distort(distortion: Distortion, points: Points) -> Points:
    """Return the distorted points of undistorted ones. Raises KeyError for an unknown model."""
    return MODELS[distortion.model].distort(distortion.coefficients, points)


def _brown(coefficients: tuple[float, ...], points: Points) -> Points:
    """OpenCV's rational model with tangential distortion."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * (8 - len(coefficients))))
    x, y = points.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


MODELS: Mapping[str, DistortionModel] = {
    "none": DistortionModel(names=(), distort=lambda _, points: points, opencv=lambda _: ()),
    "opencv": DistortionModel(
        names=("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), distort=_brown, opencv=lambda coefficients: coefficients
    ),
}
