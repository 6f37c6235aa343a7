"""Contacts within a mesh: how deep a vertex lies behind the surface of another part.

Depth is the distance to the closest point of that surface, positive behind it. A search selects candidate triangles for
several optimizer steps; each step selects the closest of them and computes the closest point.
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

_CANDIDATES = 24  # triangles for each vertex
_SELECTING = 6  # the nearest of them, by which the vertices are selected
# Minimum cosine between the offset to the closest point and its face normal. Below it the true closest point lies
# outside the candidate faces. Grooves of solids down to 60 degrees stay above it.
_MIN_COSINE = 0.5
_OFFSET_MM = 0.05  # of a query point along the normal, so that the vertex' own faces do not enclose it


@dataclass(frozen=True, kw_only=True)
class ContactCandidates:
    """M vertices and, for each, K triangles of another part that it may be behind."""

    query: Int[Tensor, "M"]  # index into the points that were searched
    points: Int[Tensor, "M"]  # vertices
    triangles: Int[Tensor, "M K 3"]
    rim: Bool[Tensor, "M K 3"]  # corners on the boundary of an open surface

    @classmethod
    def concatenate(cls, parts: Sequence["ContactCandidates"]) -> "ContactCandidates":
        """Return the rows of all parts, in their order."""
        return cls(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def compact(self) -> tuple[Int[Tensor, "U"], "ContactCandidates"]:
        """Return the vertices in use, and the candidates with indices into these."""
        ids = torch.cat([self.points, self.triangles.flatten()])
        index, inverse = ids.unique(return_inverse=True)
        points, triangles = inverse[: len(self.points)], inverse[len(self.points) :]
        return index, replace(self, points=points, triangles=triangles.view_as(self.triangles))

    def first(self, count: int) -> "ContactCandidates":
        """Return the candidates with only the first `count` triangles of each row."""
        return replace(self, triangles=self.triangles[:, :count], rim=self.rim[:, :count])

    def only(self, rows: Bool[Tensor, "M"]) -> "ContactCandidates":
        """Return the selected rows."""
        return ContactCandidates(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def to(self, device: torch.device) -> "ContactCandidates":
        """Return a copy on a device."""
        return ContactCandidates(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


@dataclass(frozen=True, kw_only=True)
class Depths:
    """Depths of M vertices without gradients: depth = direction . (sum of weights * corners - vertex)."""

    depth: Float[Tensor, "M"]  # negative in front of the surface, -inf beyond the boundary of an open one
    triangle: Int[Tensor, "M 3"]
    weights: Float[Tensor, "M 3"]  # barycentrics of the closest point
    direction: Float[Tensor, "M 3"]  # unit, along which the vertex leaves the part on the shortest path

    def differentiable(
        self, vertices: Float[Tensor, "V 3"], points: Int[Tensor, "M"], rows: Int[Tensor, "R"]
    ) -> Float[Tensor, "R"]:
        """Compute the depths of some rows again, differentiable in the vertex and the triangle's corners.

        Exact to first order although direction and weights are constants: at the closest point the distance is
        stationary with respect to motion along the surface.

        Args:
            vertices: with gradients, in the unit of the depths.
            points: the candidates' vertices.
            rows: of the candidates.
        """
        # Not vertices[...]: the adjoint of that sums in parallel, differently from run to run.
        corners = vertices.index_select(0, self.triangle[rows].flatten()).unflatten(0, (-1, 3))
        offset = (self.weights[rows][:, :, None] * corners).sum(1) - vertices.index_select(0, points[rows])
        return (self.direction[rows] * offset).sum(-1)


@torch.no_grad()
def depths(vertices: Float[Tensor, "V 3"], candidates: ContactCandidates) -> Depths:
    """Compute how deep each vertex lies behind the closest point of its candidate triangles, in the vertices' unit."""
    p = vertices[candidates.points][:, None]
    a, b, c = vertices[candidates.triangles].unbind(2)
    ab, ac, ap = b - a, c - a, p - a
    weights = _closest(ab, ac, ap)
    offset = weights[..., 1:2] * ab + weights[..., 2:] * ac - ap
    distance = offset.norm(dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(ab, ac), dim=-1)
    along = (normal * offset).sum(-1)
    # Triangles that share the closest edge are equally close: the one whose normal is best aligned with the offset
    # determines on which side the vertex lies.
    best = (distance - 1e-3 * along.abs()).argmin(1)
    row = torch.arange(len(best), device=best.device)
    weights, offset, distance = (t[row, best] for t in (weights, offset, distance))
    side = along[row, best].sign()
    on_rim = (weights * candidates.rim[row, best]).sum(-1) > 1 - 1e-5
    outside = on_rim | (along[row, best].abs() < _MIN_COSINE * distance)
    return Depths(
        depth=torch.where(outside, -torch.inf, distance * side),
        triangle=candidates.triangles[row, best],
        weights=weights,
        direction=offset * (side / distance.clamp_min(1e-12))[:, None],
    )


def _closest(ab: Tensor, ac: Tensor, ap: Tensor) -> Float[Tensor, "M K 3"]:
    """Compute the barycentrics of the closest point of a triangle (a, b, c) to p, from b - a, c - a and p - a.

    The foot of the perpendicular on the plane where it lies inside, else the closest point of the three edges.
    `closest_point.on_triangles` does the same in NumPy.
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
        # Squared distance from p to a + s ab + t ac, without |ap|^2, which all have in common.
        cost = s * s * d1 + 2 * s * t * d2 + t * t * d3 - 2 * s * d4 - 2 * t * d5
        nearer = ~inside & (cost < best)
        best, v, w = torch.where(nearer, cost, best), torch.where(nearer, s, v), torch.where(nearer, t, w)
    return torch.stack([1 - v - w, v, w], -1)


class ContactSearch:
    """Search for vertices near other parts that are solid, such as teeth: closed except where they are attached.

    Parts are searched one by one: of two that touch, the closer one would hide that a vertex lies in its neighbour.
    """

    def __init__(
        self,
        points: Int[np.ndarray, "P"],
        parts: Sequence[Int[np.ndarray, "_ 3"]],
        *,
        inside: float,
        outside: float,
        interior: "Interior | None" = None,
    ):
        """Store what is searched.

        Args:
            points: vertices that may penetrate a part.
            parts: triangles of each part.
            inside: largest depth behind a part's surface at which a vertex is a candidate, in the vertices' unit.
            outside: largest distance in front of it.
            interior: where parts and points belong to one surface, as the lips at the corners of the mouth. There a
                vertex can be behind a part without penetrating it: the part's surface is then the far side of the
                tissue below the vertex.
        """
        self.points = points
        self._parts = [_Patch(part) for part in parts if len(part)]
        self._inside, self._outside, self._interior = inside, outside, interior

    def candidates(self, vertices: Float[np.ndarray, "V 3"], allowed: Float[np.ndarray, "P"]) -> ContactCandidates:
        """Search for the candidates of a mesh: a vertex has one row for every part that is near.

        Args:
            vertices: with the origin deep inside the head.
            allowed: depth of each point up to which it is a candidate without the test against the interior.
        """
        x = vertices[self.points]
        rows = [_rows(self.points, np.empty(0, int), _Patch(), np.empty((0, _CANDIDATES), int))]
        for part in self._parts:
            corners = vertices[part.triangles]
            low, high = corners.min((0, 1)) - self._outside, corners.max((0, 1)) + self._outside
            boxed = np.flatnonzero(((x > low) & (x < high)).all(1))
            row, around = _around(x[boxed], corners, self._inside, self._outside)
            rows.append(_rows(self.points, boxed[row], part, around))
        candidates = ContactCandidates.concatenate(rows)
        depth = depths(torch.as_tensor(vertices), candidates.first(_SELECTING)).depth.numpy()
        near = (depth > -self._outside) & (depth < self._inside)
        deep = np.flatnonzero(near & (depth > allowed[candidates.query.numpy()]))
        if self._interior is not None and len(deep):
            near[deep] = self._interior.contains(vertices, candidates.points.numpy()[deep])
        return candidates.only(torch.as_tensor(near))


class Interior:
    """The volume below a piece of skin, closed by a cone from its boundary to the origin."""

    def __init__(self, triangles: Int[np.ndarray, "F 3"]):
        self._patch = _Patch(triangles)
        self._prepared: tuple[np.ndarray, np.ndarray, Winding] | None = None

    def contains(self, vertices: Float[np.ndarray, "V 3"], points: Int[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
        """Test whether vertices of the skin, moved slightly along their normals, lie inside the volume (mm)."""
        if self._prepared is None or self._prepared[0] is not vertices:  # several searches use one mesh
            self._prepared = (vertices, *self._prepare(vertices))
        _, normals, winding = self._prepared
        return winding.numbers(vertices[points] + _OFFSET_MM * normals[points]) > 0.5

    def _prepare(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "V 3"], Winding]:
        triangles, border = self._patch.triangles, self._patch.border
        cone = np.column_stack([border[:, ::-1], np.full(len(border), len(vertices))])
        closed = np.concatenate([triangles, cone])
        normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles)).numpy()
        return normals, Winding(np.concatenate([vertices, np.zeros((1, 3))]), closed)


class _Patch:
    """Triangles of one surface, its boundary edges, and which corners lie on the boundary."""

    def __init__(self, triangles: Int[np.ndarray, "F 3"] | None = None):
        self.triangles = np.empty((0, 3), int) if triangles is None else triangles
        self.border = np.empty((0, 2), int)
        if len(self.triangles):
            connectivity = edges(self.triangles)
            self.border = connectivity.vertices[connectivity.faces[:, 1] < 0]
        self.rim = np.isin(self.triangles, self.border)


def _rows(points: np.ndarray, query: np.ndarray, patch: _Patch, around: np.ndarray) -> ContactCandidates:
    arrays = {"query": query, "points": points[query], "triangles": patch.triangles[around], "rim": patch.rim[around]}
    return ContactCandidates(**{name: torch.as_tensor(array) for name, array in arrays.items()})


def _around(
    points: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "F 3 3"], inside: float, outside: float
) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M K"]]:
    """The points that may be near enough to a part, and the triangles with the nearest centroids, some repeatedly."""
    if not len(points) or not len(corners):
        return np.empty(0, int), np.empty((0, _CANDIDATES), int)
    centres = corners.mean(1)
    radius = np.linalg.norm(corners - centres[:, None], axis=-1).max()
    distance, index = cKDTree(centres).query(points, k=_CANDIDATES, distance_upper_bound=max(inside, outside) + radius)
    a, b, c = corners[np.minimum(index[:, 0], len(corners) - 1)].transpose(1, 0, 2)
    # Behind the nearest triangle: misses some that are behind another one, which the distance includes soon enough.
    behind = (np.cross(b - a, c - a) * (points - a)).sum(1) < 0
    row = np.flatnonzero((distance[:, 0] < outside + radius) | (behind & np.isfinite(distance[:, 0])))
    return row, np.where(np.isfinite(distance[row]), index[row], index[row, :1])
