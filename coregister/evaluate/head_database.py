"""The nearest of many heads to one, by a bound that proves it (docs/algorithms.md, "Specificity").

The distance between two heads A and B in correspondence is the mean distance of points of A from B's surface and of the
same points of B from A's, after rigid alignment. The distance from a surface is 1-Lipschitz: if the surface is r away
from a centre c, it is at least r - |p - c| away from a point p. Centres lie on the normals of the points, so that these
empty balls touch the surface near the points that are asked for. Heads are tried in the order of their bounds, and the
search ends where the bound exceeds the least distance so far.
"""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.frames import MM_PER_M
from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.geometry.rigid import align

_NEAR_M = (0.03,)  # offsets of centres along the normals, both ways: those that are tried on all heads
_MORE_M = (0.015, 0.06)  # then on the heads that are left
_FEW = 8  # heads left that are not worth more centres
_MARGIN_M = 2e-6  # bounds are computed in float32
_BLOCKS = 10  # of points: after each, the bound is compared again
_HEADS = 64  # bounded at a time
_TREES = 600  # kept in memory, 4 MB each for a head's skin of 13,000 vertices


@dataclass(frozen=True, kw_only=True)
class Nearest:
    """The nearest head of a database."""

    distance_mm: float
    index: int  # of the head
    evaluations: int  # number of heads whose distance was begun to be computed


class HeadDatabase:
    """Heads in correspondence, prepared for the search; their centroids are moved to the origin."""

    def __init__(
        self,
        heads: Float[np.ndarray, "N P 3"],
        triangles: Int[np.ndarray, "F 3"],
        points: tuple[Int[np.ndarray, "M"], Float[np.ndarray, "M 3"]],
    ) -> None:
        """Prepare the heads.

        Args:
            heads: vertices, metres, each in any frame.
            triangles: of all heads, vertex indices.
            points: faces and barycentrics of the points whose distances are averaged.
        """
        self._triangles, self._points = triangles, points
        self._heads = [_centred(head) for head in heads]
        self._columns = np.concatenate([head.T for head in self._heads]).astype(np.float32)  # 3N x P
        self._trees: OrderedDict[int, ClosestPointQuery] = OrderedDict()
        self._on_heads = np.stack([self._surface_points(head) for head in self._heads]).astype(np.float32)
        balls = []
        for index, head in enumerate(self._heads):
            tree = self._tree(index)
            balls.append([self._balls(head, tree, offsets) for offsets in (_NEAR_M, _MORE_M)])
        self._near, self._more = (_stack([pair[k] for pair in balls]) for k in (0, 1))

    def nearest(self, head: Float[np.ndarray, "P 3"]) -> Nearest:
        """Find the nearest head.

        Args:
            head: vertices in the same correspondence, metres, any frame.
        """
        head = _centred(head)
        tree = ClosestPointQuery(head, self._triangles)
        pair = _Pair(tree, self._surface_points(head), self._rotations(head))
        near = self._balls(head, tree, _NEAR_M)
        bounds = self._bounds(pair, np.arange(len(self._heads)), self._near, near)
        order = np.argsort(bounds.mean((1, 2)))
        best, index, evaluations = np.inf, -1, 0
        tightened = False
        while len(order) and bounds[order[0]].mean() <= best:
            tried, order = order[0], order[1:]
            distance = self._distance(head, pair, int(tried), bounds[tried], best)
            evaluations += 1
            if distance < best:
                best, index = distance, int(tried)
            order = order[bounds[order].mean((1, 2)) <= best]
            if not tightened and len(order) > _FEW:
                more = self._balls(head, tree, _MORE_M)
                bounds[order] = np.maximum(bounds[order], self._bounds(pair, order, self._more, more))
                order = order[np.argsort(bounds[order].mean((1, 2)))]
                tightened = True
        return Nearest(distance_mm=best * MM_PER_M, index=index, evaluations=evaluations)

    def _distance(
        self, head: np.ndarray, pair: "_Pair", index: int, bounds: Float[np.ndarray, "2 M"], best: float
    ) -> float:
        """The distance of one head of the database, or infinity once it is proven to be larger than the best."""
        other = self._heads[index]
        rotation = align(head[None], other, np.ones((1, len(head))))[0, :3, :3]
        on_head, on_other = pair.points, self._surface_points(other)
        turned = np.stack([on_head @ rotation.T, on_other @ rotation])
        trees = (self._tree(index), pair.tree)
        distances = bounds.astype(np.float64)
        reach = np.linalg.norm(turned[0] - on_other, axis=1)  # between corresponding points: at most so far
        order = np.argsort(bounds - reach, axis=None, kind="stable")  # where most is to be gained first
        for block in np.array_split(order, _BLOCKS):
            side, point = np.unravel_index(block, bounds.shape)
            for k in (0, 1):
                rows = point[side == k]
                distances[k, rows] = trees[k].distance(turned[k, rows])
            if distances.mean() > best:
                return np.inf
        return float(distances.mean())

    def _bounds(
        self, pair: "_Pair", heads: Int[np.ndarray, "n"], theirs: "_Balls", own: "_Balls"
    ) -> Float[np.ndarray, "n 2 M"]:
        """Lower bounds of the distances of the head's points from heads of the database, and of theirs from it."""
        bounds = np.empty((len(heads), 2, len(pair.points)), np.float32)
        on_head = pair.points.astype(np.float32)
        for start in range(0, len(heads), _HEADS):
            chosen = heads[start : start + _HEADS]
            rotations = pair.rotations[chosen]
            rows = slice(start, start + len(chosen))
            bounds[rows, 0] = theirs.at(chosen).bound(on_head @ rotations.transpose(0, 2, 1))
            bounds[rows, 1] = own.bound(self._on_heads[chosen] @ rotations)
        return bounds

    def _rotations(self, head: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "N 3 3"]:
        """Rotations of the head that align it with each head of the database: those of `align`, in float32."""
        covariance = (self._columns @ head.astype(np.float32)).reshape(-1, 3, 3).astype(np.float64)
        u, _, vt = np.linalg.svd(covariance)
        vt[:, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        return (u @ vt).astype(np.float32)

    def _balls(self, head: np.ndarray, tree: ClosestPointQuery, offsets: tuple[float, ...]) -> "_Balls":
        face, _ = self._points
        a, b, c = (head[self._triangles[face, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal /= np.where(length > 0, length, 1)
        points = self._surface_points(head)
        centres = np.stack([points + sign * offset * normal for offset in offsets for sign in (1, -1)])
        radii = tree.distance(centres.reshape(-1, 3)).reshape(centres.shape[:2])
        return _Balls(centres.astype(np.float32), radii.astype(np.float32))

    def _surface_points(self, head: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "M 3"]:
        return barycentric_points(head, self._triangles, *self._points)

    def _tree(self, index: int) -> ClosestPointQuery:
        if (tree := self._trees.get(index)) is None:
            tree = self._trees[index] = ClosestPointQuery(self._heads[index], self._triangles)
            if len(self._trees) > _TREES:
                self._trees.popitem(last=False)
        self._trees.move_to_end(index)
        return tree


@dataclass(frozen=True)
class _Pair:
    """What the comparisons of one head share."""

    tree: ClosestPointQuery
    points: Float[np.ndarray, "M 3"]
    rotations: Float[np.ndarray, "N 3 3"]  # to each head of the database


@dataclass(frozen=True)
class _Balls:
    """Balls without surface inside: B for each of M points, of one head or of N."""

    centres: Float[np.ndarray, "*N B M 3"]
    radii: Float[np.ndarray, "*N B M"]

    def at(self, heads: Int[np.ndarray, "n"]) -> "_Balls":
        return _Balls(self.centres[heads], self.radii[heads])

    def bound(self, points: Float[np.ndarray, "n M 3"]) -> Float[np.ndarray, "n M"]:
        """Lower bounds of the distances of points from the surface."""
        bound = np.zeros(points.shape[:2], np.float32)
        for k in range(self.radii.shape[-2]):
            offset = points - self.centres[..., k, :, :]
            distance = np.sqrt(np.einsum("nmc,nmc->nm", offset, offset))
            np.maximum(bound, self.radii[..., k, :] - distance - np.float32(_MARGIN_M), out=bound)
        return bound


def _stack(balls: list[_Balls]) -> _Balls:
    return _Balls(np.stack([each.centres for each in balls]), np.stack([each.radii for each in balls]))


def _centred(head: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """The head with its centroid at the origin: rigid alignment of two such heads is a rotation."""
    head = np.asarray(head, np.float64)
    return np.asarray(head - head.mean(0))
