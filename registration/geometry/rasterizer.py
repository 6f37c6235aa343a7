"""Triangle meshes as pinhole cameras see them: the face at each pixel, and which points are visible.

For metrics and pictures, where no gradients are needed. Rays are cast by Embree (through Adobe Lagrange) in float32,
with coordinates relative to the mesh's centre; barycentrics are computed in float64. A ray that passes a silhouette
within 1e-7 of its length may hit or miss; these are some in a million. Lens distortion is ignored.
"""

from collections.abc import Sequence

import lagrange
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from registration.geometry.closest_point import surface_mesh
from registration.types import Camera

NEAR = 0.01  # metres; surfaces closer to the camera are not hit
_BATCH = 1 << 19  # rays cast together: about 100 MB of temporaries


class RayCaster:
    """A mesh prepared for queries from several cameras; world frame, metres."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        """Build the tree. There may be no triangles; the corners must be finite."""
        vertices, triangles = np.asarray(vertices, np.float64), np.asarray(triangles)
        self._corners = vertices[triangles]
        self._centre = self._corners.mean((0, 1)) if len(triangles) else np.zeros(3)
        self._caster = _committed(vertices - self._centre, triangles) if len(triangles) else None

    def visible(
        self, points: Float[np.ndarray, "P 3"], camera: Camera, tolerance: float = 5e-4
    ) -> Bool[np.ndarray, "P"]:
        """Test which points a camera sees.

        Args:
            points: in the mesh's frame; those on the mesh itself need the tolerance.
            camera: a pinhole; its distortion is ignored.
            tolerance: depth in metres by which the mesh may be in front of a visible point.

        Returns:
            Whether the point projects into the image and nothing is in front of it.
        """
        points = np.asarray(points, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):  # points in the plane of the camera's centre
            xy, depth = camera.project(points)
            seen = (depth > NEAR) & (xy >= 0).all(1) & (xy <= (camera.width_px, camera.height_px)).all(1)
        rows = np.flatnonzero(seen)
        if self._caster is None or not len(rows):
            return seen
        # The ray's parameter is 0 at the camera and 1 at the point, so depth over the point's depth.
        rays = self._origins(camera, len(rows)), (points[rows] - camera.centre).astype(np.float32)
        near, far = NEAR / depth[rows], 1 - tolerance / depth[rows]
        seen[rows] = ~self._caster.occluded(*rays, near.astype(np.float32), far.astype(np.float32))
        return seen

    def visible_to_any(self, points: Float[np.ndarray, "P 3"], cameras: Sequence[Camera]) -> Bool[np.ndarray, "P"]:
        """Test which points at least one camera sees, as `visible`."""
        seen = np.zeros(len(points), bool)
        for camera in cameras:
            seen |= self.visible(points, camera)
        return seen

    def rasterize(self, camera: Camera) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
        """Find what a camera sees at the centre of each pixel.

        Args:
            camera: a pinhole; its distortion is ignored.

        Returns:
            The front-most face, -1 where there is none, and the barycentrics of its surface point (float64, perspective
            correct, 0 where there is no face). Faces are visible from both sides.
        """
        width, height = camera.width_px, camera.height_px
        face = np.full((height, width), -1)
        barycentric = np.zeros((height, width, 3))
        lines = max(1, _BATCH // width)
        for top in range(0, height if self._caster is not None else 0, lines):
            ray = _rays(camera, top, min(top + lines, height))
            hits = self._cast(camera, ray.reshape(-1, 3))
            line, column = np.divmod(np.flatnonzero(hits.hit), width)
            hit_face = hits.facet_index[hits.hit]
            face[top + line, column] = hit_face
            corners = self._corners[hit_face] - camera.centre
            barycentric[top + line, column] = _on_ray(ray[line, column], corners)
        return face, barycentric

    def blocked(
        self, points: Float[np.ndarray, "P 3"], directions: Float[np.ndarray, "P 3"], near: float, far: float
    ) -> Bool[np.ndarray, "P"]:
        """Test which rays hit the mesh between two distances, metres; directions are unit vectors."""
        if self._caster is None or not len(points):
            return np.zeros(len(points), bool)
        origins = (np.asarray(points, np.float64) - self._centre).astype(np.float32)
        limits = (np.full(len(points), limit, np.float32) for limit in (near, far))
        return np.asarray(self._caster.occluded(origins, directions.astype(np.float32), *limits))

    def _cast(self, camera: Camera, ray: Float[np.ndarray, "N 3"]) -> lagrange.raycasting.RayHits:
        assert self._caster is not None
        hits = self._caster.cast(self._origins(camera, len(ray)), ray.astype(np.float32), NEAR, np.inf)
        assert isinstance(hits, lagrange.raycasting.RayHits)  # of one ray alone it is another type
        return hits

    def _origins(self, camera: Camera, count: int) -> Float[np.ndarray, "N 3"]:
        return np.tile((camera.centre - self._centre).astype(np.float32), (count, 1))


def visible(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    camera: Camera,
    tolerance: float = 5e-4,
) -> Bool[np.ndarray, "P"]:
    """Test the points of one camera, as `RayCaster.visible`, which serves several cameras of one mesh."""
    return RayCaster(vertices, triangles).visible(points, camera, tolerance)


def rasterize(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], camera: Camera
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """Rasterize for one camera, as `RayCaster.rasterize`, which serves several cameras of one mesh."""
    return RayCaster(vertices, triangles).rasterize(camera)


def _committed(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> lagrange.raycasting.RayCaster:
    caster = lagrange.raycasting.RayCaster()
    # Its constructor makes the thread flush subnormal numbers to zero, which would change later computations.
    torch.set_flush_denormal(False)
    caster.add_mesh(surface_mesh(vertices, triangles))
    caster.commit_updates()
    return caster


def _rays(camera: Camera, top: int, bottom: int) -> Float[np.ndarray, "L W 3"]:
    """World directions, of depth 1, through the pixel centres of some lines of the image."""
    direction = camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics)
    across = (np.arange(camera.width_px) + 0.5)[:, None] * direction[:, 0]
    down = (np.arange(top, bottom) + 0.5)[:, None] * direction[:, 1] + direction[:, 2]
    return down[:, None] + across


def _on_ray(ray: Float[np.ndarray, "N 3"], corners: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Barycentrics of the point in which a ray from the origin meets a triangle, or of the closest one to it."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    weight = np.stack([np.einsum("nc,nc->n", ray, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], 1)
    total = weight.sum(1, keepdims=True)
    weight = np.divide(weight, total, out=np.full_like(weight, 1 / 3), where=total != 0).clip(0)
    return weight / weight.sum(1, keepdims=True)
