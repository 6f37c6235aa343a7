"""What keeps free offsets close to the model: small, smooth, edges kept. Strengths follow from lengths.

Against data that pull every vertex to its place with strength one, the penalty a |d|^2 + b |grad d|^2 + c |laplace d|^2
leaves of a wave of wave number q the share 1 / (1 + a + b q^2 + c q^4). At the *half-gain wavelength* b and c leave one
half of it. Where there are no data an offset decays over the *decay length*.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.geometry.large_steps import normalised_laplacian, spacing, to_torch
from registration.geometry.topology import edges

_MEMBRANE = 0.2  # share of b q^2 in the penalty at the half-gain wavelength; the rest is bending's, c q^4


def strengths(
    half_gain_m: Float[np.ndarray, "V"], decay_m: Float[np.ndarray, "V"]
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """a (no unit), b (m^2) and c (m^4) for a half-gain wavelength and a decay length, which must be the longer one.

    Without data a d - b d'' + c d'''' = 0, whose solution exp(-x / l) decays slowest where a = b / l^2 - c / l^4.
    """
    q = 2 * np.pi / half_gain_m
    b, c = _MEMBRANE / q**2, (1 - _MEMBRANE) / q**4
    return b / decay_m**2 - c / decay_m**4, b, c


class Elasticity:
    """The three penalties of [GNM, Head Registration] on one mesh: L2, edge coupling [FLAME], squared Laplacian.

    In bind space the displaced mesh and the model's share everything but the offsets, so that the change of an edge
    [FLAME] is linear in the offsets. Derivatives are taken at each vertex' own spacing.
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
        l2, membrane, bending = strengths(half_gain_m, decay_m)
        size = spacing(triangles, points)
        ends = edges(triangles).vertices

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.astype(np.float32), device=device)

        self._l2 = tensor(l2)
        # Six regular neighbours at distance h: half the sum over edges is 1.5 h^2 |grad|^2, and the mean of the
        # neighbours lies h^2 / 4 times the Laplacian away.
        self._membrane = tensor((membrane / size**2)[ends].mean(1) / 1.5)
        self._bending = tensor(bending * (4 / size**2) ** 2)

    def __call__(self, offsets: Float[Tensor, "V 3"]) -> dict[str, Tensor]:
        """Each penalty, a mean over the vertices, m^2."""
        first, second = (offsets.index_select(0, self._edges[:, k]) for k in range(2))
        return {
            "offset l2": (self._l2 * offsets.square().sum(-1)).mean(),
            "offset coupling": (self._membrane * (first - second).square().sum(-1)).sum() / len(offsets),
            "offset laplacian": (self._bending * (self._laplacian @ offsets).square().sum(-1)).mean(),
        }


def prior(coefficients: Float[Tensor, "C"]) -> Tensor:
    """Mean square of coefficients of unit variance: their negative log likelihood, scaled."""
    return coefficients.square().mean() if len(coefficients) else torch.zeros((), device=coefficients.device)
