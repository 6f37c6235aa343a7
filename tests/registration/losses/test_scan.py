"""The distance from a scan: by hand on a plane, its gradient, what it leaves out, and a shape that it recovers."""

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from registration.geometry.nearest_planes import CloudPlanes, MeshPlanes, NearestPlanes, Planes
from registration.geometry.surface_views import SurfaceViews
from registration.losses.scan import ScanDistance
from tests.registration.geometry.test_surface_views import RADIUS, a_camera, a_sphere

CAMERAS = [a_camera(turn) for turn in (0.0, 2.1, 4.2)]
SHOWN = [np.ones((camera.height_px, camera.width_px), bool) for camera in CAMERAS]


class Plane:
    """z = 0, with its outside towards -z, where the camera is."""

    oriented = True

    def of(self, points: np.ndarray) -> Planes:
        normals = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        return Planes(points=points * [1, 1, 0], normals=normals, trusted=points[:, 0] < 0.05)


def square(z: float = 0.0) -> tuple[Tensor, np.ndarray]:
    """Four triangles around a middle vertex, of 2 cm; they face -z."""
    corners = [[0, 0, z], [-0.01, -0.01, z], [0.01, -0.01, z], [0.01, 0.01, z], [-0.01, 0.01, z]]
    triangles = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]])
    return torch.tensor(corners, dtype=torch.float64), triangles


def distance_of(planes: NearestPlanes, vertices: Tensor, triangles: np.ndarray, scale_m: float = 1e-3) -> ScanDistance:
    found = ScanDistance(planes, np.arange(len(vertices)), triangles, CAMERAS, SHOWN)
    found.assign(vertices, scale_m)
    return found


def test_the_value_by_hand() -> None:
    """All of the skin at one distance x: s^2 x^2 / (s^2 + x^2); zero on the plane, and bounded by s^2."""
    for x in (0.0, 2e-4, 1e-3, 3e-3):
        vertices, triangles = square(x)
        found = distance_of(Plane(), vertices, triangles)
        assert found.share == pytest.approx(1)
        assert found(vertices, 1e-3).item() == pytest.approx(1e-6 * x**2 / (1e-6 + x**2), rel=1e-9)
    assert found(vertices, 1e-3).item() < 1e-6


def test_what_is_left_out() -> None:
    vertices, triangles = square(5e-3)
    assert distance_of(Plane(), vertices, triangles).share == 0  # farther than four scales
    vertices, triangles = square()
    assert distance_of(Plane(), vertices, triangles[:, ::-1]).share == 0  # turned away
    moved = vertices + torch.tensor([0.1, 0, 0])
    assert distance_of(Plane(), moved, triangles).share == 0  # its planes are not trusted
    behind = torch.cat([vertices, vertices + torch.tensor([0, 0, 2e-3])])
    both = np.concatenate([triangles, triangles + len(vertices)])
    only_front = ScanDistance(Plane(), np.arange(10), both, CAMERAS[:1], SHOWN[:1])
    only_front.assign(behind, 1e-3)
    assert only_front.share == pytest.approx(0.5)  # the other half is hidden
    unseen = ScanDistance(Plane(), np.arange(5), triangles, [], [])
    unseen.assign(vertices, 1e-3)
    hair = [shown.copy() for shown in SHOWN]
    for pixels in hair:
        pixels[:, : pixels.shape[1] * 48 // 100] = False  # left of the middle vertex
    half = ScanDistance(Plane(), np.arange(5), triangles, CAMERAS[:1], hair[:1])
    half.assign(vertices, 1e-3)
    assert half.share == pytest.approx(2 / 3)  # of the corners at the left a third of two triangles each
    assert unseen.share == 0 and unseen(vertices, 1e-3).item() == 0


def test_the_gradient_is_exact_and_zero_on_the_scan() -> None:
    vertices, triangles = square(4e-4)
    vertices[0, 2] = 9e-4
    found = distance_of(Plane(), vertices, triangles)
    variable = vertices.clone().requires_grad_()
    found(variable, 1e-3).backward()
    assert variable.grad is not None
    step = 1e-8
    for row, axis in ((0, 2), (1, 2), (0, 0)):
        ahead, behind = vertices.clone(), vertices.clone()
        ahead[row, axis] += step
        behind[row, axis] -= step
        numeric = (found(ahead, 1e-3) - found(behind, 1e-3)).item() / (2 * step)
        assert variable.grad[row, axis].item() == pytest.approx(numeric, rel=1e-5, abs=1e-12)
    flat = square()[0].requires_grad_()
    found(flat, 1e-3).backward()
    assert flat.grad is not None and not flat.grad.any()


def bumpy(vertices: np.ndarray) -> np.ndarray:
    """The sphere with waves of a millimetre."""
    direction = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices + 1e-3 * np.sin(6 * direction[:, :1]) * direction


@pytest.mark.parametrize("cloud", [False, True])
def test_a_known_deformation_is_recovered_beside_a_hole_and_hair(cloud: bool) -> None:
    """Where the scan is good the error falls from 0.6 to 0.05 mm; hair 2 cm thick and a hole change nothing."""
    fine, faces = a_sphere(6)
    scan = bumpy(fine)
    hair = fine[:, 1] < -0.05
    scan[hair] *= 1.2
    hole = np.linalg.norm(fine - [0, 0, -RADIUS], axis=1) < 0.02
    faces = faces[~hole[faces].any(1)]
    if cloud:
        planes: NearestPlanes = CloudPlanes(trimesh.Trimesh(scan, faces, process=False).sample(60_000, seed=1))
    else:
        planes = MeshPlanes(SurfaceViews(scan, faces, CAMERAS))
    vertices, triangles = a_sphere(4)
    start = torch.tensor(vertices)
    found = ScanDistance(planes, np.arange(len(vertices)), triangles, CAMERAS, SHOWN)
    variable = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([variable], lr=1e-4)
    for step in range(60):
        if step % 5 == 0:
            found.assign(variable, 1e-3)
        optimizer.zero_grad()
        (1e5 * found(variable, 1e-3)).backward()
        optimizer.step()
    radius = np.linalg.norm(vertices, axis=1, keepdims=True)
    error = np.abs(np.linalg.norm(variable.detach().numpy(), axis=1) - np.linalg.norm(bumpy(vertices), axis=1))
    before = np.abs(radius[:, 0] - np.linalg.norm(bumpy(vertices), axis=1))
    good = (vertices[:, 1] > -0.045) & (np.linalg.norm(vertices - [0, 0, -RADIUS], axis=1) > 0.03)
    assert before[good].mean() > 5e-4 and error[good].mean() < 6e-5
    moved = np.linalg.norm(variable.detach().numpy() - vertices, axis=1)
    under_hair = vertices[:, 1] < -0.06
    in_hole = np.linalg.norm(vertices - [0, 0, -RADIUS], axis=1) < 0.015
    assert under_hair.sum() > 100 and in_hole.sum() > 10
    assert not moved[under_hair].any() and not moved[in_hole].any()
