"""Extrapolation of vertex values over a mesh."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from registration.geometry.large_steps import combinatorial_laplacian, spacing


def extrapolate(
    values: Float[np.ndarray, "V C"],
    known: Bool[np.ndarray, "V"],
    triangles: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "V 3"],
    *,
    reach_m: float,
) -> Float[np.ndarray, "V C"]:
    """Continue known values into the rest of a mesh by the screened Laplace equation (L + D / 4 (h / reach)^2) x = 0.

    L is the mesh's Laplacian, D the number and h the mean length of a vertex' edges (for a unit second derivative L
    gives D / 4 h^2 on equilateral triangles). The result is continuous and decays by a factor e over `reach_m`.

    Args:
        values: of the vertices; read where known.
        known: which values are known, and returned unchanged.
        triangles: vertex indices.
        points: vertex positions, metres.
        reach_m: length of the decay.

    Returns:
        The values; zero in connected components without known values.
    """
    result = np.where(known[:, None], values, 0.0)
    unknown = np.flatnonzero(~known)
    if not len(unknown) or not known.any():
        return result
    laplacian = combinatorial_laplacian(triangles, len(points))
    degree = laplacian.diagonal()
    screen = diags(np.maximum(degree, 1) / 4 * (spacing(triangles, points) / reach_m) ** 2)
    rows = laplacian[unknown]
    inner = (rows[:, unknown] + screen.tocsr()[unknown][:, unknown]).tocsc()
    result[unknown] = splu(inner).solve(-(rows @ result))
    return result
