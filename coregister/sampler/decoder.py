"""The half of a network that draws: latent vectors and conditions into coefficients."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from coregister.sampler.categories import Factor, condition_size

Part = Literal["identity", "expression"]
PARTS: tuple[Part, ...] = ("identity", "expression")


@dataclass(frozen=True, kw_only=True, eq=False)
class Decoder:
    """Dense layers with ReLU after all but the last, and the scale of the coefficients that they return."""

    factors: tuple[Factor, ...]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]  # kernel (inputs, outputs) and bias (outputs)
    offset: Float[np.ndarray, "D"]
    scale: float = 1.0

    @property
    def latent(self) -> int:
        """Return the number of latent dimensions."""
        return len(self.layers[0][0]) - condition_size(self.factors)

    @property
    def coefficients(self) -> int:
        """Return the number of coefficients."""
        return len(self.layers[-1][1])

    def decode(
        self, latent: Float[np.ndarray, "N Z"], conditions: Float[np.ndarray, "N C"]
    ) -> Float[np.ndarray, "N D"]:
        """Return the coefficients of latent vectors under conditions, float32."""
        hidden = np.concatenate([latent, conditions], 1).astype(np.float32)
        for number, (kernel, bias) in enumerate(self.layers, start=1):
            hidden = hidden @ kernel + bias
            if number < len(self.layers):
                hidden = np.maximum(hidden, 0)
        return np.asarray(hidden * np.float32(self.scale) + self.offset, np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampler:
    """Decoders of one or both parts, and what is known of the model that their coefficients belong to."""

    decoders: Mapping[Part, Decoder]
    model: str = ""  # content hash of the head model; empty: unknown
    # Expression category -> how deep its training samples penetrate, mm, as `training_depths_mm` returns it.
    depth_mm: Mapping[str, float] = field(default_factory=dict)  # empty: unknown
    origin: str = ""  # what it is, for people
