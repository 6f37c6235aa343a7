"""The pixels of one step on the device: cameras, rays and projections in Dr.Jit."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from registration.types import Pixels

_STRIDE = 16  # floats of a camera: R (9, row by row), centre (3), fx, fy, cx, cy


@dataclass(frozen=True, kw_only=True)
class PixelList:
    """`types.Pixels` on the device."""

    cameras: mi.Float  # _STRIDE floats a camera
    camera_count: int
    view: mi.UInt32  # P
    x: mi.UInt32  # P
    y: mi.UInt32  # P
    index: mi.Int32  # (N H W) flat: place in the list, or -1
    height_px: int
    width_px: int

    @property
    def count(self) -> int:
        return dr.width(self.view)

    def camera(self, view: mi.UInt32) -> CameraLanes:
        return CameraLanes(dr.gather(mi.ArrayXf, self.cameras, view, shape=(_STRIDE, dr.width(view))))

    def centre(self, view: mi.UInt32) -> mi.Point3f:
        return mi.Point3f(*(dr.gather(mi.Float, self.cameras, view * _STRIDE + 9 + k) for k in range(3)))

    def rays(self, offset: tuple[float, float], which: mi.UInt32 | None = None) -> tuple[mi.Point3f, mi.Vector3f]:
        """Rays through all or some pixels, at an offset from the pixel's corner; see `CameraLanes.direction`."""
        view, x, y = self.view, self.x, self.y
        if which is not None:
            view, x, y = (dr.gather(mi.UInt32, values, which) for values in (view, x, y))
        camera = self.camera(view)
        dx, dy = (dr.opaque(mi.Float, value) for value in offset)
        return camera.centre, camera.direction(mi.Float(x) + dx, mi.Float(y) + dy)

    def at(self, view: mi.UInt32, position: mi.Point2f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The listed pixel that holds an image position, and whether there is one."""
        height, width = dr.opaque(mi.UInt32, self.height_px), dr.opaque(mi.UInt32, self.width_px)
        active = active & (position.x >= 0) & (position.y >= 0)
        active &= (position.x < mi.Float(width)) & (position.y < mi.Float(height))
        row, column = (mi.UInt32(dr.select(active, p, 0)) for p in (position.y, position.x))
        place = dr.gather(mi.Int32, self.index, (view * height + row) * width + column, active)
        active &= place >= 0
        return mi.UInt32(dr.select(active, place, 0)), active


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


def upload(pixels: Pixels) -> PixelList:
    """The pixels of one step on the device. Their cameras must have one image size and no distortion."""
    cameras = pixels.cameras
    sizes = {(camera.height_px, camera.width_px) for camera in cameras}
    if len(sizes) != 1 or any(camera.distortion for camera in cameras):
        raise ValueError("pixels need cameras of one size without distortion")
    packed = np.empty((len(cameras), _STRIDE), np.float32)
    for row, camera in zip(packed, cameras, strict=True):
        k = camera.intrinsics
        row[:9] = camera.T_cam_world[:3, :3].ravel()
        row[9:12] = camera.centre
        row[12:] = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    height, width = sizes.pop()
    view, x, y = (mi.UInt32(mi.Int32(values)) for values in (pixels.view, pixels.x, pixels.y))
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
