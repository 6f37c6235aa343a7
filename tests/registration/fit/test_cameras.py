"""Corrections of cameras: derivatives, prior, and the gauge that holds the rig."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.fit.cameras import CameraCorrections, CameraEquations, corrected, projection_jacobian
from registration.types import Camera, Pixels, Targets

SIGMA_PX = 0.8
COUNT = 7


def rig() -> tuple[Camera, ...]:
    """Cameras around the origin, 0.7 m away."""
    cameras = []
    for number in range(COUNT):
        rotation = Rotation.from_euler("yxz", [0.8 * number, 0.2 * (number % 3) - 0.2, 0.1 * number]).as_matrix()
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3], T_cam_world[:3, 3] = rotation, [0.01, -0.02, 0.7 + 0.02 * number]
        intrinsics = np.array([[900.0 + 10 * number, 0, 150], [0, 905, 190], [0, 0, 1]])
        cameras.append(Camera(width_px=300, height_px=400, intrinsics=intrinsics, T_cam_world=T_cam_world))
    return tuple(cameras)


@pytest.fixture
def points() -> Float[np.ndarray, "P 3"]:
    return np.random.default_rng(0).normal(size=(200, 3)) * 0.06


@pytest.fixture
def corrections(points: Float[np.ndarray, "P 3"]) -> CameraCorrections:
    return CameraCorrections(rig(), points, np.full(COUNT, SIGMA_PX))


def observed(
    corrections: CameraCorrections, truth: tuple[Camera, ...], points: Float[np.ndarray, "P 3"], weight: float
) -> CameraEquations:
    """What exact observations of points say, with a weight in 1 / px^2."""
    equations = CameraEquations.zeros(COUNT)
    for number, (given, true) in enumerate(zip(rig(), truth, strict=True)):
        camera = corrections.camera(number, given)
        jacobian = projection_jacobian(camera, points)
        difference = true.project(points)[0] - camera.project(points)[0]
        equations.matrix[number] = weight * np.einsum("pij,pik->jk", jacobian, jacobian)
        equations.vector[number] = weight * np.einsum("pij,pi->j", jacobian, difference)
    return equations


def test_the_projection_jacobian_matches_finite_differences(points: Float[np.ndarray, "P 3"]) -> None:
    step = 1e-6
    for camera in rig():
        jacobian = projection_jacobian(camera, points)
        for component in range(7):
            axis = np.eye(7)[component] * step
            both = [corrected(camera, sign * axis).project(points)[0] for sign in (1, -1)]
            np.testing.assert_allclose(jacobian[:, :, component], (both[0] - both[1]) / (2 * step), atol=1e-4)


def test_a_motion_and_scale_of_the_world_is_no_correction(
    corrections: CameraCorrections, points: Float[np.ndarray, "P 3"]
) -> None:
    """All cameras see the points as if the world had turned, moved and grown: the rig stays, whatever the data say."""
    turn = Rotation.from_rotvec([2e-4, -3e-4, 1e-4]).as_matrix()
    moved = 1.0004 * points @ turn.T + [1e-4, -2e-4, 1e-4]
    equations = CameraEquations.zeros(COUNT)
    for number, camera in enumerate(rig()):
        jacobian = projection_jacobian(camera, points)
        difference = camera.project(moved)[0] - camera.project(points)[0]
        assert np.abs(difference).max() > 0.2
        equations.matrix[number] = np.einsum("pij,pik->jk", jacobian, jacobian)
        equations.vector[number] = np.einsum("pij,pi->j", jacobian, difference)
    corrections.solve(equations, np.ones(COUNT))
    assert corrections.shift_px().max() < 1e-3


def test_errors_of_cameras_are_found_but_for_the_common_motion(
    corrections: CameraCorrections, points: Float[np.ndarray, "P 3"]
) -> None:
    errors = np.random.default_rng(1).normal(size=(COUNT, 7)) * [6e-4, 6e-4, 4e-3, 4e-4, 4e-4, 2e-3, 2e-3]
    truth = tuple(corrected(camera, error) for camera, error in zip(rig(), errors, strict=True))
    before = [a.project(points)[0] - b.project(points)[0] for a, b in zip(rig(), truth, strict=True)]
    world = points
    for _ in range(6):  # points and cameras in turn, as a fit does
        corrections.solve(observed(corrections, truth, world, 100.0), np.ones(COUNT))
        current = [corrections.camera(number, camera) for number, camera in enumerate(rig())]
        matrix, right = np.zeros((len(world), 3, 3)), np.zeros((len(world), 3))
        for camera, true in zip(current, truth, strict=True):
            step = 1e-6
            slope = np.stack(
                [(camera.project(world + step * axis)[0] - camera.project(world)[0]) / step for axis in np.eye(3)], -1
            )
            matrix += np.einsum("pij,pik->pjk", slope, slope)
            right += np.einsum("pij,pi->pj", slope, true.project(points)[0] - camera.project(world)[0])
        world = world + np.linalg.solve(matrix, right[..., None])[..., 0]
    after = [
        corrections.camera(number, camera).project(world)[0] - true.project(points)[0]
        for number, (camera, true) in enumerate(zip(rig(), truth, strict=True))
    ]
    assert np.sqrt(np.mean(np.square(before))) > 0.3
    assert np.sqrt(np.mean(np.square(after))) < 0.02
    assert np.abs(corrections.sigmas() - corrections.shift_px() / SIGMA_PX).max() < 1e-9


def test_without_data_and_in_views_that_are_not_trusted_the_prior_remains(
    corrections: CameraCorrections, points: Float[np.ndarray, "P 3"]
) -> None:
    corrections.solve(CameraEquations.zeros(COUNT), np.zeros(COUNT))
    assert not corrections.values.any()
    shifted = tuple(corrected(camera, np.array([1e-3, 0, 0, 0, 0, 0, 0])) for camera in rig())
    truth = (*rig()[:-1], shifted[-1])
    equations = observed(corrections, truth, points, 100.0)
    equations.matrix[-1], equations.vector[-1] = 0, 0  # the view weighs nothing
    corrections.solve(equations, np.array([1.0] * (COUNT - 1) + [0.0]))
    assert corrections.shift_px().max() < 1e-9


def test_a_large_step_is_shortened(corrections: CameraCorrections, points: Float[np.ndarray, "P 3"]) -> None:
    truth = (corrected(rig()[0], np.array([0.02, 0, 0, 0, 0, 0, 0])), *rig()[1:])  # 18 px
    corrections.solve(observed(corrections, truth, points, 1e3), np.ones(COUNT))
    assert 0.1 < corrections.shift_px().max() < 3


def test_normals_turn_with_their_camera(corrections: CameraCorrections) -> None:
    corrections.values = np.random.default_rng(2).normal(size=(COUNT, 7)) * 0.01
    mask = torch.zeros(COUNT, 4, 6, dtype=torch.bool)
    mask[1:, 1:3, 2:5] = True  # none in the first view
    cameras = tuple(replace(camera, width_px=6, height_px=4) for camera in rig())
    pixels = Pixels.from_mask(cameras, mask)
    count = len(pixels.view)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    none, empty = torch.zeros(count), torch.zeros(count, 0)
    targets = Targets(
        names=tuple("abcdefg"),
        class_names=(),
        pixels=pixels,
        rgb=torch.zeros(count, 3),
        rgb_weight=none,
        normals=normals.half(),
        normal_weight=none,
        mask=none,
        mask_weight=none,
        classes=empty,
        class_weight=none,
        landmarks={},
        px_per_head=4.0,
    )
    moved = corrections.apply(targets)
    assert moved.normals.dtype == torch.float16
    for number, (before, after) in enumerate(zip(cameras, moved.pixels.cameras, strict=True)):
        rows = (pixels.view == number).numpy()
        in_camera = targets.normals.double().numpy()[rows] @ before.T_cam_world[:3, :3].T
        np.testing.assert_allclose(
            moved.normals.double().numpy()[rows] @ after.T_cam_world[:3, :3].T, in_camera, atol=2e-3
        )


@pytest.mark.parametrize("count", [4, 5, 8])
def test_a_focal_factor_moves_no_pixel_of_the_undistorted_image(count: int) -> None:
    """Undistorted pixels stay those of the image that was undistorted with the given camera."""
    distortion = (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.005)[:count]
    given = replace(rig()[0], distortion=distortion)
    found = corrected(given, np.array([0, 0, 0, 0, 0, 0, 0.01]))
    assert found.intrinsics[0, 0] == pytest.approx(given.intrinsics[0, 0] * np.exp(0.01))
    grid = np.stack(np.meshgrid([10.0, 150, 280], [20.0, 190, 380]), -1).reshape(-1, 2)
    stored = []
    for camera in (given, found):
        rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(camera.intrinsics).T
        image = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.intrinsics, np.array(camera.distortion))[0]
        stored.append(image[:, 0])
    assert np.abs(stored[0] - grid).max() > 0.5
    np.testing.assert_allclose(stored[0], stored[1], atol=1e-9)
