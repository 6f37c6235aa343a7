"""Contacts of a mesh with itself: which triangle a vertex faces, and how deep it lies behind one."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.topology import edges, vertex_normals

_OPPOSING = -0.2  # cosine between the normals of vertex and triangle
_LOOKED_AT = 8  # triangles around a vertex
_ALIGNED = 0.7  # cosine between the way to the closest point and the triangle's normal: not past the surface's border


def plane_depths(
    vertices: Float[Tensor, "V 3"], points: Int[Tensor, "M"], triangles: Int[Tensor, "M 3"]
) -> Float[Tensor, "M"]:
    """How far each vertex `points` lies behind the plane of its triangle, in the vertices' unit; negative in front.

    Differentiable in all four vertices. Where the foot lies within the triangle this is how the distance to the surface
    changes: the corners share the gradient by the foot's barycentrics.
    """
    # Not vertices[...]: the adjoint of that sums in parallel, differently from run to run.
    p, a, b, c = (vertices.index_select(0, index) for index in (points, *triangles.unbind(1)))
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return (normal * (a - p)).sum(-1)


class Facing:
    """Vertices of one surface against triangles of another that hangs together with it."""

    def __init__(
        self,
        points: Int[np.ndarray, "P"],
        triangles: Int[np.ndarray, "F 3"],
        mesh: Int[np.ndarray, "G 3"],
        rest: Float[np.ndarray, "V 3"],
        *,
        reach: float,
        apart: float,
    ):
        """`mesh`: the triangles that both belong to, for normals and for ways along the surface.

        Only triangles closer than `reach`, and at `rest` more than `apart` away along the edges, are considered.
        """
        self.points, self.triangles, self._reach = points, triangles, reach
        self._around = mesh[np.isin(mesh, points).any(1)]
        self._near = _within(mesh, rest, points, triangles, apart)

    def find(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M"]]:
        """Places in `points` and, for each, in `triangles`: the closest one, if the vertex faces it or has crossed it.

        That is so if their normals oppose one another and the closest point is not on the surface's border.
        """
        rows = self._hopeful(vertices)
        if not len(rows):
            return rows, rows
        own = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(self._around)).numpy()[self.points[rows]]
        p = vertices[self.points[rows]]
        distance, face, barycentric = closest_points(p, vertices, self.triangles)
        ahead = p - barycentric_points(vertices, self.triangles, face, barycentric)
        a, b, c = vertices[self.triangles[face]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        keep = (distance < self._reach) & ~self._near[rows, face]
        keep &= (normal * own).sum(1) < _OPPOSING
        keep &= np.abs((ahead * normal).sum(1)) >= _ALIGNED * distance
        return rows[keep], face[keep]

    def _hopeful(self, vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "M"]:
        """Places of the points that may have a triangle in reach that is far enough along the surface."""
        if not len(self.points) or not len(self.triangles):
            return np.empty(0, np.int64)
        corners = vertices[self.triangles]
        centres = corners.mean(1)
        radius = np.linalg.norm(corners - centres[:, None], axis=-1).max()
        count = min(_LOOKED_AT, len(centres))
        away, index = cKDTree(centres).query(
            vertices[self.points], k=range(1, count + 1), distance_upper_bound=self._reach + radius
        )
        missing = ~np.isfinite(away)
        near = np.take_along_axis(self._near, np.where(missing, 0, index), 1)
        # If all that were looked at are too near along the surface, further ones are no contact to speak of.
        return np.flatnonzero((~missing & ~near).any(1))


def _within(
    mesh: Int[np.ndarray, "G 3"],
    rest: Float[np.ndarray, "V 3"],
    points: Int[np.ndarray, "P"],
    triangles: Int[np.ndarray, "F 3"],
    apart: float,
) -> Bool[np.ndarray, "P F"]:
    """Whether a way along edges from a point to a corner of a triangle is at most `apart` long."""
    pairs = edges(mesh).vertices
    # A way that short stays within `apart` of where it starts: the rest of the mesh need not be looked at.
    close = np.isfinite(cKDTree(rest[points]).query(rest, distance_upper_bound=apart)[0])
    local = np.where(close, close.cumsum() - 1, -1)
    pairs = local[pairs[close[pairs].all(1)]]
    at = rest[close]
    length = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
    graph = coo_matrix((length, (pairs[:, 0], pairs[:, 1])), (len(at), len(at)))
    ways = dijkstra(graph.tocsr(), directed=False, indices=local[points], limit=apart)
    ways = np.concatenate([np.isfinite(ways), np.zeros((len(points), 1), bool)], 1)  # last: all that is not close
    return ways[:, local[triangles]].any(-1)
