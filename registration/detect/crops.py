"""Square crops of images, turned in the plane: where they lie, their pixels, and points from one to the other.

The centre of pixel (0, 0) is at (0.5, 0.5), in images and in crops.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True, kw_only=True, eq=False)
class Crop:
    """A square of an image: its centre, side and turn."""

    centre: Float[np.ndarray, "2"]  # px of the image
    side: float  # px of the image
    roll: float = 0.0  # radians, from the image's x axis to the crop's

    @classmethod
    def around(cls, points: Float[np.ndarray, "L 2"], roll: float, scale: float) -> "Crop":
        """Return the square around points, upright at a turn, `scale` times as large as their bounding square."""
        turned = points @ _rotation(roll)
        low, high = turned.min(0), turned.max(0)
        return cls(centre=_rotation(roll) @ (low + high) / 2, side=scale * float((high - low).max()), roll=roll)

    @classmethod
    def whole(cls, image: UInt8[np.ndarray, "H W 3"]) -> "Crop":
        """Return the smallest upright square around a whole image."""
        height, width = image.shape[:2]
        return cls(centre=np.array([width / 2, height / 2]), side=float(max(height, width)))

    def moved(self, shift: tuple[float, float], scale: float, turn: float) -> "Crop":
        """Return the crop shifted by fractions of its side along its own axes, scaled, and turned (radians)."""
        centre = self.centre + self.side * (_rotation(self.roll) @ np.array(shift))
        return Crop(centre=centre, side=self.side * scale, roll=self.roll + turn)

    def to_image(self, points: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
        """Return points of the crop, as fractions of its side, in px of the image."""
        return self.centre + self.side * (points - 0.5) @ _rotation(self.roll).T

    def from_image(self, points: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
        """Return points of the image (px) as fractions of the crop's side."""
        return (points - self.centre) @ _rotation(self.roll) / self.side + 0.5

    @property
    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Its corners in px of the image, clockwise from the crop's upper left."""
        return self.to_image(np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]]))

    def pixels(self, image: UInt8[np.ndarray, "H W 3"], size: int, *, black: bool = False) -> np.ndarray:
        """Resample the crop to `size` x `size` px, without aliasing.

        Args:
            image: of any three channels.
            size: of the result, px.
            black: beyond the image the crop is black; else the image's rim is repeated.

        Returns:
            (size, size, 3) uint8.
        """
        border = cv2.BORDER_CONSTANT if black else cv2.BORDER_REPLICATE
        factor = max(1, int(self.side / size))
        corner = np.zeros(2)
        if factor > 1:  # means of blocks first: bilinear samples of a large crop would miss pixels
            corner, image = _window(image, self.corners, factor)
        step = self.side / size / factor
        linear = step * _rotation(self.roll)
        centre = (self.centre - corner) / factor
        # OpenCV counts from the centre of pixel (0, 0).
        offset = centre - 0.5 + linear @ np.full(2, 0.5 - size / 2)
        matrix = np.column_stack([linear, offset])
        return cv2.warpAffine(
            image, matrix, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=border
        )


def _window(image: np.ndarray, corners: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """The part of an image around corners, reduced by a whole factor, and its corner in the image."""
    height, width = image.shape[:2]
    low = np.clip(np.floor(corners.min(0)).astype(int) - factor, 0, [width - 1, height - 1])
    high = np.clip(np.ceil(corners.max(0)).astype(int) + factor, low + 1, [width, height])
    columns, rows = np.maximum(1, (high - low) // factor)
    part = image[low[1] : low[1] + rows * factor, low[0] : low[0] + columns * factor]
    return low.astype(np.float64), cv2.resize(part, (int(columns), int(rows)), interpolation=cv2.INTER_AREA)


def _rotation(angle: float) -> Float[np.ndarray, "2 2"]:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])
