"""Cameras, and the true landmarks of heads in their images. Nothing is rendered: landmarks are projected points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.landmark_fit.observations import Observations, ViewCamera
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera

SIZE_PX = 512
FOCAL_PX = 900.0
DISTANCE_M = 0.7
_VIEW_ANGLE = 0.5  # radians between neighbouring cameras
_MOST_ANGLE = 0.8  # of the outermost cameras from the middle


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinhole:
    """A camera with its principal point in the middle of the image."""

    focal_px: float
    T_cam_world: Float[np.ndarray, "4 4"]
    size_px: int = SIZE_PX

    def project(self, points: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 2"]:
        """Pixels of world points."""
        local = points @ self.T_cam_world[:3, :3].T + self.T_cam_world[:3, 3]
        return self.focal_px * local[..., :2] / local[..., 2:] + self.size_px / 2

    def calibrated(self) -> Camera:
        """The same as the type that renderers take."""
        c = self.size_px / 2
        K = np.array([[self.focal_px, 0, c], [0, self.focal_px, c], [0, 0, 1.0]])
        return Camera(width_px=self.size_px, height_px=self.size_px, intrinsics=K, T_cam_world=self.T_cam_world)

    def view(self, *, known: bool, group: int = 0) -> ViewCamera:
        """What a fit is given: everything, or the image's size alone."""
        return ViewCamera(
            width_px=self.size_px,
            height_px=self.size_px,
            focal_px=self.focal_px if known else None,
            T_cam_world=self.T_cam_world if known else None,
            group=group,
        )


def look_at(target: Float[np.ndarray, "3"], yaw: float, pitch: float, distance: float) -> Float[np.ndarray, "4 4"]:
    """T_cam_world of a camera in front (+z) of a target, turned about it; x right, y down, z forward."""
    backward = Rotation.from_euler("yx", [yaw, -pitch]).apply([0, 0, 1.0])
    z = -backward
    x = np.cross([0, -1.0, 0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ (target + distance * backward)
    return T


def cameras_around(
    target: Float[np.ndarray, "3"], count: int, focal_px: float = FOCAL_PX, distance: float = DISTANCE_M
) -> tuple[Pinhole, ...]:
    """Cameras in front of a target, spread sideways, every second one from above."""
    last = min(_MOST_ANGLE, _VIEW_ANGLE * (count - 1) / 2)
    yaws = np.linspace(-last, last, count) if count > 1 else np.zeros(1)
    pitches = [0.2 * (abs(k - (count - 1) // 2) % 2) for k in range(count)]
    return tuple(
        Pinhole(focal_px=focal_px, T_cam_world=look_at(target, yaw, pitch, distance))
        for yaw, pitch in zip(yaws, pitches, strict=True)
    )


def observe(
    scheme: LandmarkScheme,
    frames: Sequence[Float[np.ndarray, "V 3"]],
    cameras: Sequence[Pinhole],
    *,
    sigma_px: float,
    known: bool,
    noise: np.random.Generator | None = None,
) -> Observations:
    """The landmarks of posed heads in all cameras, occluded ones too.

    Args:
        scheme: of the model.
        frames: vertices, metres, world.
        cameras: that see every frame.
        sigma_px: stated standard deviation of the landmarks.
        known: whether the fit is given the cameras; otherwise they share one unknown focal length.
        noise: of one `sigma_px` along each axis; None: exact landmarks.
    """
    world = np.stack([scheme.points(vertices) for vertices in frames])
    pixels = np.stack([camera.project(world) for camera in cameras], 1)
    if noise is not None:
        pixels = pixels + sigma_px * noise.normal(size=pixels.shape)
    return Observations(
        scheme=scheme,
        views=tuple(camera.view(known=known) for camera in cameras),
        points_px=pixels,
        sigma_px=np.full(pixels.shape[:-1], sigma_px),
    )
