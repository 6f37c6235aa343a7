"""Cameras for audits of heads."""

import numpy as np

from registration.types import Camera


def looking_at(middle: np.ndarray, towards: np.ndarray, distance_m: float, size_px: int) -> Camera:
    """A camera in a horizontal direction from a place, that looks at it; its focal length is its width."""
    out = towards / np.linalg.norm(towards)
    pose = np.eye(4)
    pose[:3, :3] = [np.cross([0.0, 1.0, 0.0], out), [0.0, -1.0, 0.0], -out]
    pose[:3, 3] = -pose[:3, :3] @ (middle + distance_m * out)
    intrinsics = np.array([[size_px, 0, size_px / 2], [0, size_px, size_px / 2], [0, 0, 1.0]])
    return Camera(width_px=size_px, height_px=size_px, intrinsics=intrinsics, T_cam_world=pose)
