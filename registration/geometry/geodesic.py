"""Distances along the edges of a mesh: upper bounds of geodesic distances."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra


def edge_distances(
    vertices: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    sources: Bool[np.ndarray, "V"],
    limit: float = np.inf,
) -> Float[np.ndarray, "V"]:
    """Return each vertex' distance from the nearest source along edges.

    Args:
        vertices: positions; their unit is that of the result.
        edges: vertices of the edges that may be used.
        sources: where the distance is zero.
        limit: of the distances.

    Returns:
        Distances; infinity for vertices that no path within the limit reaches, for all if there is no source.
    """
    if not sources.any():
        return np.full(len(vertices), np.inf)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = csr_matrix((length, (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    return dijkstra(graph, directed=False, indices=np.flatnonzero(sources), min_only=True, limit=limit)
