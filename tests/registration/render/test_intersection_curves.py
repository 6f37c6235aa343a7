"""Intersection curves between parts of a mesh: a ball half sunk into a board, against its formula."""

import numpy as np
import pytest
import torch
import trimesh

from registration.render import backend
from registration.render.renderer import Renderer
from registration.types import Camera, Pixels

RADIUS_M, DISTANCE_M, FOCAL_PX, SIDE_PX = 0.05, 0.6, 600.0, 160
BALL = trimesh.creation.icosphere(subdivisions=5)
BOARD = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
TRIANGLES = np.concatenate([[[0, 1, 2], [0, 2, 3]], BALL.faces + 4])
CLASSES = np.eye(2, dtype=np.float32)[np.r_[0, 0, 0, 0, np.ones(len(BALL.vertices), int)]]


@pytest.fixture(autouse=True)
def llvm():
    backend.activate()


def vertices(centre_m: float) -> torch.Tensor:
    """A board on z = 0, and a ball on the camera's axis."""
    return torch.tensor(np.concatenate([BOARD, RADIUS_M * BALL.vertices + [0, 0, centre_m]]), dtype=torch.float32)


def pixels() -> Pixels:
    """One camera on +z that looks down, its axis not at a pixel's centre."""
    intrinsics = np.array([[FOCAL_PX, 0, SIDE_PX / 2 + 0.3], [0, FOCAL_PX, SIDE_PX / 2 - 0.2], [0, 0, 1]])
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = DISTANCE_M
    return Pixels.full([Camera(width_px=SIDE_PX, height_px=SIDE_PX, intrinsics=intrinsics, T_cam_world=pose)])


def shown_area(centre_m: float, **settings) -> tuple[float, torch.Tensor]:
    """Pixels that show the ball, and their gradient."""
    uvs = np.zeros((len(TRIANGLES), 3, 2), np.float32)
    renderer = Renderer(TRIANGLES, uvs, CLASSES, edge_samples=16.0, **settings)
    attached = vertices(centre_m).requires_grad_()
    area = renderer(attached, None, pixels()).classes[:, 1].sum()
    area.backward()
    return area.item(), attached.grad


@pytest.mark.parametrize("rays", [1, 4])
def test_gradients_of_a_ball_rising_from_a_board(rays):
    """Sunk below its centre, it shows the disc of radius sqrt(R^2 - h^2) in which it meets the board."""
    depth = 0.02
    area, gradient = shown_area(-depth, pixel_samples=rays)
    px_per_m = FOCAL_PX / DISTANCE_M
    assert area == pytest.approx(np.pi * (RADIUS_M**2 - depth**2) * px_per_m**2, rel=0.01)
    # With the centre at -h the disc grows by 2 pi h for every metre that the ball rises.
    rising = gradient[4:, 2].sum().item()
    assert rising == pytest.approx(2 * np.pi * depth * px_per_m**2, rel=0.03)
    # The board sinks: the same, and the disc comes farther from the camera.
    farther = 2 * area / DISTANCE_M
    assert -gradient[:4, 2].sum().item() == pytest.approx(rising - farther, rel=0.03)
    # A sideways translation moves the disc and does not change its size.
    assert gradient[4:, :2].sum(0).abs().max() < 0.03 * rising


def test_occlusion_without_contact_has_no_intersection_curve():
    """A ball before the board: silhouettes alone, whether or not the two are declared as parts."""
    _, two_parts = shown_area(0.06)
    _, single_part = shown_area(0.06, parts=np.zeros(len(TRIANGLES), int))
    torch.testing.assert_close(two_parts, single_part, rtol=0, atol=0)
    assert two_parts.abs().max() > 0
