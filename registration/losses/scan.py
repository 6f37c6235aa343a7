"""The distance of the model's skin from a raw scan: point to plane, robust (docs/algorithms.md, "Scan term").

Planes of the scan are assigned to the skin's vertices from time to time; in between the loss is a function of the
vertices alone, with exact gradients.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.geometry.nearest_planes import NearestPlanes
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import vertex_areas, vertex_normals
from registration.types import Camera

_LEAST_COSINE = 0.7  # between the normals of a vertex and of its plane: 45 degrees
_FARTHEST = 4.0  # scales of the robust function, beyond which a plane belongs to something else


class ScanDistance:
    """The mean squared distance of some vertices from a scan, with outliers bounded; m^2."""

    def __init__(
        self,
        planes: NearestPlanes,
        rows: Int[np.ndarray, "P"],
        triangles: Int[np.ndarray, "F 3"],
        cameras: Sequence[Camera],
        shown: Sequence[Bool[np.ndarray, "H W"]],
    ):
        """Nothing is assigned yet.

        Args:
            planes: of the scan; world, metres.
            rows: the vertices that are compared, if a camera sees them.
            triangles: of the whole mesh, which hides vertices.
            cameras: those of the capture.
            shown: the pixels of each camera that show the subject's skin, as far as that is known: not hair or clothes.
        """
        self._planes, self._rows, self._triangles = planes, rows, triangles
        self._views = tuple(zip(cameras, shown, strict=True))
        self._assigned: tuple[Tensor, Tensor, Tensor] | None = None

    @property
    def share(self) -> float:
        """Of the area of the vertices' skin, the part that has planes."""
        return 0.0 if self._assigned is None else float(self._assigned[2].sum())

    def assign(self, vertices: Float[Tensor, "V 3"], scale_m: float) -> None:
        """Assign planes to the vertices that are seen as skin, near their plane, and turned like it.

        Args:
            vertices: of the whole mesh; world, metres.
            scale_m: of the robust function.
        """
        points = vertices.detach().double().cpu().numpy()
        normals = vertex_normals(torch.as_tensor(points), torch.as_tensor(self._triangles.astype(np.int64))).numpy()
        planes = self._planes.of(points[self._rows])
        cosine = (normals[self._rows] * planes.normals).sum(1)
        cosine = cosine if self._planes.oriented else np.abs(cosine)
        distance = np.linalg.norm(points[self._rows] - planes.points, axis=1)
        counts = planes.trusted & (cosine > _LEAST_COSINE) & (distance < _FARTHEST * scale_m)
        counts &= self._seen(points)
        area = vertex_areas(points, self._triangles)[self._rows]
        weight = area * counts / area.sum()
        self._assigned = tuple(  # type: ignore[assignment]
            torch.as_tensor(values, dtype=vertices.dtype, device=vertices.device)
            for values in ((planes.points * planes.normals).sum(1), planes.normals, weight)
        )

    def __call__(self, vertices: Float[Tensor, "V 3"], scale_m: float) -> Float[Tensor, ""]:
        """Return the sum of a_v s^2 x_v^2 / (s^2 + x_v^2): x_v the distance of vertex v from its plane, s the scale.

        a_v is the vertex' share of the compared skin's area; vertices without a plane add nothing.

        Args:
            vertices: of the whole mesh; world, metres.
            scale_m: of the robust function.
        """
        assert self._assigned is not None
        offset, normals, weight = self._assigned
        rows = torch.as_tensor(self._rows, device=vertices.device)
        squared = ((vertices.index_select(0, rows) * normals).sum(-1) - offset).square()
        return (weight * squared * scale_m**2 / (scale_m**2 + squared)).sum()

    def _seen(self, points: Float[np.ndarray, "V 3"]) -> np.ndarray:
        """Which of the rows at least one camera sees, at a pixel that shows skin."""
        caster, seen = RayCaster(points, self._triangles), np.zeros(len(self._rows), bool)
        for camera, shown in self._views:
            left = np.flatnonzero(~seen)
            left = left[caster.visible(points[self._rows[left]], camera)]
            column, row = np.floor(camera.project(points[self._rows[left]])[0]).astype(np.int64).T
            seen[left] = shown[row.clip(0, camera.height_px - 1), column.clip(0, camera.width_px - 1)]
        return seen
