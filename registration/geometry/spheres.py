"""Spheres through points: found robustly once, then followed differentiably."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_ROUNDS = 8


def fit_sphere(points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Centre and radius of the sphere nearest to at least four points, in their unit; differentiable.

    Minimises the sum of (|p - c|^2 - r^2)^2, which is linear in c and r^2 - |c|^2 (Kasa 1976, in three dimensions).
    Points may cover a cap; they must not lie in one plane. Solved in float64 whatever comes in.
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
    """Which points lie on the sphere that most of them lie on, within `tolerance` of its radius.

    An eyeball's sclera, for one, without the cornea's bulge. Trimmed least squares: points far from the sphere of the
    last round are left out of the next.
    """
    keep = np.ones(len(points), bool)
    away = np.zeros(len(points))
    for _ in range(_ROUNDS):
        centre, radius = fit_sphere(torch.as_tensor(points[keep], dtype=torch.float64))
        away = np.linalg.norm(points - centre.numpy(), axis=1) / float(radius) - 1
        keep = np.abs(away) <= max(tolerance / 4, 2 * float(np.median(np.abs(away))))
    return np.abs(away) <= tolerance
