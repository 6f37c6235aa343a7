"""Exact closest points on a triangle mesh.

Centroid trees give candidates, an exact point-triangle distance decides (Ericson, Real-Time Collision Detection,
2005, section 5.1.5). A triangle whose centroid is d away can come no nearer than d minus its radius, so the search
widens until that bound excludes all the rest. Triangles are sorted into trees by size: one big triangle would
otherwise widen the search for all.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

_BATCH = 1 << 18  # point-triangle pairs examined together: about 100 MB of temporaries
_FEW = 2000  # points for which starting threads takes longer than the search
_FIRST = 8  # candidates of a point in the first round; each further round has four times as many


def closest_points(
    points: Float[np.ndarray, "P 3"], vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
    """Distance, face and barycentrics of the closest surface point of each point, in float64.

    Points and vertices share any unit and frame; the distance is unsigned. Degenerate triangles count as the segment
    or point that they are.

    Raises:
        ValueError: there are no triangles, or a coordinate is not finite.
    """
    return Searched(vertices, triangles).closest(points)


class Searched:
    """A mesh made ready to be searched again and again."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        """Raises ValueError as `closest_points`."""
        if not len(triangles):
            raise ValueError("a mesh without triangles has no closest point")
        self._corners = np.asarray(vertices, np.float64)[triangles]
        _require_finite(self._corners)
        centroids = self._corners.mean(1)
        radii = np.linalg.norm(self._corners - centroids[:, None], axis=-1).max(1)
        self._classes = [_SizeClass(members, centroids, radii) for members in _by_size(radii)]

    def closest(
        self, points: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
        """As `closest_points`."""
        points = np.asarray(points, np.float64)
        _require_finite(points)
        best = _Best(len(points))
        for size_class in self._classes:  # a good bound from every class first, so that no class is searched in vain
            size_class.search(points, np.arange(len(points)), self._corners, best, count=1)
        for size_class in self._classes:
            size_class.search_all(points, self._corners, best)
        return best.distance, best.face, best.barycentric


def _require_finite(coordinates: np.ndarray) -> None:
    if not np.isfinite(coordinates).all():
        raise ValueError("points and vertices must be finite")


def barycentric_points(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    face: Int[np.ndarray, "P"],
    barycentric: Float[np.ndarray, "P 3"],
) -> Float[np.ndarray, "P 3"]:
    """The surface points with these faces and barycentrics, in the vertices' unit and frame."""
    return np.einsum("pk,pkc->pc", barycentric, np.asarray(vertices)[np.asarray(triangles)[face]])


class _Best:
    """The nearest surface point of each query point so far."""

    def __init__(self, count: int):
        self.distance = np.full(count, np.inf)
        self.face = np.full(count, -1)
        self.barycentric = np.zeros((count, 3))

    def offer(self, rows: np.ndarray, faces: np.ndarray, distance: np.ndarray, barycentric: np.ndarray) -> None:
        """Take candidates where they are nearer; a row may be offered several faces."""
        order = np.lexsort((distance, rows))
        rows, first = np.unique(rows[order], return_index=True)
        chosen = order[first]
        nearer = distance[chosen] < self.distance[rows]
        rows, chosen = rows[nearer], chosen[nearer]
        self.distance[rows], self.face[rows] = distance[chosen], faces[chosen]
        self.barycentric[rows] = barycentric[chosen]


class _SizeClass:
    """Triangles of about one radius and a tree of their centroids."""

    def __init__(self, members: np.ndarray, centroids: np.ndarray, radii: np.ndarray):
        self.members, self.radii = members, radii[members]
        self.radius = self.radii.max()
        self.tree = cKDTree(centroids[members])

    def search_all(self, points: np.ndarray, corners: np.ndarray, best: _Best) -> None:
        """Widen the search of each point until the class holds nothing nearer."""
        open_rows, count = np.arange(len(points)), _FIRST
        while len(open_rows):
            reached = self.search(points, open_rows, corners, best, count)
            if count >= len(self.members):
                return
            open_rows = open_rows[reached - self.radius < best.distance[open_rows]]
            count *= 4

    def search(self, points: np.ndarray, rows: np.ndarray, corners: np.ndarray, best: _Best, count: int) -> np.ndarray:
        """Offer each point its `count` nearest centroids' triangles; how far away the last centroid was."""
        count = min(count, len(self.members))
        reached = np.empty(len(rows))
        size = max(1, _BATCH // count)
        for start in range(0, len(rows), size):
            part = rows[start : start + size]
            workers = -1 if len(part) > _FEW else 1
            away, index = self.tree.query(points[part], k=range(1, count + 1), workers=workers)
            reached[start : start + size] = away[:, -1]
            hopeful = away - self.radii[index] < best.distance[part, None]
            row, column = np.nonzero(hopeful)
            faces = self.members[index[row, column]]
            distance, barycentric = on_triangles(points[part[row]], corners[faces])
            best.offer(part[row], faces, distance, barycentric)
        return reached


def _by_size(radii: np.ndarray) -> list[np.ndarray]:
    """Triangle indices in classes whose radii differ by at most a factor of two; the smallest ones share a class."""
    typical = np.median(radii) or radii.max() or 1.0
    octave = np.maximum(np.ceil(np.log2(np.maximum(radii, 1e-300) / typical)), 0).astype(int)
    return [np.flatnonzero(octave == k) for k in np.unique(octave)]


def on_triangles(
    points: Float[np.ndarray, "M 3"], corners: Float[np.ndarray, "M 3 3"]
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """Distance and barycentrics of the closest point of one triangle per point.

    The best of the three edges and, where it lies inside, the foot on the plane: every candidate is a point of the
    triangle, so slivers and degenerate triangles can do no harm.
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
    outside = np.flatnonzero(~inside | (area < 1e-8 * d1 * d3))  # a sliver's foot is a guess: ask its edges too
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
    away = points - np.einsum("mk,mkc->mc", barycentric, corners)
    return np.einsum("mc,mc->m", away, away)
