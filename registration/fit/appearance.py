"""The subject's texture and the cameras' gains, estimated in closed form between the steps of a fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.render.renderer import Renderer
from registration.types import Rendered, Targets

_GREY = 0.25  # linear; of a texel that no view shows
_STEP = 0.5  # fraction of a texel's error that one update removes
_MIN_DENSITY = 1e-3  # of weighted samples on a texel, for its colour to be estimated
# Priors of a camera's gain and bias, against pixel noise over 100 independent patches (docs/algorithms.md).
_GAIN_SIGMA, _BIAS_SIGMA, _NOISE = 0.1, 0.02, 0.05 / np.sqrt(100)


class Appearance:
    """The subject's texture, and a gain and a bias per view and channel; all in linear light.

    Args:
        renderer: of the mesh; maps pixels to texels.
        size_px: width and height of the texture.
        views: how many.
        device: of the tensors.
    """

    def __init__(self, renderer: Renderer, size_px: int, views: int, device: torch.device):
        self._renderer = renderer
        self.texture: Float[Tensor, "R R 3"] = torch.full((size_px, size_px, 3), _GREY, device=device)
        self.has_texture = False  # whether it was estimated or set
        self._exposures = torch.zeros(views, 3, 2, device=device)  # log gain and bias

    @property
    def gains(self) -> Float[Tensor, "N 3"]:
        """The factor of each view's linear colours."""
        return self._exposures[..., 0].exp()

    def set_texture(self, texture: Float[np.ndarray, "R R 3"]) -> None:
        """Set a texture that was estimated before (linear)."""
        self.texture, self.has_texture = torch.as_tensor(texture, device=self.texture.device), True

    def apply_exposure(self, rendered: Rendered, batch: Targets, views: Sequence[int]) -> Rendered:
        """Return the rendering with colours as each camera records them: gain times colour plus bias."""
        rows = zip(batch.pixels.rows_by_view, *self._exposure(views), strict=True)
        return replace(rendered, rgb=torch.cat([rendered.rgb[r] * gain + bias for r, gain, bias in rows]))

    def corrected(self, batch: Targets, views: Sequence[int]) -> Float[Tensor, "P 3"]:
        """Return the targets' colours as a camera of gain 1 and bias 0 would record them."""
        rows = zip(batch.pixels.rows_by_view, *self._exposure(views), strict=True)
        return torch.cat([(batch.rgb[r] - bias) / gain for r, gain, bias in rows])

    def _exposure(self, views: Sequence[int]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Gain and bias of some views' cameras."""
        gain, bias = self._exposures[list(views)].unbind(-1)
        return gain.exp(), bias

    @torch.no_grad()
    def fit_exposures(self, rendered: Rendered, batch: Targets, agree: Bool[Tensor, "P"], views: Sequence[int]) -> None:
        """Estimate gains and biases in closed form: weighted least squares with Gaussian priors, per view and channel.

        Args:
            rendered: the mesh with the texture, without exposure.
            batch: the targets of some views.
            agree: pixels where both show the same kind of surface.
            views: the indices of these views.
        """
        weight = batch.rgb_weight * agree
        sums = [_moments(weight[rows], rendered.rgb[rows], batch.rgb[rows]) for rows in batch.pixels.rows_by_view]
        count, *moments = (torch.stack(values) for values in zip(*sums, strict=True))
        count = count.clamp_min(1e-6)[:, None]
        r, t, square, product = (moment / count for moment in moments)
        variance, covariance = square - r.square(), product - r * t
        gain_prior, bias_prior = (_NOISE / _GAIN_SIGMA) ** 2, (_NOISE / _BIAS_SIGMA) ** 2
        shrink = bias_prior / (1 + bias_prior)
        gain = (covariance + shrink * r * t + gain_prior) / (variance + shrink * r.square() + gain_prior)
        bias = (t - gain * r) / (1 + bias_prior)
        self._exposures[list(views)] = torch.stack([gain.clamp(0.3, 3.0).log(), bias], -1)
        # A gain that all views share is part of the texture.
        self._exposures[..., 0] -= self._exposures[..., 0].mean(0)

    @torch.no_grad()
    def update_texture(
        self,
        vertices: Float[Tensor, "V 3"],
        rendered: Rendered,
        batch: Targets,
        agree: Bool[Tensor, "P"],
        views: Sequence[int],
    ) -> None:
        """Move every texel half way to the mean colour that the views of this step show of it.

        Args:
            vertices: world, metres.
            rendered: the mesh with the texture, without exposure.
            batch: the targets of some views.
            agree: pixels where both show the same kind of surface.
            views: the indices of these views.
        """
        weight = batch.rgb_weight.square() * agree
        change = self.corrected(batch, views) - rendered.rgb
        total, density = self._renderer.unwrap(vertices, change, weight, batch.pixels, len(self.texture))
        step = torch.where(density > _MIN_DENSITY, _STEP / density.clamp_min(_MIN_DENSITY), 0.0)
        self.texture = (self.texture + step[..., None] * total).clamp(0, 1)

    @torch.no_grad()
    def unwrap_views(self, vertices: Float[Tensor, "V 3"], batches: Sequence[tuple[Targets, Tensor]]) -> None:
        """Set the texture to the weighted mean of the views' colours; texels that no view shows get the mean colour.

        Args:
            vertices: world, metres.
            batches: targets of some views, and the pixels where they agree with the mesh.
        """
        size = len(self.texture)
        total, density = torch.zeros_like(self.texture), torch.zeros_like(self.texture[..., 0])
        for batch, agree in batches:
            weight = batch.rgb_weight.square() * agree
            batch_total, batch_density = self._renderer.unwrap(vertices, batch.rgb, weight, batch.pixels, size)
            total, density = total + batch_total, density + batch_density
        visible = density > _MIN_DENSITY
        mean = total / density.clamp_min(_MIN_DENSITY)[..., None]
        fill = mean[visible].mean(0) if visible.any() else torch.full_like(mean[0, 0], _GREY)
        self.texture, self.has_texture = torch.where(visible[..., None], mean, fill), True


def _moments(
    weight: Float[Tensor, "P"], r: Float[Tensor, "P 3"], t: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Sums of w, w r, w t, w r^2 and w r t."""
    weighted = weight[:, None] * r
    return weight.sum(), weighted.sum(0), weight @ t, (weighted * r).sum(0), (weighted * t).sum(0)
