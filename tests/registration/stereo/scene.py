"""A bumpy egg with a random texture, photographed without light: exact depths and normals in every view."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from registration.geometry.surface_views import SurfaceView, SurfaceViews
from registration.stereo.views import StereoView
from registration.types import Camera

CENTRE, RADIUS = np.array([0.02, -0.01, 0.03]), 0.12


@dataclass(frozen=True)
class Scene:
    vertices: np.ndarray
    triangles: np.ndarray
    views: tuple[StereoView, ...]
    truth: tuple[SurfaceView, ...]  # normals in the world


def camera(yaw_deg: float, pitch_deg: float = 0.0, size: int = 200, distance: float = 1.0) -> Camera:
    """A camera that looks at the egg, which fills about three quarters of its picture."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    away = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    z = -away
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (CENTRE + distance * away)
    focal = size * distance / (2.4 * RADIUS)
    intrinsics = np.array([[focal, 0, size / 2 + 3.3], [0, focal * 1.01, size / 2 - 2.1], [0, 0, 1]])
    return Camera(width_px=size, height_px=size, intrinsics=intrinsics, T_cam_world=pose)


def egg(steps: int = 160) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward triangles."""
    polar, around = np.meshgrid(np.linspace(0.02, np.pi - 0.02, steps), np.linspace(0, 2 * np.pi, 2 * steps))
    radius = 0.09 * (1 + 0.05 * np.sin(5 * around) * np.sin(polar) ** 2 + 0.04 * np.cos(6 * polar))
    points = (
        np.stack([np.sin(polar) * np.sin(around), 1.2 * np.cos(polar), np.sin(polar) * np.cos(around)], -1)
        * radius[..., None]
    )
    index = np.arange(polar.size).reshape(polar.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack([a, d, c], -1), np.stack([a, c, b], -1)]).reshape(-1, 3)
    return points.reshape(-1, 3) + CENTRE, triangles[:, ::-1]


def scene(yaws: tuple[float, ...], size: int = 200, contrast: float = 1.0) -> Scene:
    vertices, triangles = egg()
    cameras = [
        camera(yaw, pitch, size) for yaw, pitch in zip(yaws, np.resize([0.0, 6.0, -5.0], len(yaws)), strict=True)
    ]
    surface = SurfaceViews(vertices, triangles, cameras, smoothing_m=0)
    truth = tuple(surface.view(one) for one in cameras)
    noise = gaussian_filter(np.random.default_rng(3).normal(size=(120, 120, 120)), 1.0, mode="wrap")
    noise /= noise.std()
    views = []
    for one, seen in zip(cameras, truth, strict=True):
        hit = seen.face >= 0
        points = np.einsum("pk,pkc->pc", seen.barycentric[hit], vertices[triangles[seen.face[hit]]])
        image = np.full(hit.shape, 0.1, np.float32)
        texture = map_coordinates(noise, (points.T / 0.0025) % 120, order=1, mode="grid-wrap")
        image[hit] = np.clip(0.5 + contrast * 0.15 * texture, 0, 1)
        views.append(StereoView(image=image, camera=one))
    return Scene(vertices, triangles, tuple(views), truth)


def errors(depth_map, camera: Camera, seen: SurfaceView) -> tuple[float, np.ndarray, np.ndarray]:
    """Coverage of the surface that is not grazing, depth errors (mm) and normal errors (degrees) of a window."""
    shift = np.round(camera.intrinsics[:2, 2] - depth_map.camera.intrinsics[:2, 2]).astype(int)
    height, width = depth_map.depth.shape
    window = np.s_[shift[1] : shift[1] + height, shift[0] : shift[0] + width]
    shown = seen.weight[window] > 0.4
    known = shown & (depth_map.depth > 0)
    wrong = np.abs(depth_map.depth - seen.depth[window])[known] * 1e3
    normals = seen.normals[window] @ camera.T_cam_world[:3, :3].T
    cosine = (normals * depth_map.normals).sum(-1)[known]
    return known.sum() / shown.sum(), wrong, np.degrees(np.arccos(np.clip(cosine, -1, 1)))
