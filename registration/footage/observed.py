"""What is fitted: landmarks with their views and frames, and where they come from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.errors import InputError
from registration.footage.media import Kind
from registration.landmark_fit.observations import Observations
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """One view of a moment, for pictures."""

    name: str
    image: str  # file's name
    pixels: Callable[[], UInt8[np.ndarray, "H W 3"]]  # sRGB; of calibrated cameras without distortion
    camera: Camera | None  # of these pixels; None: the fit's


@dataclass(frozen=True, kw_only=True, eq=False)
class Footage:
    """The landmarks of an input: one frame of several views, or the frames of a video."""

    kind: Kind
    source: Path
    subject: str
    expression: str
    observations: Observations
    sights: tuple[Sight, ...]  # of a moment's views; none for a video
    numbers: Int[np.ndarray, "F"]  # of the frames in the video
    times_s: Float[np.ndarray, "F"]
    detected: bool  # by a detector, whose neighbouring landmarks err alike
    focal_guess: float | None = None  # by EXIF, relative to the longer side of the image
    focal_source: str = "estimated"  # in words
    notes: tuple[str, ...] = ()
    digests: Mapping[str, str] = field(default_factory=dict)  # input -> sha256


def scheme_of(schemes: Mapping[str, LandmarkScheme], name: str, count: int, where: object) -> LandmarkScheme:
    """Return the model's map of some landmarks.

    Args:
        schemes: of the model.
        name: of the landmarks' scheme.
        count: how many there are.
        where: they come from, for messages.

    Raises:
        InputError: the model has no such map, or one of another length.
    """
    if name not in schemes:
        raise InputError(
            "The model has no map of these landmarks",
            where=where,
            expected=f"a scheme of the model: {', '.join(sorted(schemes)) or 'it has none'}",
            got=name,
            fix=f"write head_sparse_{name}.txt beside the model, or make it with gnmreg model landmarks",
        )
    if len(schemes[name].indices) != count:
        raise InputError(
            "Landmarks of another length than the model's map",
            where=where,
            expected=f"{len(schemes[name].indices)} landmarks of scheme {name}",
            got=count,
            fix="give landmarks in the scheme's order, null where one is not seen",
        )
    return schemes[name]
