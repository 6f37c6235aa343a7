"""A mesh with another number of vertices: edges are collapsed or split until it has exactly that many.

Every new vertex is an old one, or the middle of two, so that one sparse matrix carries everything that a mesh has per
vertex over to the new one: template, bases and weights.
"""

import heapq
from collections import defaultdict

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

_FLIP = 0.2  # least cosine between a triangle before and after a collapse
_BOUNDARY = 10.0  # weight of the planes that hold open edges in place
_LENGTH = 1e-3  # of squared edge lengths, which decide on flat parts


def resample(
    points: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], count: int
) -> tuple[csr_matrix, Int[np.ndarray, "G 3"]]:
    """Return the matrix from old vertices to `count` new ones, and the new triangles.

    Args:
        points: vertices, all of them used.
        triangles: a manifold mesh, with or without open edges.
        count: of new vertices; fewer: by quadric error metrics, collapsing edges; more: splitting the longest edges.
    """
    return _split(points, triangles, count) if count >= len(points) else _Collapse(points, triangles).run(count)


def _split(points: np.ndarray, triangles: np.ndarray, count: int) -> tuple[csr_matrix, np.ndarray]:
    places = [tuple(p) for p in points.tolist()]
    parts: list[dict[int, float]] = [{v: 1.0} for v in range(len(points))]
    faces = [tuple(t) for t in triangles.tolist()]
    around: dict[tuple[int, int], set[int]] = defaultdict(set)

    def edges(face: tuple[int, ...]) -> list[tuple[int, int]]:
        return [(min(a, b), max(a, b)) for a, b in zip(face, face[1:] + face[:1], strict=True)]

    def length(edge: tuple[int, int]) -> float:
        return sum((a - b) ** 2 for a, b in zip(places[edge[0]], places[edge[1]], strict=True))

    for k, face in enumerate(faces):
        for edge in edges(face):
            around[edge].add(k)
    heap = [(-length(edge), edge) for edge in around]
    heapq.heapify(heap)
    while len(places) < count:
        _, edge = heapq.heappop(heap)
        if not (shared := around.pop(edge, None)):
            continue
        a, b = edge
        middle = len(places)
        places.append(tuple((p + q) / 2 for p, q in zip(places[a], places[b], strict=True)))
        merged: dict[int, float] = defaultdict(float)
        for end in edge:
            for vertex, weight in parts[end].items():
                merged[vertex] += weight / 2
        parts.append(dict(merged))
        for k in sorted(shared):
            old = faces[k]
            for other in edges(old):
                around[other].discard(k) if other != edge else None
            faces[k] = tuple(middle if v == a else v for v in old)
            faces.append(tuple(middle if v == b else v for v in old))
            for new in (k, len(faces) - 1):
                for other in edges(faces[new]):
                    around[other].add(new)
                    if middle in other:
                        heapq.heappush(heap, (-length(other), other))
    rows = np.repeat(np.arange(count), [len(part) for part in parts])
    columns = np.concatenate([list(part) for part in parts])
    weights = np.concatenate([list(part.values()) for part in parts])
    return csr_matrix((weights, (rows, columns)), shape=(count, len(points))), np.array(faces)


class _Collapse:
    """Half-edge collapses, the cheapest in quadric error first."""

    def __init__(self, points: np.ndarray, triangles: np.ndarray) -> None:
        self.points = [tuple(p) for p in (1e2 * points).tolist()]  # centimetres, for the quadrics' scale
        self.faces: dict[int, tuple[int, ...]] = {k: tuple(t) for k, t in enumerate(triangles.tolist())}
        self.at: list[set[int]] = [set() for _ in points]
        for k, face in self.faces.items():
            for v in face:
                self.at[v].add(k)
        edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
        ends, where, uses = np.unique(np.sort(edges, 1), axis=0, return_inverse=True, return_counts=True)
        open_edges = ends[uses == 1]
        self.open = np.zeros(len(points), bool)
        self.open[open_edges] = True
        self.quadrics = self._quadrics(1e2 * points, triangles, edges, uses[where.ravel()] == 1)
        self.stamp = [0] * len(points)
        self.heap: list[tuple[float, int, int, int, int]] = []
        for a, b in ends.tolist():
            self._push(a, b)

    @staticmethod
    def _quadrics(
        points: np.ndarray, triangles: np.ndarray, edges: np.ndarray, is_open: np.ndarray
    ) -> list[np.ndarray]:
        corners = points[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.maximum(area, 1e-12)
        planes = np.concatenate([normals, -(normals * corners[:, 0]).sum(1, keepdims=True)], 1)
        outer = planes[:, :, None] * planes[:, None] * area[:, :, None]
        total = np.zeros((len(points), 4, 4))
        for corner in range(3):
            np.add.at(total, triangles[:, corner], outer)
        faces = np.tile(np.arange(len(triangles)), 3)[is_open]
        ends = edges[is_open]
        along = points[ends[:, 1]] - points[ends[:, 0]]
        upright = np.cross(along, normals[faces])
        upright /= np.maximum(np.linalg.norm(upright, axis=1, keepdims=True), 1e-12)
        walls = np.concatenate([upright, -(upright * points[ends[:, 0]]).sum(1, keepdims=True)], 1)
        outer = _BOUNDARY * walls[:, :, None] * walls[:, None] * (along**2).sum(1)[:, None, None]
        for end in range(2):
            np.add.at(total, ends[:, end], outer)
        return list(total)

    def _neighbours(self, v: int) -> set[int]:
        return {w for k in self.at[v] for w in self.faces[k]} - {v}

    def _push(self, a: int, b: int) -> None:
        """Offer both directions of an edge; an open vertex only moves along open edges."""
        shared = len(self.at[a] & self.at[b])
        Q = self.quadrics[a] + self.quadrics[b]
        length = sum((p - q) ** 2 for p, q in zip(self.points[a], self.points[b], strict=True))
        for gone, kept in ((a, b), (b, a)):
            if not self.open[gone] or (shared == 1 and self.open[kept]):
                x, y, z = self.points[kept]
                rows = Q.tolist()
                p = (x, y, z, 1.0)
                cost = sum(p[i] * sum(rows[i][j] * p[j] for j in range(4)) for i in range(4))
                entry = (max(cost, 0.0) + _LENGTH * length, gone, kept, self.stamp[gone], self.stamp[kept])
                heapq.heappush(self.heap, entry)

    def _normal(self, face: tuple[int, ...]) -> np.ndarray:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (self.points[v] for v in face)
        ux, uy, uz, wx, wy, wz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        return np.array([uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx])

    def _allowed(self, gone: int, kept: int) -> bool:
        shared = self.at[gone] & self.at[kept]
        if len(self._neighbours(gone) & self._neighbours(kept)) != len(shared):
            return False
        for k in self.at[gone] - shared:
            before = self._normal(self.faces[k])
            after = self._normal(tuple(kept if v == gone else v for v in self.faces[k]))
            if before @ after < _FLIP * np.sqrt((before @ before) * (after @ after)) or after @ after < 1e-12:
                return False
        return True

    def run(self, count: int) -> tuple[csr_matrix, np.ndarray]:
        """Collapse until `count` vertices are left."""
        alive = np.ones(len(self.points), bool)
        left = len(alive)
        while left > count:
            if not self.heap:
                raise ValueError(f"no edge can be collapsed any more: {left} vertices")
            _, gone, kept, *stamps = heapq.heappop(self.heap)
            if stamps != [self.stamp[gone], self.stamp[kept]] or not (alive[gone] and alive[kept]):
                continue
            if not self._allowed(gone, kept):
                continue
            for k in list(self.at[gone]):
                if kept in self.faces[k]:
                    for v in self.faces.pop(k):
                        self.at[v].discard(k)
                else:
                    self.faces[k] = tuple(kept if v == gone else v for v in self.faces[k])
                    self.at[kept].add(k)
            self.at[gone].clear()
            alive[gone] = False
            left -= 1
            self.quadrics[kept] = self.quadrics[kept] + self.quadrics[gone]
            self.stamp[kept] += 1
            for v in self._neighbours(kept):
                self._push(kept, v)
        kept_vertices = np.flatnonzero(alive)
        number = np.cumsum(alive) - 1
        selection = csr_matrix((np.ones(count), (np.arange(count), kept_vertices)), shape=(count, len(alive)))
        return selection, number[np.array(list(self.faces.values()))]
