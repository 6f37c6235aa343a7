"""Landmarks: how far the model's projected points lie from those seen in the images."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.types import Camera

_MIN_CONFIDENCE = 0.5


def project(cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"]) -> Float[Tensor, "N L 2"]:
    """World points (m) in every camera's pixels; differentiable."""

    def stack(values: list[np.ndarray]) -> Tensor:
        return torch.stack([torch.as_tensor(v) for v in values]).to(points)

    rotation = stack([c.T_cam_world[:3, :3] for c in cameras])
    shift = stack([c.T_cam_world[:3, 3] for c in cameras])
    intrinsics = stack([c.intrinsics for c in cameras])
    image = (points @ rotation.mT + shift[:, None]) @ intrinsics.mT
    return image[..., :2] / image[..., 2:]


def residuals(
    cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"], seen: Float[Tensor, "N L 3"], px_per_head: float
) -> tuple[Float[Tensor, "N L"], Float[Tensor, "N L"]]:
    """Distances in px at 512 px of head height, and which count (confidence > 0.5), as 0 or 1."""
    difference = project(cameras, points) - seen[..., :2]
    return (difference.square().sum(-1) + 1e-12).sqrt() * (512 / px_per_head), (seen[..., 2] > _MIN_CONFIDENCE).to(
        points
    )


def robust(residual_px: Tensor, weight: Tensor, sigma_px: float) -> Tensor:
    """Geman-McClure mean of residuals: quadratic below `sigma_px`, saturating at 1 far above it."""
    squared = (residual_px / sigma_px).square()
    return (squared / (1 + squared) * weight).sum() / weight.sum().clamp_min(1.0)
