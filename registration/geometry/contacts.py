"""Contacts within a mesh: how deep a vertex lies behind the surface of another part.

Depth is the distance to the closest point of that surface, positive behind it. Which triangles may hold that point is
looked up once for some steps; which one does, and where, is found at every step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from registration.geometry.topology import edges, vertex_normals
from registration.geometry.winding import Winding

_WATCHED = 24  # triangles around a vertex
_SELECTING = 6  # of them, the nearest, by which it is chosen what to watch
# Cosine between the way to the closest point and the normal there; less is past the last triangle that was looked at.
# Grooves of solids down to 60 degrees stay above it.
_ALIGNED = 0.5
_ABOVE = 0.05  # mm over a vertex its own skin is no longer in the way


@dataclass(frozen=True, kw_only=True)
class Watched:
    """Vertices and, for each, K triangles one of which it may get behind."""

    place: Int[Tensor, "M"]  # in the list of points that it was found in
    points: Int[Tensor, "M"]
    triangles: Int[Tensor, "M K 3"]
    rim: Bool[Tensor, "M K 3"]  # corners on the border of an open surface

    @classmethod
    def joined(cls, parts: Sequence["Watched"]) -> "Watched":
        """All rows of some, in their order."""
        return cls(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def compact(self) -> tuple[Int[Tensor, "U"], "Watched"]:
        """The vertices that take part, and the same rows in places in that list."""
        ids = torch.cat([self.points, self.triangles.flatten()])
        index, place = ids.unique(return_inverse=True)
        points, triangles = place[: len(self.points)], place[len(self.points) :]
        return index, replace(self, points=points, triangles=triangles.view_as(self.triangles))

    def first(self, count: int) -> "Watched":
        """The same with the first triangles of each row alone."""
        return replace(self, triangles=self.triangles[:, :count], rim=self.rim[:, :count])

    def only(self, rows: Bool[Tensor, "M"]) -> "Watched":
        return Watched(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def to(self, device: torch.device) -> "Watched":
        return Watched(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


@dataclass(frozen=True, kw_only=True)
class Depths:
    """How deep M vertices lie: depth = direction . (sum of weights * corners - vertex). Nothing has a gradient."""

    depth: Float[Tensor, "M"]  # negative in front of the surface, -inf past the border of an open one
    triangle: Int[Tensor, "M 3"]
    weights: Float[Tensor, "M 3"]  # barycentrics of the closest point
    direction: Float[Tensor, "M 3"]  # unit, the shortest way out

    def again(
        self, vertices: Float[Tensor, "V 3"], points: Int[Tensor, "M"], rows: Int[Tensor, "R"]
    ) -> Float[Tensor, "R"]:
        """The depths of some rows, differentiable in the vertex and the triangle's corners.

        Exact to first order though direction and weights stand still: the closest point is where moving it along the
        surface changes nothing.
        """
        # Not vertices[...]: the adjoint of that sums in parallel, differently from run to run.
        corners = vertices.index_select(0, self.triangle[rows].flatten()).unflatten(0, (-1, 3))
        ahead = (self.weights[rows][:, :, None] * corners).sum(1) - vertices.index_select(0, points[rows])
        return (self.direction[rows] * ahead).sum(-1)


@torch.no_grad()
def depths(vertices: Float[Tensor, "V 3"], watched: Watched) -> Depths:
    """How deep each watched vertex lies behind the closest point of its triangles."""
    p = vertices[watched.points][:, None]
    a, b, c = vertices[watched.triangles].unbind(2)
    ab, ac, ap = b - a, c - a, p - a
    weights = _closest(ab, ac, ap)
    ahead = weights[..., 1:2] * ab + weights[..., 2:] * ac - ap
    distance = ahead.norm(dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(ab, ac), dim=-1)
    along = (normal * ahead).sum(-1)
    # On an edge several triangles are equally close: the one seen most squarely knows which side the vertex is on.
    best = (distance - 1e-3 * along.abs()).argmin(1)
    row = torch.arange(len(best), device=best.device)
    weights, ahead, distance = (t[row, best] for t in (weights, ahead, distance))
    side = along[row, best].sign()
    on_rim = (weights * watched.rim[row, best]).sum(-1) > 1 - 1e-5
    past = on_rim | (along[row, best].abs() < _ALIGNED * distance)
    return Depths(
        depth=torch.where(past, -torch.inf, distance * side),
        triangle=watched.triangles[row, best],
        weights=weights,
        direction=ahead * (side / distance.clamp_min(1e-12))[:, None],
    )


def _closest(ab: Tensor, ac: Tensor, ap: Tensor) -> Float[Tensor, "M K 3"]:
    """Barycentrics of the point of a triangle that is closest to p, from two of its sides and the way to p.

    The foot on the plane where it lies inside, else the best of the three edges.
    """
    d1, d2, d3, d4, d5 = ((s * t).sum(-1) for s, t in ((ab, ab), (ab, ac), (ac, ac), (ab, ap), (ac, ap)))
    tiny = 1e-30
    area = (d1 * d3 - d2 * d2).clamp_min(tiny)
    v, w = (d3 * d4 - d2 * d5) / area, (d1 * d5 - d2 * d4) / area
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    zero = torch.zeros_like(v)
    on_ab, on_ac = (d4 / d1.clamp_min(tiny)).clamp(0, 1), (d5 / d3.clamp_min(tiny)).clamp(0, 1)
    on_bc = ((d1 - d2 - d4 + d5) / (d1 - 2 * d2 + d3).clamp_min(tiny)).clamp(0, 1)
    best = torch.full_like(v, torch.inf)
    for s, t in ((on_ab, zero), (zero, on_ac), (1 - on_bc, on_bc)):
        # Squared distance from p to a + s ab + t ac, but for |ap|^2, which all share.
        cost = s * s * d1 + 2 * s * t * d2 + t * t * d3 - 2 * s * d4 - 2 * t * d5
        nearer = ~inside & (cost < best)
        best, v, w = torch.where(nearer, cost, best), torch.where(nearer, s, v), torch.where(nearer, t, w)
    return torch.stack([1 - v - w, v, w], -1)


class Solids:
    """Parts such as teeth, closed but for where they are fixed, against vertices of other parts.

    Parts are looked at one by one: of two that touch, the closer one would hide that a vertex lies in its neighbour.
    """

    def __init__(
        self,
        points: Int[np.ndarray, "P"],
        parts: Sequence[Int[np.ndarray, "_ 3"]],
        *,
        inside: float,
        outside: float,
        flesh: "Flesh | None" = None,
    ):
        """Vertices are watched while they are at most `inside` behind and `outside` in front of a part's surface.

        `flesh`, where parts and points have one surface, as the lips do at the corners of the mouth. There a vertex can
        be behind a part and yet in nothing: the part's surface is the far side of what lies under the vertex.
        """
        self.points = points
        self._parts = [_Patch(part) for part in parts if len(part)]
        self._inside, self._outside, self._flesh = inside, outside, flesh

    def watched(self, vertices: Float[np.ndarray, "V 3"], allowed: Float[np.ndarray, "P"]) -> Watched:
        """What to watch now: vertices, once for every part that is near.

        The origin is to lie deep inside the head. What is no deeper than `allowed` needs no proof that it is inside.
        """
        x = vertices[self.points]
        found = [_rows(self.points, np.empty(0, int), _Patch(), np.empty((0, _WATCHED), int))]
        for part in self._parts:
            corners = vertices[part.triangles]
            low, high = corners.min((0, 1)) - self._outside, corners.max((0, 1)) + self._outside
            boxed = np.flatnonzero(((x > low) & (x < high)).all(1))
            row, around = _around(x[boxed], corners, self._inside, self._outside)
            found.append(_rows(self.points, boxed[row], part, around))
        watched = Watched.joined(found)
        depth = depths(torch.as_tensor(vertices), watched.first(_SELECTING)).depth.numpy()
        near = (depth > -self._outside) & (depth < self._inside)
        deep = np.flatnonzero(near & (depth > allowed[watched.place.numpy()]))
        if self._flesh is not None and len(deep):
            near[deep] = self._flesh.holds(vertices, watched.points.numpy()[deep])
        return watched.only(torch.as_tensor(near))


class Flesh:
    """What lies under a piece of skin, down to a cone from its border to the origin."""

    def __init__(self, triangles: Int[np.ndarray, "F 3"]):
        self._patch = _Patch(triangles)
        self._looked: tuple[np.ndarray, np.ndarray, Winding] | None = None

    def holds(self, vertices: Float[np.ndarray, "V 3"], points: Int[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
        """Whether vertices of the skin, or rather points closely above them, lie inside of it."""
        if self._looked is None or self._looked[0] is not vertices:  # several parts ask about one mesh
            self._looked = (vertices, *self._look(vertices))
        _, normals, winding = self._looked
        return winding.numbers(vertices[points] + _ABOVE * normals[points]) > 0.5

    def _look(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "V 3"], Winding]:
        triangles, border = self._patch.triangles, self._patch.border
        cone = np.column_stack([border[:, ::-1], np.full(len(border), len(vertices))])
        closed = np.concatenate([triangles, cone])
        normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles)).numpy()
        return normals, Winding(np.concatenate([vertices, np.zeros((1, 3))]), closed)


class _Patch:
    """Triangles of one surface, the edges at its border, and which corners lie on it."""

    def __init__(self, triangles: Int[np.ndarray, "F 3"] | None = None):
        self.triangles = np.empty((0, 3), int) if triangles is None else triangles
        self.border = np.empty((0, 2), int)
        if len(self.triangles):
            found = edges(self.triangles)
            self.border = found.vertices[found.faces[:, 1] < 0]
        self.rim = np.isin(self.triangles, self.border)


def _rows(points: np.ndarray, place: np.ndarray, patch: _Patch, around: np.ndarray) -> Watched:
    arrays = {"place": place, "points": points[place], "triangles": patch.triangles[around], "rim": patch.rim[around]}
    return Watched(**{name: torch.as_tensor(array) for name, array in arrays.items()})


def _around(
    points: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "F 3 3"], inside: float, outside: float
) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M K"]]:
    """The points that may be near enough to a part, and the triangles with the nearest centroids; some repeat."""
    if not len(points) or not len(corners):
        return np.empty(0, int), np.empty((0, _WATCHED), int)
    centres = corners.mean(1)
    radius = np.linalg.norm(corners - centres[:, None], axis=-1).max()
    away, index = cKDTree(centres).query(points, k=_WATCHED, distance_upper_bound=max(inside, outside) + radius)
    a, b, c = corners[np.minimum(index[:, 0], len(corners) - 1)].transpose(1, 0, 2)
    behind = (np.cross(b - a, c - a) * (points - a)).sum(1) < 0  # of most that are; others are soon near enough
    row = np.flatnonzero((away[:, 0] < outside + radius) | (behind & np.isfinite(away[:, 0])))
    return row, np.where(np.isfinite(away[row]), index[row], index[row, :1])
