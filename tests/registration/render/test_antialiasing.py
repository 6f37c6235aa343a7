"""Several rays per pixel: the mask does not flicker when the mesh moves by less than a pixel."""

import numpy as np
import pytest
import torch

from registration.model import gnm_npz
from registration.render import backend
from registration.render.renderer import Renderer
from registration.types import Camera, Pixels
from tests.conftest import FIXTURES

TINY = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
SAMPLES = 4
SHARE_OF_HEIGHT = 0.7  # of the image, that the mesh fills
RADIUS = 0.08  # metres, of the disc
LIMIT = 1e-3
MANY = 256  # samples of the reference
RMS = 0.05


@pytest.fixture(autouse=True)
def llvm():
    backend.activate()


def head() -> tuple[np.ndarray, np.ndarray]:
    return TINY.template_vertex_positions.astype(np.float64), TINY.triangles


def disc(corners: int = 720) -> tuple[np.ndarray, np.ndarray]:
    angle = 2 * np.pi * np.arange(corners) / corners
    circle = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    after = np.roll(np.arange(corners), -1)
    return np.concatenate([circle, np.zeros((1, 3))]), np.stack(
        [np.arange(corners), after, np.full(corners, corners)], 1
    )


class Scene:
    """A mesh before a camera that looks along -z and whose principal point is off the centre."""

    def __init__(self, mesh: tuple[np.ndarray, np.ndarray], side_px: int):
        self.vertices, self.triangles = mesh
        low, high = self.vertices.min(0), self.vertices.max(0)
        height = high[1] - low[1]
        distance = 4 * height
        focal_px = SHARE_OF_HEIGHT * side_px * distance / height
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ ((low + high) / 2 + [0, 0, distance])
        intrinsics = np.array([[focal_px, 0, 0.51 * side_px], [0, focal_px, 0.48 * side_px], [0, 0, 1]])
        self.camera = Camera(width_px=side_px, height_px=side_px, intrinsics=intrinsics, T_cam_world=pose)
        self.pixels = Pixels.full([self.camera])
        self.pixel_m = distance / focal_px

    def renderer(self, samples: int) -> Renderer:
        uvs = np.zeros((len(self.triangles), 3, 2), np.float32)
        return Renderer(self.triangles, uvs, np.ones((len(self.vertices), 1), np.float32), pixel_samples=samples)

    def mask(self, renderer: Renderer, shift_px: np.ndarray) -> torch.Tensor:
        """With the mesh translated to the right and upwards."""
        vertices = self.vertices + [*shift_px * self.pixel_m, 0]
        return renderer(torch.tensor(vertices, dtype=torch.float32), None, self.pixels).mask.double()


@pytest.mark.parametrize("side_px", [256, 512])
@pytest.mark.parametrize("mesh", [head, disc])
def test_a_moving_mesh_keeps_its_area(mesh, side_px, capsys):
    """For a translation by one pixel in steps of a tenth, in both directions."""
    scene = Scene(mesh(), side_px)
    renderer = scene.renderer(SAMPLES)
    for name, way in (("x", [1, 0]), ("y", [0, 1])):
        areas = [scene.mask(renderer, step / 10 * np.array(way)).sum().item() for step in range(11)]
        varied = (max(areas) - min(areas)) / np.mean(areas)
        with capsys.disabled():
            print(f"\n{mesh.__name__}, {side_px} px, along {name}: area varies by {varied:.3%}", end="")
        assert varied < LIMIT


def coverage_of_disc(scene: Scene, shift_px: np.ndarray) -> torch.Tensor:
    """Exact along y, by columns along x."""
    fine, side = 64, scene.camera.width_px
    radius = RADIUS / scene.pixel_m
    centre = scene.camera.intrinsics[:2, 2] + shift_px * [1, -1]
    column = (np.arange(side * fine) + 0.5) / fine - centre[0]
    half = np.sqrt(np.maximum(radius**2 - column**2, 0))
    row = np.arange(side)[:, None]
    covered = np.minimum(row + 1, centre[1] + half) - np.maximum(row, centre[1] - half)
    image = np.maximum(covered, 0).reshape(side, side, fine).mean(2)
    return scene.pixels.of_image(torch.tensor(image)[None])


@pytest.mark.parametrize("side_px", [256, pytest.param(512, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mesh", [head, disc])
def test_silhouette_coverage_equals_that_of_many_samples(mesh, side_px, capsys):
    scene, shift = Scene(mesh(), side_px), np.array([0.37, 0.21])
    mask = scene.mask(scene.renderer(SAMPLES), shift)
    references = {f"{MANY} samples": scene.mask(scene.renderer(MANY), shift)}
    if mesh is disc:
        references["the formula"] = coverage_of_disc(scene, shift)
    for name, reference in references.items():
        partly = (reference > 1e-4) & (reference < 1 - 1e-4)
        assert partly.sum() > 1.5 * side_px
        rms = (mask - reference)[partly].square().mean().sqrt().item()
        with capsys.disabled():
            print(f"\n{mesh.__name__}, {side_px} px, against {name}: rms {rms:.4f}", end="")
        assert rms < RMS
