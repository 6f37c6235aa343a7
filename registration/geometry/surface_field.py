"""Smooth fields on a surface from values at some of its points: a Gaussian field as the prior [Lindgren 2011].

The field t of one component has the standard deviation s and is correlated over the range r. It is Matérn's of
smoothness one, the solution of (k^2 - Laplace) t = white noise with k = sqrt(8) / r: minus twice its logarithm is

    (|k^2 t - Laplace t|^2, integrated over the surface) / (4 pi k^2 s^2)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from registration.geometry.large_steps import normalised_laplacian, spacing
from registration.geometry.topology import vertex_areas

_ROUNDS = 4  # of weights that leave outliers out
_OUTLIER = 3.0  # standard deviations at which an observation counts a quarter


@dataclass(frozen=True, kw_only=True)
class FieldPrior:
    """What is known of a field before anything is observed."""

    deviation_m: float  # standard deviation of a component
    range_m: float  # distance along the surface at which two places are nearly independent


def expected_field(
    triangles: Int[np.ndarray, "F 3"],
    points: Float[np.ndarray, "V 3"],
    indices: Int[np.ndarray, "L 3"],
    weights: Float[np.ndarray, "L 3"],
    observed: Float[np.ndarray, "L 3"],
    spread_m: Float[np.ndarray, "L"],
    prior: FieldPrior,
) -> Float[np.ndarray, "V 3"]:
    """Return the most probable field at every vertex, given its values at some points.

    What contradicts the others loses its weight by Geman's and McClure's function [Geman 1987].

    Args:
        triangles: of the surface.
        points: its vertices, metres.
        indices: the three vertices whose mean each observed point is; all of the surface.
        weights: theirs.
        observed: the field's values there.
        spread_m: standard deviation of each observation, along each axis.
        prior: of the field.
    """
    if not len(observed):
        return np.zeros_like(points)
    area, size = vertex_areas(points, triangles), spacing(triangles, points)
    kappa2 = 8 / prior.range_m**2
    operator = diags(np.full(len(points), kappa2)) + diags(4 / size**2) @ normalised_laplacian(triangles, len(points))
    factor = splu(operator.tocsc(), permc_spec="MMD_AT_PLUS_A")
    rows = np.repeat(np.arange(len(observed)), 3)
    sampling = coo_matrix((weights.ravel(), (indices.ravel(), rows)), (len(points), len(observed)))
    noise2 = 4 * np.pi * kappa2 * prior.deviation_m**2 / area  # of the white noise at each vertex
    # One column for each observation: its covariance with the white noise. They are few, the vertices many.
    kernels = factor.solve(sampling.toarray(), trans="T") * noise2[:, None]
    covariance = kernels.T @ (kernels / noise2[:, None])
    expected2 = 3 * (np.square(spread_m) + prior.deviation_m**2)  # of the squared length of an observation's residual
    residual = observed
    for _ in range(_ROUNDS):
        trust = 1 / (1 + np.square(residual).sum(1) / expected2 / _OUTLIER**2) ** 2
        share = np.linalg.solve(covariance + np.diag(np.square(spread_m) / trust), observed)
        residual = observed - covariance @ share
    return factor.solve(kernels @ share)
