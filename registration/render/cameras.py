"""Pixels, cameras, rays and projections on the device (Dr.Jit)."""

from __future__ import annotations  # mi.Float exists only after a variant is set

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from registration.types import Pixels

_ROWS = 4  # of four floats per camera; see `CameraLanes`


@dataclass(frozen=True, kw_only=True)
class PixelList:
    """`types.Pixels` on the device: N cameras with images of H x W pixels, P listed pixels."""

    cameras: mi.Float  # (N, 4, 4)
    camera_count: int
    view: mi.UInt32  # P
    x: mi.UInt32  # P
    y: mi.UInt32  # P
    index: mi.Int32  # (N H W) flat: index in the list, or -1
    height_px: int
    width_px: int

    @property
    def count(self) -> int:
        """P."""
        return dr.width(self.view)

    def camera(self, view: mi.UInt32) -> CameraLanes:
        """Return the cameras of the lanes' views."""
        return CameraLanes([dr.gather(mi.Vector4f, self.cameras, _ROWS * view + k) for k in range(_ROWS)])

    def centre(self, view: mi.UInt32) -> mi.Point3f:
        """Return the centres (world, metres) of the lanes' cameras."""
        row = dr.gather(mi.Vector4f, self.cameras, _ROWS * view + 3)
        return mi.Point3f(row.x, row.y, row.z)

    def rays(self, offset: tuple[float, float], which: mi.UInt32 | None = None) -> tuple[mi.Point3f, mi.Vector3f]:
        """Return origins and directions of rays through pixels; see `CameraLanes.direction`.

        Args:
            offset: position in each pixel, from its corner (px).
            which: indices of the pixels; all if None.
        """
        view, x, y = self.view, self.x, self.y
        if which is not None:
            view, x, y = (dr.gather(mi.UInt32, values, which) for values in (view, x, y))
        camera = self.camera(view)
        dx, dy = (dr.opaque(mi.Float, value) for value in offset)
        return camera.centre, camera.direction(mi.Float(x) + dx, mi.Float(y) + dy)

    def lookup(self, view: mi.UInt32, position: mi.Point2f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Return the listed pixels that contain image positions (px), and whether there are any."""
        height, width = dr.opaque(mi.UInt32, self.height_px), dr.opaque(mi.UInt32, self.width_px)
        active = active & (position.x >= 0) & (position.y >= 0)
        active &= (position.x < mi.Float(width)) & (position.y < mi.Float(height))
        row, column = (mi.UInt32(dr.select(active, p, 0)) for p in (position.y, position.x))
        index = dr.gather(mi.Int32, self.index, (view * height + row) * width + column, active)
        active &= index >= 0
        return mi.UInt32(dr.select(active, index, 0)), active


class CameraLanes:
    """One camera per lane of a wavefront, from the rows (x axis, cx), (y axis, cy), (z axis, fx), (centre, fy).

    The axes are the camera's in the world; centre in metres; fx, fy, cx, cy in pixels.
    """

    def __init__(self, rows: list[mi.Vector4f]):
        self.axes = [mi.Vector3f(row.x, row.y, row.z) for row in rows[:3]]
        self.centre = mi.Point3f(rows[3].x, rows[3].y, rows[3].z)
        self.cx, self.cy, self.fx, self.fy = (row.w for row in rows)

    def direction(self, x_px: mi.Float, y_px: mi.Float) -> mi.Vector3f:
        """Return the world direction through a pixel position, scaled so that t along it is camera depth (m)."""
        x, y = (x_px - self.cx) / self.fx, (y_px - self.cy) / self.fy
        return dr.fma(self.axes[0], x, dr.fma(self.axes[1], y, self.axes[2]))

    def project(self, point: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
        """Project a world point to a pixel position and its depth (m)."""
        x, y, z = (dr.dot(axis, point - self.centre) for axis in self.axes)
        return mi.Point2f(self.fx * x / z + self.cx, self.fy * y / z + self.cy), z

    def projection_gradient(self, point: mi.Point3f, normal: mi.Vector2f) -> mi.Vector3f:
        """Return the gradient of <normal, projection of the point> in the point, pixels per metre."""
        x, y, z = (dr.dot(axis, point - self.centre) for axis in self.axes)
        along_x, along_y = self.fx * normal.x / z, self.fy * normal.y / z
        return along_x * self.axes[0] + along_y * self.axes[1] - (along_x * x + along_y * y) / z * self.axes[2]


def upload(pixels: Pixels) -> PixelList:
    """Copy pixels to the device.

    Raises:
        ValueError: the cameras' image sizes differ, or one has distortion.
    """
    cameras = pixels.cameras
    sizes = {(camera.height_px, camera.width_px) for camera in cameras}
    if len(sizes) != 1 or any(camera.distortion for camera in cameras):
        raise ValueError("the cameras must have one image size and no distortion")
    packed = np.empty((len(cameras), _ROWS, 4), np.float32)
    for rows, camera in zip(packed, cameras, strict=True):
        k = camera.intrinsics
        rows[:3, :3], rows[3, :3] = camera.T_cam_world[:3, :3], camera.centre
        rows[:, 3] = k[0, 2], k[1, 2], k[0, 0], k[1, 1]
    height, width = sizes.pop()
    view, x, y = (mi.UInt32(values.view(torch.uint32)) for values in (pixels.view, pixels.x, pixels.y))
    return PixelList(
        cameras=mi.Float(packed.ravel()),
        camera_count=len(cameras),
        view=view,
        x=x,
        y=y,
        index=mi.Int32(pixels.index.reshape(-1)),
        height_px=height,
        width_px=width,
    )
