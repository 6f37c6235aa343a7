"""Virtual cameras around a head that was placed in a scan."""

import numpy as np
from jaxtyping import Float

from registration.types import Camera

SIZE_PX = 640  # of an image; the head fills most of it
_DISTANCE_M, _FILLED = 1.0, 0.9
_HEAD_M = 0.30  # of the model's head without the neck, from chin to crown, with a margin
# Yaw towards the subject's left and elevation of the directions, degrees: dense before the face, sparse behind.
_DIRECTIONS = (
    *((yaw, 0.0) for yaw in (0, -30, 30, -60, 60, -90, 90, -135, 135, 180)),
    *((yaw, -25.0) for yaw in (0, -40, 40, -80, 80)),
    *((yaw, 30.0) for yaw in (0, -45, 45, -90, 90, 180)),
    (0.0, 65.0),
)


def head_cameras(
    centre: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"], scale: float, size_px: int = SIZE_PX
) -> dict[str, Camera]:
    """Return cameras that look at a head from all sides, by names that say from where.

    Args:
        centre: of the head, world, metres.
        rotation: of the head, world from model.
        scale: of the head, relative to the model.
        size_px: width and height of the images.
    """
    distance = _DISTANCE_M * scale
    focal = _FILLED * size_px * distance / (_HEAD_M * scale)
    intrinsics = np.array([[focal, 0, size_px / 2], [0, focal, size_px / 2], [0, 0, 1]])
    cameras = {}
    for number, (yaw, pitch) in enumerate(_DIRECTIONS):
        a, b = np.radians(yaw), np.radians(pitch)
        away = rotation @ [np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)]
        right = rotation @ [np.cos(a), 0.0, -np.sin(a)]  # of the image, which faces -away
        T = np.eye(4)
        T[:3, :3] = [right, np.cross(-away, right), -away]
        T[:3, 3] = -T[:3, :3] @ (centre + distance * away)
        name = f"view{number:02d}_yaw{yaw:+04.0f}_up{pitch:+03.0f}"
        cameras[name] = Camera(width_px=size_px, height_px=size_px, intrinsics=intrinsics, T_cam_world=T)
    return cameras
