"""The renderer against the reference renderer: values and gradients of all channels, in a few tiny scenes.

Two effects of the reference are not required of the renderer's gradient: the colour is constant beyond the
outermost texels' centres, and it jumps at a seam that is visible from the inner side.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
import trimesh

from registration.render import backend
from registration.render.reference import ReferenceRenderer
from registration.render.renderer import Renderer
from registration.types import Camera, Pixels, Rendered
from tests.registration.render.test_renderer import camera

GROUPS = ("rgb", "normals", "mask", "classes")


@pytest.fixture(autouse=True)
def llvm():
    """One thread for the reference: its operations are too small to split, and spinning threads would slow others."""
    backend.activate()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@dataclass(frozen=True, kw_only=True)
class Scene:
    vertices: np.ndarray  # (V, 3), metres
    triangles: np.ndarray  # (F, 3)
    corner_uvs: np.ndarray  # (F, 3, 2)
    cameras: list[Camera]

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arguments of both renderers; three random classes."""
        classes = np.random.default_rng(1).dirichlet([1, 1, 1], len(self.vertices)).astype(np.float32)
        return self.triangles, self.corner_uvs.astype(np.float32), classes

    @property
    def positions(self) -> torch.Tensor:
        return torch.tensor(self.vertices, dtype=torch.float32)

    @property
    def pixels(self) -> Pixels:
        """A tenth of the pixels is omitted: they give no gradient."""
        shape = (len(self.cameras), self.cameras[0].height_px, self.cameras[0].width_px)
        return Pixels.from_mask(self.cameras, torch.rand(shape, generator=torch.Generator().manual_seed(2)) < 0.9)


def small_camera(position) -> Camera:
    return camera(position, focal_px=70.0, width_px=36, height_px=32)


def squares() -> Scene:
    """A square before a larger one, tilted, each with a chart to a triangle: the colour jumps along the diagonals."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    small = 0.05 * corners @ trimesh.transformations.rotation_matrix(0.4, [1, 2, 0.5])[:3, :3] + [0.01, 0.005, 0.08]
    large = 0.11 * corners @ trimesh.transformations.rotation_matrix(-0.2, [2, 1, 0])[:3, :3]
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    lower, upper = [[0.1, 0.1], [0.8, 0.15], [0.85, 0.4]], [[0.15, 0.9], [0.2, 0.5], [0.9, 0.85]]
    return Scene(
        vertices=np.concatenate([small, large]),
        triangles=np.concatenate([triangles, triangles + 4]),
        corner_uvs=np.array([lower, upper, upper, lower]),
        cameras=[small_camera(at) for at in ((0.12, 0.08, 0.5), (-0.2, -0.1, 0.45))],
    )


def balls() -> Scene:
    """One ball before another, of 80 faces each; their uvs jump nowhere."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices = np.concatenate([0.05 * ball.vertices + [0.02, 0.01, 0.15], 0.1 * ball.vertices + [0, 0.003, 0]])
    triangles = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    return Scene(
        vertices=vertices,
        triangles=triangles,
        corner_uvs=(vertices[:, :2] / 0.3 + 0.5)[triangles],
        cameras=[small_camera(at) for at in ((0.13, 0.08, 0.5), (-0.5, 0.1, 0.2))],
    )


def bowl() -> Scene:
    """An open bowl seen from inside, over its boundary, and from outside. Its faces look inwards: faces that are
    turned from the camera hide those that face it."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    triangles = np.array(ball.faces)
    triangles = triangles[(ball.vertices[triangles][..., 1] < 0.3).all(1)]
    used, triangles = np.unique(triangles, return_inverse=True)
    vertices = 0.1 * ball.vertices[used] * [1, 0.8, 1.1]
    triangles = triangles.reshape(-1, 3)[:, ::-1]
    return Scene(
        vertices=vertices,
        triangles=triangles,
        corner_uvs=(vertices[:, ::2] / 0.3 + 0.5)[triangles],
        cameras=[small_camera(at) for at in ((0.2, 0.4, 0.31), (0.1, -0.1, 0.5))],
    )


SCENES = pytest.mark.parametrize("make", [squares, balls, bowl], ids=lambda make: make.__name__)


def random_texture(size: int = 12) -> torch.Tensor:
    return torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0))


def random_adjoint(image: Rendered, group: str) -> Rendered:
    """For one group of channels; the loss ignores the others."""
    adjoint = Rendered(**{name: torch.zeros_like(values) for name, values in vars(image).items()})
    generator = torch.Generator().manual_seed(3)
    return replace(adjoint, **{group: torch.randn(getattr(image, group).shape, generator=generator)})


def gradients(image: Rendered, adjoint: Rendered, group: str, inputs: list[torch.Tensor]) -> list[torch.Tensor]:
    """With respect to the inputs; zero where the image does not depend on an input."""
    outputs, grads = getattr(image, group), getattr(adjoint, group).to(getattr(image, group).dtype)
    if not outputs.requires_grad:
        return [torch.zeros_like(values) for values in inputs]
    return list(
        torch.autograd.grad(outputs, inputs, grads, retain_graph=True, allow_unused=True, materialize_grads=True)
    )


def mean_of_offsets(renderer: Renderer, reference: ReferenceRenderer, *scene) -> Rendered:
    """The reference's image, with the renderer's rays."""
    images = [reference(*scene, offset) for offset in renderer._pixel_offsets]
    return Rendered(**{name: sum(getattr(image, name) for image in images) / len(images) for name in GROUPS})


def assert_close(actual: torch.Tensor, expected: torch.Tensor, tolerance: float) -> None:
    """Within a fraction of the norm, and no row's error above twice that fraction of the longest row."""
    error, expected = (actual - expected).flatten(0, -2), expected.flatten(0, -2)
    assert expected.norm() > 0
    assert error.norm() < tolerance * expected.norm()
    assert error.norm(dim=1).max() < 2 * tolerance * expected.norm(dim=1).max()


@SCENES
@pytest.mark.parametrize("pixel_samples", [1, 16])
def test_values_equal_the_reference_renderers(make, pixel_samples):
    scene = make()
    renderer, reference = Renderer(*scene.mesh, pixel_samples=pixel_samples), ReferenceRenderer(*scene.mesh)
    inputs = scene.positions, random_texture(), scene.pixels
    image, expected = renderer(*inputs), mean_of_offsets(renderer, reference, *inputs)
    assert 0.2 < expected.mask.mean() < 0.9
    for name in GROUPS:
        wrong = (getattr(image, name) - getattr(expected, name)).abs().reshape(len(scene.pixels.view), -1)
        # A ray through an edge may pass it on either side.
        assert (wrong > 5e-5).any(1).sum() <= 2, name


def test_the_texture_is_clamped_at_its_border():
    scene = squares()
    scene = replace(scene, corner_uvs=np.tile([[0, 0], [1, 0], [1, 1]], (4, 1, 1)))
    texture = random_texture(4)
    image, expected = (
        draw(*scene.mesh)(scene.positions, texture, scene.pixels) for draw in (Renderer, ReferenceRenderer)
    )
    # The renderer's outermost texel weighs 0.999 there.
    torch.testing.assert_close(image.rgb.double(), expected.rgb, atol=2e-3, rtol=0)


@pytest.mark.parametrize("pixel_samples", [1, 4])
@pytest.mark.parametrize("group", ["rgb", "normals", "classes"])
def test_values_and_gradients_inside_a_ball(group, pixel_samples):
    """Values and gradients of pixels that hold no silhouette: nothing is sampled, so that only rounding differs."""
    scene = balls()
    half = slice(len(scene.triangles) // 2, None)
    scene = replace(scene, triangles=scene.triangles[half], corner_uvs=scene.corner_uvs[half])
    renderer, reference = Renderer(*scene.mesh, pixel_samples=pixel_samples), ReferenceRenderer(*scene.mesh)
    everywhere = Pixels.full(scene.cameras)
    mask = everywhere.image(reference(scene.positions, None, everywhere).mask[:, None])[..., 0]
    # A convex shape that covers the centres around a pixel covers it completely.
    pixels = Pixels.from_mask(scene.cameras, torch.nn.functional.avg_pool2d(mask, 3, 1, 1) > 0.99)
    assert len(pixels.view) > 300
    inputs = [scene.positions.requires_grad_(), random_texture().requires_grad_()]
    image, reference_image = renderer(*inputs, pixels), mean_of_offsets(renderer, reference, *inputs, pixels)
    assert (getattr(image, group) - getattr(reference_image, group)).abs().max() < 5e-5
    adjoint = random_adjoint(image, group)
    actual, expected = (gradients(rendered, adjoint, group, inputs) for rendered in (image, reference_image))
    for number in range(2 if group == "rgb" else 1):
        assert_close(actual[number], expected[number], 1e-4)


@SCENES
@pytest.mark.parametrize("group", GROUPS)
def test_gradients(make, group):
    """Of positions, with silhouettes: the mean over the renderer's samples; and of the texture, which has none."""
    scene = make()
    renderer, reference = Renderer(*scene.mesh, edge_samples=256.0), ReferenceRenderer(*scene.mesh)
    inputs = [scene.positions.requires_grad_(), random_texture().requires_grad_()]
    image = renderer(*inputs, scene.pixels)
    adjoint = random_adjoint(image, group)
    positions, texture = gradients(reference(*inputs, scene.pixels), adjoint, group, inputs)
    silhouettes = reference.silhouette_gradient(*inputs, scene.pixels, adjoint, points=16)
    samples = [gradients(image, adjoint, group, inputs) for _ in range(3)]
    assert_close(torch.stack([seed[0] for seed in samples]).mean(0), positions + silhouettes, 0.015)
    assert silhouettes.norm() > 0.2 * positions.norm()
    if group == "rgb":
        assert_close(samples[0][1], texture, 1e-4)


def test_the_reference_silhouette_gradient_by_hand():
    """The part of the image that a square covers is the area of its projection (the shoelace formula)."""
    scene = squares()
    scene = replace(scene, triangles=scene.triangles[:2], corner_uvs=scene.corner_uvs[:2], cameras=scene.cameras[:1])
    reference, view, pixels = ReferenceRenderer(*scene.mesh), scene.cameras[0], Pixels.full(scene.cameras[:1])
    vertices = torch.tensor(scene.vertices, requires_grad=True)
    projected = torch.cat([vertices[:4], torch.ones(4, 1)], 1) @ torch.tensor(
        (view.intrinsics @ view.T_cam_world[:3]).T
    )
    x, y = (projected[:, :2] / projected[:, 2:]).unbind(1)
    area = (x * y.roll(-1) - y * x.roll(-1)).sum().abs() / 2
    (expected,) = torch.autograd.grad(area, vertices)
    adjoint = replace(random_adjoint(reference(vertices, None, pixels), "mask"), mask=torch.ones(len(pixels.view)))
    gradient = reference.silhouette_gradient(vertices, None, pixels, adjoint)
    assert area > 100
    torch.testing.assert_close(gradient, expected, rtol=1e-6, atol=1e-6)
