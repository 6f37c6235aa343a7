"""Quad meshes: edges, loops, connected components, and one Catmull-Clark step as a matrix."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components


def triangles_of(quads: Int[np.ndarray, "Q 4"]) -> Int[np.ndarray, "2*Q 3"]:
    """Cut each quad into two triangles: corners (0, 1, 2) in row 2 q, corners (2, 3, 0) in row 2 q + 1."""
    return quads[:, [[0, 1, 2], [2, 3, 0]]].reshape(-1, 3)


def corner_triangles(corners: Float[np.ndarray, "Q 4 D"]) -> Float[np.ndarray, "2*Q 3 D"]:
    """Return values at the corners of quads at the corners of their triangles, in the order of `triangles_of`."""
    return corners[:, [[0, 1, 2], [2, 3, 0]]].reshape(-1, 3, corners.shape[-1])


def edges_of(
    faces: Int[np.ndarray, "F S"],
) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "F S"], Int[np.ndarray, "E"]]:
    """Return the edges of quads or triangles of any mesh, manifold or not.

    Returns:
        Edges (lower vertex first), the edges of each face (edge k joins corners k and k + 1), and faces per edge.
    """
    low, high = np.sort(np.stack([faces, np.roll(faces, -1, 1)]).astype(np.int64), 0)
    size = int(faces.max(initial=0)) + 1
    number, inverse, count = np.unique(low * size + high, return_inverse=True, return_counts=True)  # rows sort slower
    return np.stack(np.divmod(number, size), 1), inverse.reshape(faces.shape), count


def boundary_loops(quads: Int[np.ndarray, "Q 4"]) -> list[Int[np.ndarray, "N"]]:
    """Return the boundaries of a mesh as closed vertex loops, in the direction of the quads' edges."""
    following: dict[int, int] = {}
    _, of_quad, count = edges_of(quads)
    for quad, side in np.argwhere(count[of_quad] == 1):
        following[int(quads[quad, side])] = int(quads[quad, (side + 1) % 4])
    loops = []
    while following:
        first = min(following)
        loop = [first]
        while (vertex := following.pop(loop[-1])) != first:
            loop.append(vertex)
        loops.append(np.array(loop))
    return loops


def edge_loop(quads: Int[np.ndarray, "Q 4"], first: int, second: int) -> Int[np.ndarray, "N"]:
    """Return the closed edge loop that continues an edge through vertices of valence four.

    Args:
        quads: vertex indices.
        first: vertex at which the edge starts.
        second: vertex at its end.

    Returns:
        The vertices of the loop, beginning with these two.

    Raises:
        ValueError: the loop meets a vertex of another valence or a boundary.
    """
    edges, of_quad, _ = edges_of(quads)
    around: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        around.setdefault(a, set()).add(b)
        around.setdefault(b, set()).add(a)
    beside: dict[frozenset[int], set[int]] = {}
    for quad, sides in enumerate(edges[of_quad].tolist()):
        for a, b in sides:
            beside.setdefault(frozenset((a, b)), set()).add(quad)
    loop = [first, second]
    while True:
        last, here = loop[-2:]
        behind = beside[frozenset((last, here))]
        ahead = [v for v in around[here] if v != last and not beside[frozenset((here, v))] & behind]
        if len(around[here]) != 4 or len(ahead) != 1:
            raise ValueError(f"the edge loop from {first} to {second} ends at vertex {here}")
        if ahead[0] == first:
            return np.array(loop)
        loop.append(ahead[0])


def beyond_loop(quads: Int[np.ndarray, "Q 4"], loop: Int[np.ndarray, "N"], inside: int) -> Bool[np.ndarray, "Q"]:
    """Select the quads on that side of a closed edge loop on which the vertex `inside` lies."""
    edges, of_quad, _ = edges_of(quads)
    ends = np.sort(np.stack([loop, np.roll(loop, -1)], 1), 1)
    wanted = set(map(tuple, ends.tolist()))
    wall = np.array([tuple(edge) in wanted for edge in edges.tolist()])
    piece, _ = pieces(of_quad, ~wall)
    return piece == piece[np.argmax((quads == inside).any(1))]


def pieces(of_quad: Int[np.ndarray, "Q 4"], open_edge: Bool[np.ndarray, "E"]) -> tuple[Int[np.ndarray, "Q"], int]:
    """Return the connected component of each quad and the number of components; only open edges connect quads."""
    quad, side = np.nonzero(open_edge[of_quad])
    incidence = sp.csr_matrix((np.ones(len(quad)), (quad, of_quad[quad, side])), (len(of_quad), len(open_edge)))
    number, label = connected_components(incidence @ incidence.T, directed=False)
    return label, int(number)


@dataclass(frozen=True, kw_only=True, eq=False)
class Subdivision:
    """One Catmull-Clark step. V fine vertices: first the B coarse ones, then edge points, then face points."""

    weights: sp.csr_matrix  # (V, B): fine = weights @ coarse; rows sum to one
    linear: sp.csr_matrix  # (V, B): the same vertices without smoothing, for values that must not be averaged
    quads: Int[np.ndarray, "F 4"]  # F = 4 Q, those of a coarse quad one after another
    mirror: Int[np.ndarray, "V"]


def subdivide(quads: Int[np.ndarray, "Q 4"], mirror: Int[np.ndarray, "B"]) -> Subdivision:
    """Subdivide once [Catmull 1978], with smooth boundary curves [DeRose 1998].

    Args:
        quads: vertex indices; each of the B vertices must belong to a quad.
        mirror: the mirrored vertex of each vertex.
    """
    edges, of_quad, count = edges_of(quads)
    B, E, Q = len(mirror), len(edges), len(quads)
    quad_corner = _matrix(np.repeat(np.arange(Q), 4), quads.ravel(), 0.25, (Q, B))
    edge_end = _matrix(np.repeat(np.arange(E), 2), edges.ravel(), 0.5, (E, B))
    edge_quad = _matrix(of_quad.ravel(), np.repeat(np.arange(Q), 4), 0.5, (E, Q))
    rim = count == 1
    inner = sp.diags((~rim).astype(float))
    edge_point = sp.diags(rim.astype(float)) @ edge_end + inner @ (0.5 * edge_end + 0.5 * edge_quad @ quad_corner)
    vertex_point = _vertex_points(edges, rim, quads, quad_corner, edge_end, B)
    fine = np.stack(
        [quads, B + of_quad, np.broadcast_to(B + E + np.arange(Q)[:, None], (Q, 4)), B + np.roll(of_quad, 1, 1)], -1
    )
    return Subdivision(
        weights=sp.vstack([vertex_point, edge_point, quad_corner]).tocsr(),
        linear=sp.vstack([sp.identity(B), edge_end, quad_corner]).tocsr(),
        quads=fine.reshape(-1, 4),
        mirror=np.concatenate([mirror, B + _mirrored(edges, mirror), B + E + _mirrored(quads, mirror)]),
    )


def _vertex_points(
    edges: np.ndarray, rim: np.ndarray, quads: np.ndarray, quad_corner: sp.csr_matrix, edge_end: sp.csr_matrix, B: int
) -> sp.csr_matrix:
    """(F + 2 R + (n - 3) P) / n inside, (R + P) / 2 on the rim, where R is the mean of the edges' middles."""
    to_edge = _matrix(edges.ravel(), np.repeat(np.arange(len(edges)), 2), 1.0, (B, len(edges)))
    to_quad = _matrix(quads.ravel(), np.repeat(np.arange(len(quads)), 4), 1.0, (B, len(quads)))
    valence = np.asarray(to_edge.sum(1)).ravel()
    n = np.maximum(valence, 1)
    inside = (
        sp.diags(1 / n**2) @ to_quad @ quad_corner + sp.diags(2 / n**2) @ to_edge @ edge_end + sp.diags((n - 3) / n)
    )
    to_rim = to_edge @ sp.diags(rim.astype(float))
    on_rim = np.asarray(to_rim.sum(1)).ravel() > 0
    curve = 0.25 * to_rim @ edge_end + 0.5 * sp.identity(B)
    return (sp.diags((~on_rim).astype(float)) @ inside + sp.diags(on_rim.astype(float)) @ curve).tocsr()


def _matrix(rows: np.ndarray, columns: np.ndarray, value: float, shape: tuple[int, int]) -> sp.csr_matrix:
    return sp.csr_matrix((np.full(len(rows), value), (rows, columns)), shape)


def _mirrored(tuples: Int[np.ndarray, "N K"], mirror: Int[np.ndarray, "B"]) -> Int[np.ndarray, "N"]:
    """Of each vertex tuple (an edge, a quad), the row of the tuple of the mirrored vertices."""
    row_of = {tuple(sorted(row)): number for number, row in enumerate(tuples.tolist())}
    return np.array([row_of[tuple(sorted(row))] for row in mirror[tuples].tolist()])
