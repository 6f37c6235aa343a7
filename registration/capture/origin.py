"""The origin around which a capture is computed."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from registration.frames import local_origin
from registration.types import Camera

_TOWARDS_CAMERAS = 0.02  # weight of the cameras' mean position against each optical axis


def capture_origin(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Return `local_origin` of the point that the cameras look at, metres, world.

    It is the point nearest to the optical axes; where these are nearly parallel, it is drawn to the cameras.
    """
    centres = np.stack([camera.centre for camera in cameras])
    axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    middle = centres.mean(0)
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    matrix = across.sum(0) + _TOWARDS_CAMERAS * len(cameras) * np.eye(3)
    return local_origin(middle + np.linalg.solve(matrix, np.einsum("nij,nj->i", across, centres - middle)))


def in_world(points: Float[np.ndarray, "*P 3"], origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*P 3"]:
    """Return points of a fit in the capture's world: as they are, or in float64 where its origin is far."""
    return points + origin if origin.any() else points
