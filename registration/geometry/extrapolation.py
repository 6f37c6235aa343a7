"""Values over a mesh continued from where they are known into where they are not."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from registration.geometry.large_steps import combinatorial_laplacian, spacing


def continued(
    values: Float[np.ndarray, "V C"],
    known: Bool[np.ndarray, "V"],
    triangles: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "V 3"],
    *,
    reach_m: float,
) -> Float[np.ndarray, "V C"]:
    """The known values, and from their border on what solves (L + D / 4 (h / reach)^2) x = 0.

    The screened Laplace equation, discretely: L is the mesh's Laplacian, D the number and h the mean length of a
    vertex' edges (L makes D / 4 h^2 of a unit second derivative on equilateral triangles). There is no jump at the
    border, and values fall by a factor e over `reach_m`. Parts of the mesh where nothing is known get zero.
    """
    result = np.where(known[:, None], values, 0.0)
    open_ = np.flatnonzero(~known)
    if not len(open_) or not known.any():
        return result
    laplacian = combinatorial_laplacian(triangles, len(points))
    degree = laplacian.diagonal()
    screen = diags(np.maximum(degree, 1) / 4 * (spacing(triangles, points) / reach_m) ** 2)
    rows = laplacian[open_]
    inner = (rows[:, open_] + screen.tocsr()[open_][:, open_]).tocsc()
    result[open_] = splu(inner).solve(-(rows @ result))
    return result
