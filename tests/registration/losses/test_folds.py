"""The penalty on folds: free up to 90 degrees and as at rest, and its gradient opens a fold."""

import numpy as np
import pytest
import torch

from registration.geometry.folds import Creases
from registration.losses.folds import FoldPenalty
from tests.registration.geometry.test_folds import EVERYTHING, FLAT, TRIANGLES, turned

CPU = torch.device("cpu")


def penalty(degrees: float, rest: np.ndarray = FLAT) -> float:
    return float(penalty_of(rest)(torch.as_tensor(turned(degrees))))


def penalty_of(rest: np.ndarray) -> FoldPenalty:
    return FoldPenalty(Creases.of(TRIANGLES, rest, EVERYTHING), CPU)


def test_a_third_of_the_area_at_full_turn():
    """Three inner edges of equal area: the one that turns by 180 degrees exceeds the limit by one."""
    assert penalty(180) == pytest.approx(1 / 3, abs=1e-6)
    assert penalty(120) == pytest.approx(0.25 / 3, abs=1e-6)
    assert penalty(89) == penalty(-89) == 0


def test_what_is_folded_at_rest_is_free():
    assert penalty(150, rest=turned(151)) == 0
    assert penalty(150, rest=turned(149)) > 0


def test_it_does_not_depend_on_pose_and_size():
    loss = penalty_of(FLAT)
    moved = 1.2 * turned(150)[:, [2, 0, 1]] + [3.0, -1.0, 0.5]
    assert float(loss(torch.as_tensor(moved))) == pytest.approx(penalty(150), rel=1e-9)


def test_gradient():
    loss = penalty_of(FLAT)
    loss._share, loss._limit = loss._share.double(), loss._limit.double()
    points = torch.tensor(1e3 * turned(140), requires_grad=True)
    assert torch.autograd.gradcheck(loss, (points,))


def test_descent_opens_a_fold():
    creases, loss = Creases.of(TRIANGLES, FLAT, EVERYTHING), penalty_of(FLAT)
    points = torch.tensor(turned(170), requires_grad=True)
    assert len(creases.sharp(points.detach().numpy(), 120)) == 1
    optimizer = torch.optim.Adam([points], lr=2e-5)
    for _ in range(150):
        optimizer.zero_grad()
        loss(points).backward()
        optimizer.step()
    assert len(creases.sharp(points.detach().numpy(), 120)) == 0
