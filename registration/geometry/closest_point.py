"""Closest points on a triangle mesh, in float64.

An AABB tree (Adobe Lagrange) selects the face; distance and barycentrics are computed here, for one triangle per point
[Ericson 2005, section 5.1.5].
"""

import lagrange
import numpy as np
from jaxtyping import Float, Int


class ClosestPointQuery:
    """A mesh prepared for repeated closest-point queries; F triangles."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        """Build the tree.

        Args:
            vertices: in any unit and frame; those that no triangle uses are ignored.
            triangles: vertex indices. Degenerate triangles count as the segment or point that they are.

        Raises:
            ValueError: there are no triangles, or a corner is not finite.
        """
        if not len(triangles):
            raise ValueError("a mesh without triangles has no closest point")
        self._vertices, self._triangles = np.asarray(vertices, np.float64), triangles
        _require_finite(self._vertices[triangles])
        self._tree = lagrange.bvh.TriangleAABBTree3D(surface_mesh(vertices, triangles))

    def closest(
        self, points: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
        """Find the closest surface point of each point.

        Args:
            points: in the mesh's unit and frame.

        Returns:
            Unsigned distance, face and barycentrics. Of faces at exactly equal distance any may be returned.

        Raises:
            ValueError: a coordinate is not finite.
        """
        points = np.ascontiguousarray(points, np.float64)
        _require_finite(points)
        closest = self._tree.get_closest_point
        face = np.fromiter((closest(point)[0] for point in points), np.int64, len(points))
        distance, barycentric = on_triangles(points, self._vertices[self._triangles[face]])
        return distance, face, barycentric

    def distance(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Find the unsigned distance of each point alone, in half the time of `closest`; errors as there."""
        points = np.ascontiguousarray(points, np.float64)
        _require_finite(points)
        closest = self._tree.get_closest_point
        return np.sqrt(np.fromiter((closest(point)[2] for point in points), np.float64, len(points)))


def closest_points(
    points: Float[np.ndarray, "P 3"], vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
    """Query a mesh once: arguments, result and errors as `ClosestPointQuery` and its method `closest`."""
    return ClosestPointQuery(vertices, triangles).closest(points)


def surface_mesh(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> lagrange.SurfaceMesh:
    """Copy a triangle mesh (any unit and frame) into the type that Lagrange's queries take."""
    mesh = lagrange.SurfaceMesh()
    mesh.add_vertices(np.ascontiguousarray(vertices, np.float64))
    mesh.add_triangles(np.ascontiguousarray(triangles, np.uint32))
    return mesh


def barycentric_points(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    face: Int[np.ndarray, "P"],
    barycentric: Float[np.ndarray, "P 3"],
) -> Float[np.ndarray, "P 3"]:
    """Compute the surface points with these faces and barycentrics, in the vertices' unit and frame."""
    return np.einsum("pk,pkc->pc", barycentric, np.asarray(vertices)[np.asarray(triangles)[face]])


def on_triangles(
    points: Float[np.ndarray, "M 3"], corners: Float[np.ndarray, "M 3 3"]
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """Compute distance and barycentrics of the closest point of one triangle per point.

    The best of the closest points of the three edges and, where it lies inside, the foot of the perpendicular on the
    plane. Every candidate is a point of the triangle, so the result stays valid for slivers and degenerate triangles.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d1, d2, d3, d4, d5 = (np.einsum("mc,mc->m", p, q) for p, q in ((ab, ab), (ab, ac), (ac, ac), (ab, ap), (ac, ap)))
    area = d1 * d3 - d2 * d2
    with np.errstate(divide="ignore", invalid="ignore"):
        v, w = (d3 * d4 - d2 * d5) / area, (d1 * d5 - d2 * d4) / area
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)  # false where the area is zero
        best = np.where(inside[:, None], np.stack([1 - v - w, v, w], 1), 0.0)
    squared = np.where(inside, _squared(points, corners, best), np.inf)
    outside = np.flatnonzero(~inside | (area < 1e-8 * d1 * d3))  # the foot on a sliver is inaccurate
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, edge = corners[outside, i], corners[outside, j] - corners[outside, i]
        length = np.einsum("mc,mc->m", edge, edge)
        along = np.einsum("mc,mc->m", points[outside] - start, edge)
        t = np.clip(along / np.where(length > 0, length, 1.0), 0.0, 1.0)
        barycentric = np.zeros((len(outside), 3))
        barycentric[:, i], barycentric[:, j] = 1 - t, t
        candidate = _squared(points[outside], corners[outside], barycentric)
        nearer = candidate < squared[outside]
        rows = outside[nearer]
        squared[rows], best[rows] = candidate[nearer], barycentric[nearer]
    return np.sqrt(squared), best


def _squared(points: np.ndarray, corners: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    offset = points - np.einsum("mk,mkc->mc", barycentric, corners)
    return np.einsum("mc,mc->m", offset, offset)


def _require_finite(coordinates: np.ndarray) -> None:
    if not np.isfinite(coordinates).all():
        raise ValueError("points and vertices must be finite")
