"""Heat maps: distances as colours on the shaded mesh, from three sides."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float

from registration.frames import transform_points
from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import vertex_normals
from registration.report.inputs import HeatMap
from registration.report.pictures import PAPER, Picture, scale_colours
from registration.types import Camera

SIDES = {"subject's right": -70.0, "front": 0.0, "subject's left": 70.0}  # yaw of the camera, degrees
LIMITS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # the colour scale ends at one of these
UNMEASURED = (186, 187, 190)
SIZE = (480, 520)  # width, height px of a picture
_OVERSAMPLING = 2
_FILLED = 0.94  # of the picture, by the head
_DISTANCE = 2.0  # m, camera to head: a portrait lens


def scale_limit_mm(distance_mm: Float[np.ndarray, "V"]) -> float:
    """Return the distance at which the colour scale ends: the first of `LIMITS_MM` at or above the 95th percentile."""
    known = distance_mm[np.isfinite(distance_mm)]
    wanted = np.percentile(known, 95) if len(known) else 0.0
    return next((limit for limit in LIMITS_MM if limit >= wanted), LIMITS_MM[-1])


def heat_pictures(
    heat: HeatMap, limit_mm: float, *, sides: Sequence[str] = tuple(SIDES), size: tuple[int, int] = SIZE
) -> list[tuple[str, Picture]]:
    """Draw a heat map from several sides.

    Args:
        heat: mesh and distances.
        limit_mm: distance at the end of the colour scale.
        sides: names from `SIDES`.
        size: width and height in px.

    Returns:
        Name of the side and picture, for each side.
    """
    head = transform_points(heat.T_head_world, heat.vertices.astype(np.float64))
    head -= (head.min(0) + head.max(0)) / 2
    cameras = _cameras(head, size)
    return [(side, _picture(heat, head, cameras[side], limit_mm, size)) for side in sides]


def _picture(
    heat: HeatMap, head: Float[np.ndarray, "V 3"], camera: Camera, limit_mm: float, size: tuple[int, int]
) -> Picture:
    face, barycentric = rasterize(head, heat.triangles, camera)
    shown = face >= 0
    corners = heat.triangles[face[shown]]
    weight = barycentric[shown]
    normals = vertex_normals(torch.from_numpy(head), torch.from_numpy(heat.triangles.astype(np.int64))).numpy()
    normal = np.einsum("pk,pkc->pc", weight, normals[corners])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    distance = (weight * heat.distance_mm[corners]).sum(1)  # NaN if any corner is
    albedo = np.where(np.isfinite(distance)[:, None], scale_colours(distance / limit_mm), UNMEASURED)
    picture = np.empty((*face.shape, 3))
    picture[:] = PAPER
    picture[shown] = albedo * _shading(normal @ camera.T_cam_world[:3, :3].T)[:, None]
    small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.clip(small + 0.5, 0, 255).astype(np.uint8)


def _shading(normal: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
    """Shade normals (camera frame) by a light from the upper left and a weak one from the right, to at least half."""
    key = np.array([-0.45, -0.65, -0.61])
    fill = np.array([0.8, -0.1, -0.59])
    return 0.50 + 0.42 * np.clip(normal @ key, 0, 1) + 0.16 * np.clip(normal @ fill, 0, 1)


def _cameras(head: Float[np.ndarray, "V 3"], size_px: tuple[int, int]) -> dict[str, Camera]:
    """Place a camera for each side, looking at the origin, all with the focal length that fills the pictures."""
    size = np.array(size_px) * _OVERSAMPLING
    poses = {side: _pose(np.radians(yaw)) for side, yaw in SIDES.items()}
    tangents = {side: _tangents(pose, head) for side, pose in poses.items()}
    focal = _FILLED * min((size / np.ptp(tangent, axis=0)).min() for tangent in tangents.values())
    cameras = {}
    for side, pose in poses.items():
        centre = size / 2 - focal * (tangents[side].min(0) + tangents[side].max(0)) / 2
        intrinsics = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        width, height = size.tolist()
        cameras[side] = Camera(width_px=width, height_px=height, intrinsics=intrinsics, T_cam_world=pose)
    return cameras


def _pose(yaw: float) -> Float[np.ndarray, "4 4"]:
    """T_cam_world of a camera that looks at the origin from `yaw` (radians) about +Y; 0 is +Z."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(yaw), 0, -np.sin(yaw)], [0, -1, 0], [-np.sin(yaw), 0, -np.cos(yaw)]]
    pose[2, 3] = _DISTANCE
    return pose


def _tangents(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    local = transform_points(pose, points)
    return local[:, :2] / local[:, 2:]
