"""Parameterization of quad meshes (texture coordinates) without flipped faces."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from registration.geometry.quads import boundary_loops, triangles_of


def flat_map(
    vertices: Float[np.ndarray, "V 3"],
    quads: Int[np.ndarray, "Q 4"],
    rim: Int[np.ndarray, "N"],
    rim_uv: Float[np.ndarray, "N 2"],
    rounds: int = 8,
) -> Float[np.ndarray, "V 2"]:
    """Map a disc onto a convex outline without flips [Tutte 1963].

    The weights are updated to equalize the stretch [Yoshizawa 2004]; positive weights keep every face upright.

    Args:
        vertices: in any unit.
        quads: vertex indices.
        rim: vertices of the outer boundary. Other boundaries are holes, each spanned by a temporary vertex.
        rim_uv: where these are mapped to: a convex polygon.
        rounds: largest number of updates of the weights.

    Returns:
        Map coordinates of all vertices.
    """
    holes = [loop for loop in boundary_loops(quads) if not np.isin(loop, rim).any()]
    triangles = triangles_of(quads)
    # Both diagonals: the map of a symmetric mesh stays symmetric.
    triangles = np.concatenate([triangles, quads[:, [[1, 2, 3], [3, 0, 1]]].reshape(-1, 3)])
    points = np.concatenate([vertices, [vertices[loop].mean(0) for loop in holes]]) if holes else vertices
    for number, loop in enumerate(holes):
        spanned = np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(vertices) + number)], 1)
        triangles = np.concatenate([triangles, spanned])
    sides = np.concatenate([triangles[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    pairs = np.unique(sides[sides[:, 0] != sides[:, 1]], axis=0)
    fixed = np.zeros(len(points), bool)
    fixed[rim] = True
    fixed_uv = np.zeros((len(points), 2))
    fixed_uv[rim] = rim_uv
    weight = 1 / np.maximum(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1), 1e-6)
    used = np.unique(triangles)
    best, best_cost = fixed_uv, np.inf
    for _ in range(rounds):
        uv = _harmonic(pairs, weight, fixed, fixed_uv, used)
        stretch, cost = _stretch(points, uv, triangles)
        if cost >= best_cost:
            break
        best, best_cost = uv, cost
        weight = weight / stretch[pairs[:, 1]]
    return best[: len(vertices)]


def _harmonic(
    pairs: np.ndarray, weight: np.ndarray, fixed: np.ndarray, fixed_uv: np.ndarray, used: np.ndarray
) -> Float[np.ndarray, "V 2"]:
    """Solve for the map in which each free vertex is at the weighted mean of its neighbours."""
    n = len(fixed)
    W = sp.csr_matrix((weight, (pairs[:, 0], pairs[:, 1])), (n, n))
    A = sp.diags(np.asarray(W.sum(1)).ravel()) - W
    free = used[~fixed[used]]
    uv = fixed_uv.copy()
    uv[free] = splu(A[free][:, free].tocsc()).solve(-(A[free] @ fixed_uv))
    return uv


def _stretch(points: np.ndarray, uv: np.ndarray, triangles: np.ndarray) -> tuple[Float[np.ndarray, "V"], float]:
    """Mean L2 stretch of each vertex from the map to the surface, relative, and the sum over the mesh [Sander 2001]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    u, v, w = (uv[triangles[:, k]] for k in range(3))
    double = (v[:, 0] - u[:, 0]) * (w[:, 1] - u[:, 1]) - (w[:, 0] - u[:, 0]) * (v[:, 1] - u[:, 1])
    double = np.where(np.abs(double) < 1e-14, 1e-14, double)
    ds = (
        a * (v[:, 1] - w[:, 1])[:, None] + b * (w[:, 1] - u[:, 1])[:, None] + c * (u[:, 1] - v[:, 1])[:, None]
    ) / double[:, None]
    dt = (
        a * (w[:, 0] - v[:, 0])[:, None] + b * (u[:, 0] - w[:, 0])[:, None] + c * (v[:, 0] - u[:, 0])[:, None]
    ) / double[:, None]
    square = ((ds**2).sum(1) + (dt**2).sum(1)) / 2
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    total, weight = np.zeros(len(points)), np.full(len(points), 1e-12)
    np.add.at(total, triangles, (square * area)[:, None])
    np.add.at(weight, triangles, area[:, None])
    stretch = np.sqrt(np.maximum(total / weight, 1e-12))
    return stretch / np.sqrt((square * area).sum() / area.sum()), float((square * area).sum())
