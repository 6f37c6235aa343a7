"""The loss of the autoencoders, the schedule of its KL weight, and the mixing of samples [GNM, Training Objectives and
Latent Space Optimization]."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class KLSchedule:
    """Weight of the KL divergence by step: cycles of a linear warm-up and a plateau [Fu 2019].

    Attributes:
        weight: of the plateau.
        warm_up: steps from 0 to it.
        cycle: steps after which it starts again from 0; the last cycle ends with the training.
    """

    weight: float = 0.05
    warm_up: int = 4000
    cycle: int = 8000

    def at(self, step: int) -> float:
        """Return the weight at a step, from 0."""
        return self.weight * min(1.0, (step % self.cycle) / self.warm_up)


def reconstruction(decoded: Float[Tensor, "N D"], coefficients: Float[Tensor, "N D"]) -> Float[Tensor, ""]:
    """Return the L1 distance, summed over coefficients, averaged over samples."""
    return (decoded - coefficients).abs().sum(1).mean()


def divergences(mean: Float[Tensor, "N Z"], log_variance: Float[Tensor, "N Z"]) -> Float[Tensor, "Z"]:
    """Return the KL divergence of the posterior from the standard normal distribution, by latent dimension, in nats."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean(0)


def free_bits(divergence: Float[Tensor, "Z"], free: float) -> Float[Tensor, ""]:
    """Return the sum of divergences, of which the first `free` nats of each dimension cost nothing [Kingma 2016]."""
    return divergence.clamp(min=free).sum()


def mix_up(
    coefficients: Float[Tensor, "N D"],
    conditions: Float[Tensor, "N C"],
    alpha: float,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N C"]]:
    """Mix samples in pairs: coefficients and conditions with one share of Beta(alpha, alpha) [Zhang 2018].

    Samples of one condition are not mixed: their condition would stay pure, and the mean of two of them is nearer to
    the class mean than either, which would shrink the variance within the class.

    Args:
        coefficients: of the samples.
        conditions: of the samples.
        alpha: of the Beta distribution; 0: no mixing.
        generator: source of randomness.
    """
    if alpha <= 0:
        return coefficients, conditions
    count = len(coefficients)
    partner = torch.randperm(count, generator=generator)
    gammas = torch._standard_gamma(torch.full((2, count), alpha, dtype=torch.float64), generator=generator)
    share = (gammas[0] / gammas.sum(0).clamp(min=1e-300)).to(coefficients.dtype)
    same = (conditions == conditions[partner]).all(1)
    share = torch.where(same, torch.ones_like(share), share)[:, None]
    return (
        share * coefficients + (1 - share) * coefficients[partner],
        share * conditions + (1 - share) * conditions[partner],
    )
