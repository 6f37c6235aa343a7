"""The conditional variational autoencoders of identities and expressions [GNM, Network Architecuture and Layer
Specifications]."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

LATENT = 64
IDENTITY_LAYERS = (256, 128, 64)  # of the encoder; the decoder's are mirrored
EXPRESSION_LAYERS = (512, 128, 256, 64)


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """Sizes of a network."""

    coefficients: int  # D, of its input and output
    conditions: int  # C, of the condition vector
    layers: tuple[int, ...]  # of the encoder; the decoder's are mirrored
    latent: int = LATENT


class ConditionalVAE(nn.Module):
    """An encoder of coefficients and a decoder of latent vectors, both of which also receive the condition vector.

    All layers have ReLU but the last, which are linear. The encoder's last hidden layer is followed by two linear ones,
    the mean and the logarithm of the variance of the latent vector. The released decoders have the mirrored hidden
    layers, the one of 64 units included, so 64 is not the latent layer itself.
    """

    def __init__(self, architecture: Architecture):
        super().__init__()
        self.architecture = architecture
        sizes = architecture.layers
        self.encoder = _perceptron((architecture.coefficients + architecture.conditions, *sizes))
        self.mean = nn.Linear(sizes[-1], architecture.latent)
        self.log_variance = nn.Linear(sizes[-1], architecture.latent)
        self.decoder = decoder_network(
            (architecture.latent + architecture.conditions, *reversed(sizes), architecture.coefficients)
        )

    def encode(
        self, coefficients: Float[Tensor, "N D"], conditions: Float[Tensor, "N C"]
    ) -> tuple[Float[Tensor, "N Z"], Float[Tensor, "N Z"]]:
        """Return mean and logarithm of the variance of the posterior."""
        hidden = self.encoder(torch.cat([coefficients, conditions], 1))
        return self.mean(hidden), self.log_variance(hidden)

    def decode(self, latent: Float[Tensor, "N Z"], conditions: Float[Tensor, "N C"]) -> Float[Tensor, "N D"]:
        """Return the coefficients of latent vectors."""
        decoded: Tensor = self.decoder(torch.cat([latent, conditions], 1))
        return decoded


def decoder_network(sizes: Sequence[int]) -> nn.Sequential:
    """Return a perceptron with ReLU after all layers but the last; `sizes` are of its input, layers and output."""
    return nn.Sequential(*_perceptron(sizes[:-1]), nn.Linear(sizes[-2], sizes[-1]))


def _perceptron(sizes: Sequence[int]) -> nn.Sequential:
    layers = list[nn.Module]()
    for size, following in zip(sizes, sizes[1:], strict=False):
        layers += [nn.Linear(size, following), nn.ReLU()]
    return nn.Sequential(*layers)
