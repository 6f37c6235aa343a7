"""Deform a predicted head so that it passes through the registered skin, with a smooth band where that ends."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu

from registration.geometry.large_steps import normalised_laplacian, spacing
from registration.geometry.topology import edges, vertex_areas


def smootherstep(t: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Return 6 t^5 - 15 t^4 + 10 t^3, 0 below 0 and 1 above 1: its second derivative is continuous."""
    t = np.clip(t, 0, 1)
    return t**3 * (t * (6 * t - 15) + 10)


def band_weights(
    points: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], hidden: Bool[np.ndarray, "V"], band_m: float
) -> Float[np.ndarray, "V"]:
    """Return 0 at the border of the hidden skin and 1 deeper inside it than `band_m`, along the edges of the mesh.

    Zero off the hidden skin; one on hidden parts that no observed skin borders on.
    """
    a, b = edges(triangles).vertices.T
    length = np.linalg.norm(points[a] - points[b], axis=1)
    graph = coo_matrix((length, (a, b)), shape=2 * (len(points),)).tocsr()
    border = np.unique(np.concatenate([a[~hidden[a] & hidden[b]], b[~hidden[b] & hidden[a]]]))
    if not len(border):
        return hidden.astype(np.float64)
    distance = dijkstra(graph, directed=False, indices=border, min_only=True, limit=band_m)
    return np.where(hidden, smootherstep(distance / band_m), 0.0)


def deform(
    points: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    displacement: Float[np.ndarray, "V 3"],
    weights: Float[np.ndarray, "V"],
    hidden: Bool[np.ndarray, "V"],
    *,
    length_m: float,
) -> Float[np.ndarray, "V 3"]:
    """Continue the displacement of observed skin into hidden skin: min sum a (l^4 |Lap d|^2 + w |d - target|^2).

    The displacement d is that from the predicted head, so that its Laplacian is the difference of the Laplacians
    [Ploumpis 2019]. Observed skin keeps its displacement exactly; at the border d is smooth to first order.

    Args:
        points: positions at which lengths and areas are measured, metres.
        triangles: of the mesh.
        displacement: of observed skin, metres; elsewhere the target, 0 for the predicted head itself.
        weights: w of each vertex in [0, 1] (`band_weights`).
        hidden: the vertices to find.
        length_m: l, over which a step between observed skin and target is spread where w is 1.
    """
    size = spacing(triangles, points)
    area = vertex_areas(points, triangles)
    # For a unit second derivative the normalised Laplacian of a regular triangulation gives h^2 / 4.
    laplacian = diags(np.sqrt(area) * 4 * (length_m / size) ** 2) @ normalised_laplacian(triangles, len(points))
    rows = np.unique(triangles[hidden[triangles].any(1)])  # those of the border too: they make d smooth there
    laplacian = laplacian.tocsr()[rows]
    free, given = np.flatnonzero(hidden), np.flatnonzero(~hidden)
    inside, outside = laplacian[:, free], laplacian[:, given]
    pull = diags(area[free] * weights[free])
    # A weight of nothing would leave parts undetermined that no observed skin borders on.
    system = (inside.T @ inside + pull + 1e-9 * area.mean() * diags(np.ones(len(free)))).tocsc()
    right = pull @ displacement[free] - inside.T @ (outside @ displacement[given])
    result = displacement.copy()
    result[free] = splu(system).solve(np.asarray(right))
    return result
