"""Least-squares spheres: a robust selection of the points once, then a differentiable fit."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_ROUNDS = 8


def fit_sphere(points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Fit a sphere to at least four points; differentiable, computed in float64.

    Minimizes the sum of (|p - c|^2 - r^2)^2, which is linear in c and r^2 - |c|^2 ([Kåsa 1976], in three dimensions).

    Args:
        points: in any unit. They may cover only a cap, but must not be coplanar.

    Returns:
        Centre and radius.
    """
    exact = points.double()
    origin = exact.mean(0)
    local = exact - origin
    # In units of the points' spread all columns are alike, and a shallow cap stays well conditioned.
    unit = local.detach().square().sum(-1).mean().sqrt()
    local = local / unit
    left = torch.cat([2 * local, torch.ones_like(local[:, :1])], 1)
    solution = torch.linalg.solve(left.T @ left, left.T @ local.square().sum(-1))
    centre = solution[:3]
    radius = (solution[3] + centre.square().sum()).sqrt()
    return (centre * unit + origin).to(points.dtype), (radius * unit).to(points.dtype)


def on_main_sphere(points: Float[np.ndarray, "P 3"], tolerance: float = 0.01) -> Bool[np.ndarray, "P"]:
    """Select the points on the sphere on which most of them lie, such as an eyeball's sclera without the cornea.

    Trimmed least squares: points far from the sphere of one round are excluded from the next.

    Args:
        points: in any unit.
        tolerance: largest distance from the sphere, as a fraction of its radius.
    """
    keep = np.ones(len(points), bool)
    deviation = np.zeros(len(points))
    for _ in range(_ROUNDS):
        centre, radius = fit_sphere(torch.as_tensor(points[keep], dtype=torch.float64))
        deviation = np.linalg.norm(points - centre.numpy(), axis=1) / float(radius) - 1
        keep = np.abs(deviation) <= max(tolerance / 4, 2 * float(np.median(np.abs(deviation))))
    return np.abs(deviation) <= tolerance
