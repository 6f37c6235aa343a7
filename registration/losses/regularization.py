"""Regularization of free offsets: small, smooth, edges kept. Its weights follow from lengths.

Against data terms that pull every vertex to its target with strength one, the penalty

    a |d|^2 + b |grad d|^2 + c |laplace d|^2

on the offsets d keeps the fraction 1 / (1 + a + b q^2 + c q^4) of a wave of wave number q. At the *half-gain
wavelength* b and c keep one half of it. Where there are no data, an offset decays over the *decay length*
(docs/algorithms.md).
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.geometry.large_steps import normalised_laplacian, spacing, to_torch
from registration.geometry.topology import edges, vertex_areas

_MEMBRANE_FRACTION = 0.2  # of b q^2 in the penalty at the half-gain wavelength; the rest is bending's, c q^4


def regularization_weights(
    half_gain_m: Float[np.ndarray, "V"], decay_m: Float[np.ndarray, "V"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Return the weights a (no unit), b (m^2) and c (m^4) of each vertex.

    Without data a d - b d'' + c d'''' = 0, whose solution exp(-x / l) decays slowest where a = b / l^2 - c / l^4.

    Args:
        half_gain_m: half-gain wavelength.
        decay_m: decay length l; longer than the half-gain wavelength.
    """
    q = 2 * np.pi / half_gain_m
    b, c = _MEMBRANE_FRACTION / q**2, (1 - _MEMBRANE_FRACTION) / q**4
    return b / decay_m**2 - c / decay_m**4, b, c


class OffsetRegularizer:
    """The three penalties of [GNM, Head Registration] on one mesh: L2, edge coupling [FLAME], squared Laplacian.

    In the bind pose the displaced mesh and the model's differ by the offsets alone, so that the change of an edge
    [FLAME] is linear in the offsets. Derivatives are finite differences over each vertex' mean edge length. Vertices
    count by their area, as in images, which show a lid's many small faces no larger than they are.

    Args:
        triangles: of the mesh.
        points: of the template, metres.
        half_gain_m: half-gain wavelength of each vertex.
        decay_m: decay length of each vertex.
        device: of the offsets.
    """

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        points: Float[np.ndarray, "V 3"],
        *,
        half_gain_m: Float[np.ndarray, "V"],
        decay_m: Float[np.ndarray, "V"],
        device: torch.device,
    ):
        self._edges = torch.as_tensor(edges(triangles).vertices, device=device)
        self._laplacian = to_torch(normalised_laplacian(triangles, len(points)), device)
        l2, membrane, bending = regularization_weights(half_gain_m, decay_m)
        size = spacing(triangles, points)
        ends = edges(triangles).vertices
        share = vertex_areas(points, triangles)
        share /= share.sum()

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.astype(np.float32), device=device)

        self._l2 = tensor(share * l2)
        # With six regular neighbours at distance h, half the sum over edges is 1.5 h^2 |grad|^2, and the mean of the
        # neighbours differs from the vertex by h^2 / 4 times the Laplacian.
        self._membrane = tensor((share * membrane / size**2)[ends].mean(1) / 1.5)
        self._bending = tensor(share * bending * (4 / size**2) ** 2)

    def __call__(self, offsets: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, ""]]:
        """Return the penalties "offset l2", "offset coupling" and "offset laplacian": means over the surface, m^2.

        Args:
            offsets: bind pose, metres.
        """
        first, second = (offsets.index_select(0, self._edges[:, k]) for k in range(2))
        return {
            "offset l2": (self._l2 * offsets.square().sum(-1)).sum(),
            "offset coupling": (self._membrane * (first - second).square().sum(-1)).sum(),
            "offset laplacian": (self._bending * (self._laplacian @ offsets).square().sum(-1)).sum(),
        }


def gaussian_prior(coefficients: Float[Tensor, "C"]) -> Float[Tensor, ""]:
    """Return the sum of squared coefficients: twice their negative log likelihood for unit variance, up to a constant.

    A sum and not a mean: a component's variance does not grow with the number of others.
    """
    return coefficients.square().sum()
