"""Conventions of frames, units, pixels and colours, and the conversions between them.

- Lengths are metres, angles radians; metrics are in millimetres.
- World and model frames are right-handed; the model's is +Y up, +Z out of the face, +X the subject's left.
- The camera frame is OpenCV's: x right, y down, z forward. `T_dst_src` maps points: p_dst = T_dst_src @ p_src.
- Pixel (0, 0)'s *centre* is at (0.5, 0.5), as in COLMAP. OpenCV's own functions put it at (0, 0): convert K first.
- Images are sRGB on disk and linear inside.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

MM_PER_M = 1e3
NEAR_ORIGIN_M = 5.0  # a subject within it is computed in the capture's world itself
_FLOAT32_M = 8.0  # float32 is accurate to 0.25 micrometres within it


def axis_angle_to_matrix(axis_angle: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Convert axis-angle (radians) to a matrix (Rodrigues' formula); differentiable everywhere, also at zero."""
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < 1e-8
    # The double `where` keeps the unused branch finite, so that its zero gradient is not 0 * inf.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return eye + a * cross + b * (cross @ cross)


def matrix_to_axis_angle(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Convert one rotation matrix to axis-angle (radians); the angle is in [0, pi]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.asarray(rotation, np.float64)).as_rotvec()


def transform_points(
    transform: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    """Apply a rigid or affine 4x4 transform to points."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def local_origin(subject: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the origin near a subject around which it is computed, world, whole metres; zero if the world's is near.

    Georeferenced worlds have coordinates of thousands of kilometres, for which float32 has steps of half a metre.

    Args:
        subject: about where it is, metres, world.
    """
    return np.zeros(3) if np.linalg.norm(subject) < NEAR_ORIGIN_M else np.round(np.asarray(subject, np.float64))


def compact(points: Float[np.ndarray, "*P 3"]) -> Float[np.ndarray, "*P 3"]:
    """Return points (m) as float32, or as float64 where float32 would lose micrometres."""
    return np.asarray(points, np.float64 if (np.abs(points) > _FLOAT32_M).any() else np.float32)


def opencv_intrinsics(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return K for OpenCV's functions, which put the centre of pixel (0, 0) at (0, 0) instead of (0.5, 0.5)."""
    shifted = np.array(intrinsics, np.float64)
    shifted[:2, 2] -= 0.5
    return shifted


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4).astype(
        value.dtype
    )


def linear_to_srgb(value: np.ndarray) -> np.ndarray:
    """Convert linear light, clipped to [0, 1], to sRGB in [0, 1]."""
    value = np.clip(value, 0.0, 1.0)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055).astype(
        value.dtype
    )
