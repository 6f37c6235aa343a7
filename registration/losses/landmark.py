"""Landmark loss: the model's projected points against points detected in the images."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.types import Camera

_MIN_CONFIDENCE = 0.5


def project(cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"]) -> Float[Tensor, "N L 2"]:
    """Return world points (metres) in the pixels of every camera; differentiable, without distortion."""

    def stack(values: list[np.ndarray]) -> Tensor:
        return torch.stack([torch.as_tensor(v) for v in values]).to(points)

    rotation = stack([c.T_cam_world[:3, :3] for c in cameras])
    shift = stack([c.T_cam_world[:3, 3] for c in cameras])
    intrinsics = stack([c.intrinsics for c in cameras])
    image = (points @ rotation.mT + shift[:, None]) @ intrinsics.mT
    return image[..., :2] / image[..., 2:]


def residuals(
    cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"], detected: Float[Tensor, "N L 3"], px_per_head: float
) -> tuple[Float[Tensor, "N L"], Float[Tensor, "N L"]]:
    """Return the distances between projected and detected landmarks.

    Args:
        cameras: of the N views.
        points: of the model, world, metres.
        detected: x_px, y_px and confidence in each view.
        px_per_head: height of the head in the views, px.

    Returns:
        Distances, px at 512 px of head height; and 1 where the detection's confidence exceeds 0.5, else 0.
    """
    difference = project(cameras, points) - detected[..., :2]
    distance = (difference.square().sum(-1) + 1e-12).sqrt() * (512 / px_per_head)
    return distance, (detected[..., 2] > _MIN_CONFIDENCE).to(points)


def geman_mcclure(residual_px: Float[Tensor, "*S"], weight: Float[Tensor, "*S"], sigma_px: float) -> Float[Tensor, ""]:
    """Return the weighted mean of the Geman-McClure function r^2 / (r^2 + sigma^2) [Geman 1987].

    Quadratic below `sigma_px`, and 1 far above it, so that outliers do not pull.

    Args:
        residual_px: r, at 512 px of head height.
        weight: of each residual.
        sigma_px: where the function is one half.
    """
    squared = (residual_px / sigma_px).square()
    return (squared / (1 + squared) * weight).sum() / weight.sum().clamp_min(1.0)
