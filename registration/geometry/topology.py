"""Connectivity of a triangle mesh: edges, their faces, connected parts, vertex normals."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from registration.errors import InputError

LEAST_AREA = 1e-12  # m^2, twice a triangle's; below it a triangle has no normal


@dataclass(frozen=True, kw_only=True)
class Edges:
    """The unique edges of a triangle mesh. A boundary edge has face -1 and corners -1 on its second side."""

    vertices: Int[np.ndarray, "E 2"]  # ordered as the first face runs along the edge
    faces: Int[np.ndarray, "E 2"]
    corners: Int[np.ndarray, "E 2 2"]  # [side, end]: 3 * face + corner of that end, in the order of `vertices`


def edges(triangles: Int[np.ndarray, "F 3"]) -> Edges:
    """Return the unique edges with their one or two faces.

    Raises:
        InputError: an edge has more than two faces (the mesh is not a manifold).
    """
    count = len(triangles)
    start = np.concatenate([triangles[:, k] for k in range(3)]).astype(np.int64)
    end = np.concatenate([triangles[:, (k + 1) % 3] for k in range(3)]).astype(np.int64)
    face = np.tile(np.arange(count), 3)
    corner = np.repeat(np.arange(3), count)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((face, high, low))
    low, high, start, end, face, corner = (a[order] for a in (low, high, start, end, face, corner))
    first = np.flatnonzero(np.r_[True, (low[1:] != low[:-1]) | (high[1:] != high[:-1])])
    faces_per_edge = np.diff(np.r_[first, len(low)])
    if faces_per_edge.max() > 2:
        bad = first[faces_per_edge.argmax()]
        raise InputError(
            "The mesh is not a manifold",
            where=f"edge between vertices {low[bad]} and {high[bad]}",
            expected="at most two triangles at an edge",
            got=f"{faces_per_edge.max()} triangles",
            fix="remove the duplicate or inner triangles",
        )
    two = faces_per_edge == 2
    second = np.where(two, first + 1, first)
    near = 3 * face + corner
    far = 3 * face + (corner + 1) % 3
    # The second face normally traverses the edge in the opposite direction; a flipped neighbour does not.
    same_way = start[second] == start[first]
    corners = np.stack(
        [
            np.stack([near[first], far[first]], 1),
            np.stack([np.where(same_way, near[second], far[second]), np.where(same_way, far[second], near[second])], 1),
        ],
        1,
    )
    corners[~two, 1] = -1
    return Edges(
        vertices=np.stack([start[first], end[first]], 1),
        faces=np.stack([face[first], np.where(two, face[second], -1)], 1),
        corners=corners,
    )


def directed_edges_used_twice(triangles: Int[np.ndarray, "F 3"]) -> int:
    """Count the edges along which two triangles run in the same direction: their windings disagree."""
    start, end = triangles.T.astype(np.int64), np.roll(triangles, -1, 1).T.astype(np.int64)
    keys = np.sort((start * (triangles.max(initial=0) + 1) + end).ravel())
    return int((np.diff(keys) == 0).sum())


def boundary_vertices(triangles: Int[np.ndarray, "F 3"], count: int) -> Bool[np.ndarray, "V"]:
    """Return which of `count` vertices lie on an edge that only one triangle has. Non-manifold meshes are accepted."""
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, 1).ravel().astype(np.int64)
    keys = np.minimum(start, end) * count + np.maximum(start, end)
    single, uses = np.unique(keys, return_counts=True)
    found = np.zeros(count, bool)
    found[np.concatenate(np.divmod(single[uses == 1], count))] = True
    return found


def grown(triangles: Int[np.ndarray, "F 3"], members: Bool[np.ndarray, "V"], rings: int) -> Bool[np.ndarray, "V"]:
    """Return the members with so many rings of vertices around them."""
    for _ in range(rings):
        members = members.copy()
        members[triangles[members[triangles].any(1)]] = True
    return members


def connected_parts(triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F"]:
    """Return for each triangle the number of its connected component; triangles are connected by common vertices."""
    count = int(triangles.max()) + 1
    start, end = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(start)), (start, end)), (count, count))
    return connected_components(graph, directed=False)[1][triangles[:, 0]]


def vertex_normals(vertices: Float[Tensor, "V 3"], triangles: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Compute unit vertex normals, the mean of the adjacent faces' normals weighted by their angles at the vertex.

    With these weights a normal does not depend on how quads are cut into triangles [Thürmer 1998]. Differentiable. Zero
    at vertices without adjacent area.
    """
    # Not vertices[...]: the adjoint of that sums in parallel, differently from run to run.
    corners = [vertices.index_select(0, triangles[:, k]) for k in range(3)]
    a, b, c = corners
    area = torch.linalg.cross(b - a, c - a)
    squared = area.square().sum(-1)
    solid = squared > LEAST_AREA**2
    size = torch.where(solid, squared, 1.0).sqrt()
    unit = area / size[:, None] * solid[:, None]
    weighted = []
    for k in range(3):
        p, q, r = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        weighted.append(unit * torch.atan2(size, ((q - p) * (r - p)).sum(-1))[:, None])
    total = torch.zeros_like(vertices).index_add(0, triangles.T.reshape(-1), torch.cat(weighted))
    return total / total.norm(dim=-1, keepdim=True).clamp_min(1e-20)


def vertex_areas(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V"]:
    """Compute a third of the area of the triangles at each vertex; the sum is the area of the mesh."""
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.bincount(triangles.ravel(), np.repeat(area / 3, 3), len(vertices))
