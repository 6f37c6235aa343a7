"""Images of the shaded mesh from three sides: distances as colours, its texture, plain."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from registration.frames import linear_to_srgb, transform_points
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import vertex_normals
from registration.report.inputs import HeatMap
from registration.report.pictures import BACKGROUND, RgbImage, scale_colours
from registration.types import Camera

SIDES = {"subject's right": -70.0, "front": 0.0, "subject's left": 70.0}  # yaw of the camera, degrees
LIMITS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # the colour scale ends at one of these
UNMEASURED = (186, 187, 190)  # sRGB
PLAIN = (222, 216, 208)  # sRGB
SIZE = (480, 520)  # width, height px of an image
_OVERSAMPLING = 2
_FILL_FRACTION = 0.94  # of the image's width or height, by the head
_DISTANCE = 2.0  # m, camera to head: the perspective of a portrait lens


def scale_limit_mm(distance_mm: Float[np.ndarray, "V"]) -> float:
    """Return the end of the colour scale: the first of `LIMITS_MM` at or above the 95th percentile, or the last.

    Args:
        distance_mm: values that are not finite are ignored.

    Returns:
        Millimetres.
    """
    measured = distance_mm[np.isfinite(distance_mm)]
    percentile = np.percentile(measured, 95) if len(measured) else 0.0
    return next((limit for limit in LIMITS_MM if limit >= percentile), LIMITS_MM[-1])


@dataclass(frozen=True, kw_only=True)
class Fragments:
    """The points of a mesh that an image shows, one per pixel that it covers."""

    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]


Paint = Callable[[Fragments], Float[np.ndarray, "P 3"]]  # sRGB in [0, 255] of each fragment


def distance_paint(heat: HeatMap, limit_mm: float) -> Paint:
    """Return the colours of distances up to `limit_mm`; grey where nothing was measured."""

    def paint(fragments: Fragments) -> Float[np.ndarray, "P 3"]:
        corners = heat.distance_mm[heat.triangles[fragments.face]]
        distance = (fragments.barycentric * corners).sum(1)  # NaN if any corner is
        return np.where(np.isfinite(distance)[:, None], scale_colours(distance / limit_mm), UNMEASURED)

    return paint


def texture_paint(corner_uvs: Float[np.ndarray, "F 3 2"], texture: Float[np.ndarray, "R R 3"]) -> Paint:
    """Return the colours of a texture (linear; row 0 at v = 1), the nearest texel's."""

    def paint(fragments: Fragments) -> Float[np.ndarray, "P 3"]:
        u, v = np.einsum("pk,pkc->cp", fragments.barycentric, corner_uvs[fragments.face])
        size = len(texture)
        row, column = (np.clip(axis * size, 0, size - 1).astype(np.int64) for axis in (1 - v, u))
        return 255 * linear_to_srgb(texture[row, column].astype(np.float64))

    return paint


def plain_paint(fragments: Fragments) -> Float[np.ndarray, "P 3"]:
    """Return one light grey for all."""
    return np.tile(np.array(PLAIN, float), (len(fragments.face), 1))


def render_heat_map(
    heat: HeatMap, limit_mm: float, *, sides: Sequence[str] = tuple(SIDES), size: tuple[int, int] = SIZE
) -> list[tuple[str, RgbImage]]:
    """Render a heat map from several sides of the head.

    Args:
        heat: the mesh and its distances.
        limit_mm: distance at the end of the colour scale.
        sides: keys of `SIDES`.
        size: width and height of an image, px.

    Returns:
        Side and image, in the order of `sides`.
    """
    return render_painted(heat, {"": distance_paint(heat, limit_mm)}, sides=sides, size=size)[""]


def render_painted(
    mesh: HeatMap, paints: Mapping[str, Paint], *, sides: Sequence[str] = tuple(SIDES), size: tuple[int, int] = SIZE
) -> dict[str, list[tuple[str, RgbImage]]]:
    """Render a mesh in several colourings from several sides of the head.

    Args:
        mesh: the mesh.
        paints: name -> colouring.
        sides: keys of `SIDES`.
        size: width and height of an image, px.

    Returns:
        Name of the paint -> side and image, in the order of `sides`.
    """
    head = upright(mesh)
    cameras = _cameras(head, size)
    normals = vertex_normals(torch.from_numpy(head), torch.from_numpy(mesh.triangles.astype(np.int64))).numpy()
    caster = RayCaster(head, mesh.triangles)
    images: dict[str, list[tuple[str, RgbImage]]] = {name: [] for name in paints}
    for side in sides:
        camera = cameras[side]
        face, barycentric = caster.rasterize(camera)
        covered = face >= 0
        fragments = Fragments(face=face[covered], barycentric=barycentric[covered])
        normal = np.einsum("pk,pkc->pc", fragments.barycentric, normals[mesh.triangles[fragments.face]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        shading = _shading(normal @ camera.T_cam_world[:3, :3].T)[:, None]
        for name, paint in paints.items():
            image = np.empty((*face.shape, 3), np.float32)
            image[:] = BACKGROUND
            image[covered] = paint(fragments) * shading
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            images[name].append((side, np.clip(small + 0.5, 0, 255).astype(np.uint8)))
    return images


def upright(mesh: HeatMap) -> Float[np.ndarray, "V 3"]:
    """Return the vertices with the head upright (+Y up, +Z out of the face) and centred, metres."""
    head = transform_points(mesh.T_head_world, mesh.vertices.astype(np.float64))
    centred: Float[np.ndarray, "V 3"] = head - (head.min(0) + head.max(0)) / 2
    return centred


def _shading(normal: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
    """Return the brightness of each normal (camera frame): a light from the upper left, a weak one from the right.

    At least 0.5, so that the hue stays visible.
    """
    key = np.array([-0.45, -0.65, -0.61])
    fill = np.array([0.8, -0.1, -0.59])
    return 0.50 + 0.42 * np.clip(normal @ key, 0, 1) + 0.16 * np.clip(normal @ fill, 0, 1)


def _cameras(head: Float[np.ndarray, "V 3"], size_px: tuple[int, int]) -> dict[str, Camera]:
    """Return one camera per side that looks at the origin; all have the focal length at which the head fits."""
    size = np.array(size_px) * _OVERSAMPLING
    poses = {side: _pose(np.radians(yaw)) for side, yaw in SIDES.items()}
    tangents = {side: _tangents(pose, head) for side, pose in poses.items()}
    focal = _FILL_FRACTION * min((size / np.ptp(tangent, axis=0)).min() for tangent in tangents.values())
    cameras = {}
    for side, pose in poses.items():
        centre = size / 2 - focal * (tangents[side].min(0) + tangents[side].max(0)) / 2
        intrinsics = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        width, height = size.tolist()
        cameras[side] = Camera(width_px=width, height_px=height, intrinsics=intrinsics, T_cam_world=pose)
    return cameras


def _pose(yaw: float) -> Float[np.ndarray, "4 4"]:
    """Return T_cam_world of a camera that looks at the origin from `yaw` (radians) about +Y; 0 is +Z."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(yaw), 0, -np.sin(yaw)], [0, -1, 0], [-np.sin(yaw), 0, -np.cos(yaw)]]
    pose[2, 3] = _DISTANCE
    return pose


def _tangents(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """Return normalized image coordinates x / z, y / z."""
    local = transform_points(pose, points)
    return local[:, :2] / local[:, 2:]
