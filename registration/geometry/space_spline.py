"""Smooth displacements of space: splines |r|^3 [Carr 2001], the smoothest fields through given values in three
dimensions. Affine displacements cost nothing."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist

_JITTER = 1e-9  # of the mean diagonal: centres may lie on one another
# The kernel's transform on a plane, times k^5: 2^5 pi Gamma(5/2) / |Gamma(-3/2)|.
_TRANSFORM = 56.5


@dataclass(frozen=True, kw_only=True, eq=False)
class SpaceSpline:
    """Fields at P points, columns of `values`: four that are affine, then those whose squared coefficients sum to the
    energy."""

    values: Float[np.ndarray, "P K"]
    energy: Float[np.ndarray, "K"]  # of each field, for a length of 1 m; the first four are 0

    @classmethod
    def of(cls, points: Float[np.ndarray, "P 3"], count: int) -> "SpaceSpline":
        """Make the fields of `count` centres, spread over the points; fewer where there are fewer points.

        Args:
            points: metres.
            count: more than four.

        Returns:
            The fields. With the data's squared distances integrated over a surface, m^4, energies times length^5 leave
            out what varies over less than `length`, m.
        """
        centres = points[_spread(points, min(count, len(points)))]
        middle = centres.mean(0)
        affine = np.column_stack([np.ones(len(centres)), centres - middle])
        # Weights of the centres that are orthogonal to affine fields: there the kernel is positive definite.
        free = np.linalg.qr(affine, mode="complete")[0][:, 4:]
        kernel = free.T @ cdist(centres, centres) ** 3 @ free
        lower = cholesky(kernel + _JITTER * np.trace(kernel) / len(kernel) * np.eye(len(kernel)), lower=True)
        fields = cdist(points, centres) ** 3 @ solve_triangular(lower, free.T, lower=True).T
        values = np.column_stack([np.ones(len(points)), points - middle, fields])
        return cls(values=values, energy=np.r_[np.zeros(4), np.full(fields.shape[1], _TRANSFORM)])


def _spread(points: Float[np.ndarray, "P 3"], count: int) -> Int[np.ndarray, "K"]:
    """Farthest-point sampling from the first point on."""
    chosen, distance = [0], np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.square(points - points[chosen[-1]]).sum(1))
        chosen.append(int(distance.argmax()))
    return np.array(chosen)
