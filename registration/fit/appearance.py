"""The subject's texture and the cameras' gains, estimated in closed form between the steps of a fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.render.renderer import Renderer
from registration.types import Rendered, Targets

_GREY = 0.25  # linear; what a texel shows before any view has been unwrapped to it
_STEP = 0.5  # share of a texel's error that one update takes away
_LEAST_DENSITY = 1e-3
# Priors of a camera's gain and bias, against pixel noise over 100 independent patches (docs/algorithms.md).
_GAIN_SIGMA, _BIAS_SIGMA, _NOISE = 0.1, 0.02, 0.05 / np.sqrt(100)


class Appearance:
    """A texture of `size_px`, and a gain and a bias per view and channel; all linear light."""

    def __init__(self, renderer: Renderer, size_px: int, views: int, device: torch.device):
        self._renderer = renderer
        self.texture: Float[Tensor, "R R 3"] = torch.full((size_px, size_px, 3), _GREY, device=device)
        self.known = False  # whether any view has been seen in the texture
        self._exposures = torch.zeros(views, 3, 2, device=device)  # log gain and bias

    @property
    def gains(self) -> Float[Tensor, "N 3"]:
        return self._exposures[..., 0].exp()

    def begin(self, texture: Float[np.ndarray, "R R 3"]) -> None:
        """Set a texture that is known."""
        self.texture, self.known = torch.as_tensor(texture, device=self.texture.device), True

    def expose(self, rendered: Rendered, batch: Targets, views: Sequence[int]) -> Rendered:
        """The rendered colours as each camera would record them."""
        gain, bias = self._exposure(batch, views)
        return replace(rendered, rgb=rendered.rgb * gain + bias)

    def corrected(self, batch: Targets, views: Sequence[int]) -> Float[Tensor, "P 3"]:
        """The seen colours as a camera of gain one would record them."""
        gain, bias = self._exposure(batch, views)
        return (batch.rgb - bias) / gain

    def _exposure(self, batch: Targets, views: Sequence[int]) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """Gain and bias of every pixel's camera."""
        exposures = self._exposures[list(views)].index_select(0, batch.pixels.view.long())
        return exposures[..., 0].exp(), exposures[..., 1]

    @torch.no_grad()
    def fit_exposures(self, rendered: Rendered, batch: Targets, agree: Tensor, views: Sequence[int]) -> None:
        """Per view and channel the gain and bias that map rendered to seen colours best."""
        weight = (batch.rgb_weight * agree)[:, None]
        view = batch.pixels.view.long()

        def total(value: Tensor) -> Tensor:
            return value.new_zeros(len(views), value.shape[1]).index_add(0, view, value)

        count = total(weight).clamp_min(1e-6)
        r, t = (total(c * weight) / count for c in (rendered.rgb, batch.rgb))
        variance = total(rendered.rgb.square() * weight) / count - r.square()
        covariance = total(rendered.rgb * batch.rgb * weight) / count - r * t
        gain_prior, bias_prior = (_NOISE / _GAIN_SIGMA) ** 2, (_NOISE / _BIAS_SIGMA) ** 2
        shrink = bias_prior / (1 + bias_prior)
        gain = (covariance + shrink * r * t + gain_prior) / (variance + shrink * r.square() + gain_prior)
        bias = (t - gain * r) / (1 + bias_prior)
        self._exposures[list(views)] = torch.stack([gain.clamp(0.3, 3.0).log(), bias], -1)
        # One common gain belongs to the texture.
        self._exposures[..., 0] -= self._exposures[..., 0].mean(0)

    @torch.no_grad()
    def improve(
        self, vertices: Float[Tensor, "V 3"], rendered: Rendered, batch: Targets, agree: Tensor, views: Sequence[int]
    ) -> None:
        """Move every texel half way to what the views of this step saw of it."""
        weight = batch.rgb_weight.square() * agree
        change = self.corrected(batch, views) - rendered.rgb
        total, density = self._renderer.unwrap(vertices, change, weight, batch.pixels, len(self.texture))
        step = torch.where(density > _LEAST_DENSITY, _STEP / density.clamp_min(_LEAST_DENSITY), 0.0)
        self.texture = (self.texture + step[..., None] * total).clamp(0, 1)

    @torch.no_grad()
    def unwrap(self, vertices: Float[Tensor, "V 3"], batches: Sequence[tuple[Targets, Tensor]]) -> None:
        """A first texture: the weighted mean of all views, given as batches and where they agree with the mesh."""
        size = len(self.texture)
        total, density = torch.zeros_like(self.texture), torch.zeros_like(self.texture[..., 0])
        for batch, agree in batches:
            weight = batch.rgb_weight.square() * agree
            t, d = self._renderer.unwrap(vertices, batch.rgb, weight, batch.pixels, size)
            total, density = total + t, density + d
        seen = density > _LEAST_DENSITY
        mean = total / density.clamp_min(_LEAST_DENSITY)[..., None]
        fill = mean[seen].mean(0) if seen.any() else torch.full_like(mean[0, 0], _GREY)
        self.texture, self.known = torch.where(seen[..., None], mean, fill), True
