"""What keeps free offsets close to the model: small, smooth, edges kept. All are means over the free vertices."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


def l2(offsets: Float[Tensor, "V 3"]) -> Tensor:
    """Mean squared length (m^2)."""
    return offsets.square().sum(-1).mean()


def laplacian(offsets: Float[Tensor, "V 3"], operator: Tensor) -> Tensor:
    """Mean squared length of the graph Laplacian of the offsets (m^2); `operator` is (V, V) sparse."""
    return (operator @ offsets).square().sum(-1).mean()


@dataclass(frozen=True, kw_only=True)
class EdgeCoupling:
    """Edges of the displaced mesh against edges of the model's (FLAME 2017): linear in the offsets.

    In bind space both meshes share everything but the offsets, so an edge's change is d_i - d_j.
    """

    edges: Int[Tensor, "E 2"]
    weights: Float[Tensor, "E"]

    def __call__(self, offsets: Float[Tensor, "V 3"]) -> Tensor:
        change = (
            (offsets.index_select(0, self.edges[:, 0]) - offsets.index_select(0, self.edges[:, 1])).square().sum(-1)
        )
        return (change * self.weights).sum() / len(offsets)


def prior(coefficients: Float[Tensor, "C"]) -> Tensor:
    """Mean square of coefficients of unit variance: their negative log likelihood, scaled."""
    return coefficients.square().mean() if len(coefficients) else torch.zeros((), device=coefficients.device)
