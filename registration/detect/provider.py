"""The interface of landmark providers: an image -> faces with named points, their confidence and spread."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True, kw_only=True, eq=False)
class Face:
    """One detected face. Pixels are those of the image that was given; the centre of pixel (0, 0) is at (0.5, 0.5)."""

    points: Float[np.ndarray, "L 2"]  # px
    confidence: Float[np.ndarray, "L"]  # in [0, 1]: whether the point is seen
    spread_px: Float[np.ndarray, "L"]  # standard deviation of its position along each axis, px
    presence: float  # in [0, 1]: whether there is a face, the least of all passes
    box: Float[np.ndarray, "4"]  # x0 y0 x1 y1, px
    roll: float = 0.0  # in-plane rotation of the face, radians, positive from the image's x to its y axis
    hints: Mapping[str, float] = field(default_factory=dict)  # blendshape -> score in [0, 1], of the expression


@runtime_checkable
class LandmarkProvider(Protocol):
    """Detects the landmarks of one scheme in single images."""

    @property
    def scheme(self) -> str:
        """Name of the scheme: of the landmarks in captures, and of the model's map."""
        ...

    @property
    def count(self) -> int:
        """How many landmarks the scheme has."""
        ...

    @property
    def version(self) -> str:
        """Name and digest of all that decides its results; part of the input hash."""
        ...

    def detect(self, image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
        """Return the faces in an image, red green blue, sRGB, without distortion; the most certain first."""
        ...


@runtime_checkable
class FollowingProvider(LandmarkProvider, Protocol):
    """A provider that is quicker where a face was in the frame before."""

    def follow(self, image: UInt8[np.ndarray, "H W 3"], before: Face) -> Face | None:
        """Return the face near a face of the frame before, or None if there is none."""
        ...
