"""The result of stereo for one view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.types import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthMap:
    """Depths, normals and confidences at the pixel centres of a pinhole camera."""

    camera: Camera  # without distortion, of these arrays' size
    depth: Float[np.ndarray, "H W"]  # along the optical axis, metres; 0 where none
    normals: Float[np.ndarray, "H W 3"]  # camera frame (OpenCV), unit, towards the camera; 0 where none
    confidence: Float[np.ndarray, "H W"]  # in [0, 1]; 0 where there is no depth
