"""Parts of a mesh taken as convex: how deep points lie inside them, and behind which facet.

A part may be open, as a tooth is towards its root and a slice of a tongue at both ends. Facets of its hull that span
such an opening are *caps*: a point must be behind all of them to be inside, but no way out leads through them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull
from torch import Tensor

from registration.geometry.topology import edges

# A sliver's normal is rounding noise, and its neighbours say where the surface is. Of the part's own size.
_LEAST_HEIGHT = 5e-3


@dataclass(frozen=True, kw_only=True)
class _Part:
    vertices: Int[np.ndarray, "P"]
    loop: Int[np.ndarray, "P"]  # number of the boundary loop that a vertex lies on; -1 for none


class ConvexParts:
    """Convex hulls of parts of a mesh, found anew for every shape of it. H parts of at most K facets."""

    facets: Int[Tensor, "H K 3"]  # vertices of the mesh, counter-clockwise from outside; short rows repeat a facet
    caps: Bool[Tensor, "H K"]

    def __init__(self, parts: Sequence[Int[np.ndarray, "_ 3"]], device: torch.device):
        """`parts`: the triangles of each part, which need not share vertices with others; none may be flat."""
        self._parts = [_part(triangles) for triangles in parts]
        self._device = device

    def __len__(self) -> int:
        return len(self._parts)

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        """Find the facets of all hulls. Raises scipy's QhullError for a part that has become flat."""
        found = [_facets(part, vertices) for part in self._parts]
        size = max(len(facets) for facets, _ in found)
        facets = np.stack([np.resize(f, (size, 3)) for f, _ in found])
        caps = np.stack([np.resize(c, size) for _, c in found])
        self.facets = torch.as_tensor(facets, device=self._device)
        self.caps = torch.as_tensor(caps, device=self._device)

    @torch.no_grad()
    def candidates(
        self, vertices: Float[Tensor, "V 3"], points: Int[Tensor, "P"], reach: float
    ) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
        """Pairs of a place in `points`, which are vertices of the mesh, and a part that it is in or closer to."""
        corners = vertices[self.facets.flatten(1)]
        low, high = corners.amin(1) - reach, corners.amax(1) + reach
        x = vertices[points][:, None]
        place, part = ((x > low) & (x < high)).all(-1).nonzero(as_tuple=True)
        close = (self._behind(vertices, points[place], part) > -reach).all(1)
        return place[close], part[close]

    @torch.no_grad()
    def deepest(
        self, vertices: Float[Tensor, "V 3"], points: Int[Tensor, "M"], parts: Int[Tensor, "M"]
    ) -> tuple[Float[Tensor, "M"], Int[Tensor, "M 3"]]:
        """Depth of each point in its part, and the facet that is the shortest way out.

        Depth is the distance to the nearest facet that is no cap, exact inside a convex body; outside it is -inf.
        """
        behind, caps = self._behind(vertices, points, parts), self.caps[parts]
        inside = (behind >= 0).all(1)
        depth, nearest = behind.masked_fill(caps, torch.inf).min(1)
        return torch.where(inside, depth, -torch.inf), self.facets[parts, nearest]

    def _behind(self, vertices: Tensor, points: Tensor, parts: Tensor) -> Float[Tensor, "M K"]:
        """How far each point is behind each facet of its part."""
        a, b, c = vertices[self.facets].unbind(2)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        planes = torch.cat([normal, -(normal * a).sum(-1, keepdim=True)], -1)
        x = torch.nn.functional.pad(vertices[points], (0, 1), value=1.0)
        return -(planes[parts] @ x[:, :, None])[..., 0]


def _part(triangles: Int[np.ndarray, "F 3"]) -> _Part:
    vertices, local = np.unique(triangles, return_inverse=True)
    found = edges(local.reshape(-1, 3))
    rim = found.vertices[found.faces[:, 1] < 0]
    graph = coo_matrix((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), (len(vertices), len(vertices)))
    loop = np.full(len(vertices), -1)
    on_rim = np.unique(rim)
    loop[on_rim] = connected_components(graph, directed=False)[1][on_rim]
    return _Part(vertices=vertices, loop=loop)


def _facets(part: _Part, vertices: np.ndarray) -> tuple[Int[np.ndarray, "K 3"], Bool[np.ndarray, "K"]]:
    """Facets of one hull and which of them are caps."""
    points = vertices[part.vertices].astype(np.float64)
    hull = ConvexHull(points)
    facets = hull.simplices.astype(np.int64)
    a, b, c = points[facets].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    inward = (normal * hull.equations[:, :3]).sum(1) < 0
    facets[inward] = facets[inward][:, [0, 2, 1]]
    longest = np.sqrt(np.max([((p - q) ** 2).sum(1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    sound = np.linalg.norm(normal, axis=1) > _LEAST_HEIGHT * np.ptp(points, axis=0).max() * longest
    facets = facets[sound]
    loop = part.loop[facets]
    caps = (loop[:, 0] >= 0) & (loop == loop[:, :1]).all(1)
    return part.vertices[facets], caps
