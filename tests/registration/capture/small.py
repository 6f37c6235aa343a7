"""A small synthetic capture with complete ground truth: a coloured ball of 9 cm with the 68 landmarks on it.

Rays are traced through OpenCV's `undistortPoints`, pixel by pixel, so the images do not depend on the image
warp under test.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.capture.scan import Scan
from registration.types import Camera

RADIUS_M = 0.09
CLASSES = ("background", "skin", "neck_other")
DISTORTIONS = {
    "SIMPLE_RADIAL": (0.9, 0.0, 0.0, 0.0),
    "RADIAL": (-1.5, 4.0, 0.0, 0.0),
    "OPENCV": (-1.2, 3.0, 0.02, -0.015),
    "FULL_OPENCV": (-1.0, 3.0, 0.02, -0.015, 2.0, 0.1, 0.3, -0.5),
}


def camera(
    yaw_rad: float = 0.0, *, distortion: tuple[float, ...] = (), width_px: int = 120, height_px: int = 160
) -> Camera:
    """A camera at 45 cm from the head, rotated by `yaw_rad` from the front towards the subject's left."""
    z = -np.array([np.sin(yaw_rad), 0.15, np.cos(yaw_rad)])
    z /= np.linalg.norm(z)
    x = np.cross([0, -1.0, 0], z)
    x /= np.linalg.norm(x)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = [x, np.cross(z, x), z]
    T_cam_world[2, 3] = 0.45
    focal = 2.0 * width_px
    intrinsics = np.array(
        [[focal, 0, 0.52 * width_px], [0, 1.01 * focal, 0.47 * height_px], [0, 0, 1]], dtype=np.float64
    )
    return Camera(
        width_px=width_px, height_px=height_px, intrinsics=intrinsics, T_cam_world=T_cam_world, distortion=distortion
    )


def landmarks_68() -> Float[np.ndarray, "68 3"]:
    """Points on the ball in the 68 scheme's layout: a jaw in order, outer eye corners 9 cm apart."""
    rng = np.random.default_rng(68)
    xy = rng.uniform(-0.03, 0.03, (68, 2))
    angles = np.linspace(np.pi, 2 * np.pi, 17)
    xy[:17] = np.stack([0.07 * np.cos(angles), 0.07 * np.sin(angles)], -1)
    xy[27], xy[33], xy[36], xy[45] = (0, 0.03), (0, -0.01), (-0.045, 0.03), (0.045, 0.03)
    return np.column_stack([xy, np.sqrt(RADIUS_M**2 - (xy**2).sum(-1))])


def distorted(cam: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """Project with distortion, by OpenCV."""
    rotation = cv2.Rodrigues(cam.T_cam_world[:3, :3])[0]
    coefficients = np.array(cam.distortion) if cam.distortion else None
    return cv2.projectPoints(points, rotation, cam.T_cam_world[:3, 3], cam.intrinsics, coefficients)[0][:, 0]


def undistorted(cam: Camera, pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """Pixels on the plane z = 1 of the camera, by OpenCV."""
    coefficients = np.array(cam.distortion) if cam.distortion else None
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    return cv2.undistortPoints(pixels[:, None], cam.intrinsics, coefficients, criteria=criteria)[:, 0]


@dataclass(frozen=True, kw_only=True)
class Lens:
    """How a view's pixels are traced and its landmarks are projected."""

    plane: Callable[[Camera, Float[np.ndarray, "P 2"]], Float[np.ndarray, "P 2"]] = undistorted
    project: Callable[[Camera, Float[np.ndarray, "P 3"]], Float[np.ndarray, "P 2"]] = distorted


def synthetic_view(name: str, cam: Camera, lens: Lens = Lens()) -> ViewArrays:  # noqa: B008  frozen
    """A camera's view of the ball, with distortion; landmarks on the far side have confidence 0.2."""
    y, x = np.mgrid[: cam.height_px, : cam.width_px] + 0.5
    plane = lens.plane(cam, np.stack([x, y], -1).reshape(-1, 2))
    rays = np.column_stack([plane, np.ones(len(plane))])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = cam.T_cam_world[:3, 3]  # of the ball, camera frame
    along = rays @ centre
    inside = along**2 - centre @ centre + RADIUS_M**2
    hit = inside > 0
    local = (along - np.sqrt(np.maximum(inside, 0)))[:, None] * rays - centre
    normals = np.where(hit[:, None], local / RADIUS_M, 0)
    world = normals @ cam.T_cam_world[:3, :3]
    rgb = np.where(hit[:, None], 0.3 + 0.1 * np.sin(6 * world + [0, 1, 2]), 0.1)
    shape = (cam.height_px, cam.width_px)
    points = landmarks_68()
    facing = ((cam.centre - points) * points).sum(-1) > 0
    landmarks = np.column_stack([lens.project(cam, points), np.where(facing, 1.0, 0.2)])
    return ViewArrays(
        name=name,
        camera=cam,
        rgb=rgb.reshape(*shape, 3),
        mask=hit.reshape(shape),
        normals=normals.reshape(*shape, 3),
        labels=np.where(hit, 1 + (world[:, 0] > 0), 0).astype(np.uint8).reshape(shape),
        landmarks={"68": landmarks},
    )


def ball(scale: float = 1.0) -> Scan:
    """The ball as a scan."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=5, radius=scale * RADIUS_M)
    return Scan(vertices=np.array(mesh.vertices), triangles=np.array(mesh.faces, np.int64))


def data_lines(path: Path) -> list[str]:
    """The lines of a file of a COLMAP text model, without comments."""
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


YAWS_RAD = (-1.0, -0.4, 0.1, 0.5, 1.1)


def make(root: Path, *, distortion: tuple[float, ...] = (), drop: tuple[str, ...] = (), bits: int = 8) -> Path:
    """Write a capture of five views, cam0 to cam4; `drop` names optional parts of the views to leave out."""
    views = [synthetic_view(f"cam{i}", camera(yaw_rad, distortion=distortion)) for i, yaw_rad in enumerate(YAWS_RAD)]
    views = [replace(view, **{part: {} if part == "landmarks" else None for part in drop}) for view in views]
    return write_capture(
        root,
        views,
        CaptureDescription(
            subject="ball",
            expression="neutral",
            classes=CLASSES,
            tags={"age": 30, "notes": 'with "quotes"', "lists": [1.5, 2.5], "real": False},
        ),
        points=landmarks_68(),
        scan=ball(),
        truth=landmarks_68(),
        bits=bits,
    )
