"""Generalized winding numbers of triangle meshes, and the closing of meshes that have openings [Jacobson 2013]."""

import lagrange
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from registration.geometry.closest_point import surface_mesh


class Winding:
    """A surface prepared for queries of its winding number, by the fast winding number of [Barill 2018] in float32."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        """Build the tree.

        Args:
            vertices: in any unit and frame; those that no triangle uses are ignored.
            triangles: vertex indices, counter-clockwise seen from outside.

        Raises:
            ValueError: a corner is not finite.
        """
        vertices = np.asarray(vertices, np.float64)
        corners = vertices[triangles]
        if not np.isfinite(corners).all():
            raise ValueError("vertices must be finite")
        self._tree = None
        if len(triangles):
            self._centre = corners.mean((0, 1))
            self._tree = lagrange.winding.FastWindingNumber(surface_mesh(vertices - self._centre, triangles))

    def numbers(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """Compute how often the surface winds around each point: the solid angles of its triangles over 4 pi.

        1 inside a closed surface, 0 outside, 2 where two lobes of it overlap, -1 where it is inside out, in between for
        surfaces that are open. Undefined on the surface itself, where it jumps.

        Args:
            points: in the surface's unit and frame.

        Returns:
            The numbers, approximated to 0.01: distant triangles are replaced by moments of their normals.

        Raises:
            ValueError: a coordinate is not finite.
        """
        points = np.asarray(points, np.float64)
        if not np.isfinite(points).all():
            raise ValueError("points must be finite")
        if self._tree is None or not len(points):
            return np.zeros(len(points))
        angles = self._tree.solid_angle(np.ascontiguousarray(points - self._centre))
        return angles.astype(np.float64) / (4 * np.pi)


def closed(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Close each opening of a mesh by a cone.

    The apex lies outwards of the opening, above the mean of its rim, by half the rim's mean radius. A flat lid would
    exclude surface that bulges through the opening: the palate rises higher than the rim of the gums.

    Args:
        vertices: in any unit and frame.
        triangles: of one or several open surfaces.

    Returns:
        Vertices, float64, followed by the apexes, and the triangles followed by those of the cones.
    """
    vertices, triangles = np.asarray(vertices, np.float64), np.asarray(triangles)
    rim = _boundary(triangles)
    if not len(rim):
        return vertices, triangles
    graph = coo_matrix((np.ones(len(rim)), rim.T), (len(vertices), len(vertices)))
    opening = connected_components(graph, directed=False)[1][rim[:, 0]]
    apexes, cones = [], []
    for number, label in enumerate(np.unique(opening)):
        edge = rim[opening == label]
        start, end = vertices[edge[:, 0]], vertices[edge[:, 1]]
        centre = start.mean(0)
        area = np.cross(end - centre, start - centre).sum(0)  # of a lid, whose direction along the rim is opposite
        outwards = area / max(float(np.linalg.norm(area)), 1e-300)
        apexes.append(centre + 0.5 * np.linalg.norm(start - centre, axis=1).mean() * outwards)
        cones.append(np.column_stack([edge[:, ::-1], np.full(len(edge), len(vertices) + number)]))
    return np.concatenate([vertices, apexes]), np.concatenate([triangles, *cones])


def _boundary(triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "B 2"]:
    """The boundary edges in the direction of their triangle, each as often as triangles lack an opposite there."""
    start, end = triangles.T.ravel(), triangles[:, [1, 2, 0]].T.ravel()
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end).astype(np.int64)
    size = int(triangles.max(initial=0)) + 1
    key, index = np.unique(low * size + high, return_inverse=True)
    surplus = np.bincount(index, np.where(start < end, 1, -1), len(key)).astype(int)
    edges = np.stack([key // size, key % size], 1)
    edges[surplus < 0] = edges[surplus < 0, ::-1]
    return np.repeat(edges, np.abs(surplus), 0)
