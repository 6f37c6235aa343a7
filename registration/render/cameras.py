"""The cameras of one step on the device, and their rays and projections in Dr.Jit."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from registration.types import Camera

_STRIDE = 16  # floats of a camera: R (9, row by row), centre (3), fx, fy, cx, cy


@dataclass(frozen=True, kw_only=True)
class CameraBatch:
    """Cameras without distortion whose images have one common size."""

    packed: mi.Float  # 16 floats a camera
    count: int
    height_px: int
    width_px: int

    def gather(self, view: mi.UInt32) -> CameraLanes:
        return CameraLanes(dr.gather(mi.ArrayXf, self.packed, view, shape=(_STRIDE, dr.width(view))))

    def centre(self, view: mi.UInt32) -> mi.Point3f:
        return mi.Point3f(*(dr.gather(mi.Float, self.packed, view * _STRIDE + 9 + k) for k in range(3)))


class CameraLanes:
    """One camera per lane of a wavefront."""

    def __init__(self, values: mi.ArrayXf):
        self.rotation = [values[k] for k in range(9)]
        self.centre = mi.Point3f(values[9], values[10], values[11])
        self.fx, self.fy, self.cx, self.cy = (values[k] for k in range(12, 16))

    def direction(self, x_px: mi.Float, y_px: mi.Float) -> mi.Vector3f:
        """World direction through a pixel position, scaled so that t along it is camera depth (m)."""
        r = self.rotation
        x, y = (x_px - self.cx) / self.fx, (y_px - self.cy) / self.fy
        return mi.Vector3f(*(dr.fma(r[k], x, dr.fma(r[3 + k], y, r[6 + k])) for k in range(3)))

    def project(self, point: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
        """World point to pixel position and depth (m)."""
        r, q = self.rotation, point - self.centre
        x, y, z = (r[3 * k] * q.x + r[3 * k + 1] * q.y + r[3 * k + 2] * q.z for k in range(3))
        return mi.Point2f(self.fx * x / z + self.cx, self.fy * y / z + self.cy), z


def pack(cameras: Sequence[Camera]) -> CameraBatch:
    """Upload the cameras of one step. All must have one image size and no distortion."""
    sizes = {(camera.height_px, camera.width_px) for camera in cameras}
    if len(sizes) != 1 or any(camera.distortion for camera in cameras):
        raise ValueError("a batch needs cameras of one size without distortion")
    packed = np.empty((len(cameras), _STRIDE), np.float32)
    for row, camera in zip(packed, cameras, strict=True):
        k = camera.intrinsics
        row[:9] = camera.T_cam_world[:3, :3].ravel()
        row[9:12] = camera.centre
        row[12:] = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    height, width = sizes.pop()
    return CameraBatch(packed=mi.Float(packed.ravel()), count=len(cameras), height_px=height, width_px=width)
