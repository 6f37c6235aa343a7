"""Small pictures of registered heads for tables."""

import cv2
import numpy as np
import torch
from jaxtyping import Float

from registration.frames import axis_angle_to_matrix, linear_to_srgb
from registration.geometry.rasterizer import rasterize
from registration.report.pictures import BACKGROUND, RgbImage
from registration.types import Camera, Registration

_WIDTH_PX, _HEIGHT_PX = 144, 192  # of a thumbnail
_OVERSAMPLING = 2


def thumbnail(registration: Registration) -> RgbImage | None:
    """Return an image of the textured head from the front; None if its vertices are not finite."""
    if not np.isfinite(registration.vertices).all():
        return None
    R_world_head = axis_angle_to_matrix(torch.from_numpy(registration.rotations[0].astype(np.float64))).numpy()
    head = registration.vertices @ R_world_head  # to the model's frame: +Y up, +Z out of the face
    camera = _front(head, _OVERSAMPLING * _WIDTH_PX, _OVERSAMPLING * _HEIGHT_PX)
    face, barycentric = rasterize(head, registration.triangles, camera)
    covered = face >= 0
    uv = np.einsum("pk,pkc->pc", barycentric[covered], registration.corner_uvs[face[covered]])
    size = len(registration.texture)
    column, row = (np.clip((uv * (1, -1) + (0, 1)) * size, 0, size - 1)).astype(np.int64).T
    image = np.empty((*face.shape, 3), np.float32)
    image[:] = BACKGROUND
    image[covered] = 255 * linear_to_srgb(registration.texture[row, column])
    small = cv2.resize(image, (_WIDTH_PX, _HEIGHT_PX), interpolation=cv2.INTER_AREA)
    return np.clip(small + 0.5, 0, 255).astype(np.uint8)


def _front(head: Float[np.ndarray, "V 3"], width_px: int, height_px: int) -> Camera:
    """Return a camera two metres in front of a head (model frame) that fills the image."""
    low, high = head.min(0), head.max(0)
    distance = 2.0  # metres
    focal = 0.96 * distance * min(np.array([width_px, height_px]) / (high - low)[:2])
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ ((low + high) / 2) + (0, 0, distance)
    intrinsics = np.array([[focal, 0, width_px / 2], [0, focal, height_px / 2], [0, 0, 1]])
    return Camera(width_px=width_px, height_px=height_px, intrinsics=intrinsics, T_cam_world=pose)
