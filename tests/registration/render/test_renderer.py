"""The renderer's images: by hand, against formulas and the NumPy rasterizer; and its behaviour over many calls.

Gradients are tested in test_gradients.py.
"""

import gc
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh

from registration.errors import InputError
from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import vertex_normals
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.regions import vertex_classes
from registration.render import backend
from registration.render.renderer import Renderer
from registration.render.shading import TexelFootprint
from registration.types import Camera, Pixels, Rendered
from tests.conftest import FIXTURES

TINY = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], np.float32)
SQUARE_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UVS = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32)


@pytest.fixture(autouse=True)
def llvm(request):
    """The CPU variant, except in the GPU tests."""
    if "cuda" not in request.keywords:
        backend.activate()


def camera(position, target=(0, 0, 0), *, focal_px=150.0, width_px=60, height_px=50) -> Camera:
    """Looking at a target with +Y up; the principal point is off the centre, pixels are not square."""
    z = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ position
    intrinsics = np.array([[focal_px, 0, 0.52 * width_px], [0, 1.02 * focal_px, 0.47 * height_px], [0, 0, 1]])
    return Camera(width_px=width_px, height_px=height_px, intrinsics=intrinsics, T_cam_world=pose)


def square(**settings) -> Renderer:
    """A square of 10 cm on z = 0 that faces +z, its texture upright; two classes grow from left to right."""
    classes = np.array([[1, 0], [0, 1], [0, 1], [1, 0]], np.float32)
    return Renderer(SQUARE_TRIANGLES, SQUARE_UVS, classes, **settings)


def centre_rays(view: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """World directions through pixel centres (P, 3), by the inverse of K."""
    local = np.stack([x + 0.5, y + 0.5, np.ones_like(x)], 1) @ np.linalg.inv(view.intrinsics).T
    return local @ view.T_cam_world[:3, :3]


def random_texture(size: int) -> torch.Tensor:
    return torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0))


def tiny(**settings) -> tuple[Renderer, torch.Tensor, Pixels]:
    """The synthetic head between two cameras."""
    renderer = Renderer(TINY.triangles, texture_atlas(TINY), vertex_classes(TINY)[1], **settings)
    centre = TINY.template_vertex_positions.mean(0)
    cameras = [camera(centre + 0.6 * np.array([np.sin(a), 0.1, np.cos(a)]), centre) for a in (0.3, -2.0)]
    return renderer, torch.tensor(TINY.template_vertex_positions), Pixels.full(cameras)


def test_a_square_by_hand():
    """Every channel from where a pixel's ray meets the plane, and the texture's row 0 at v = 1."""
    size, view = 16, camera((0.07, 0.03, 0.3), (0.05, 0.05, 0))
    # Linear in u and v, so that bilinear look-ups are exact between the outermost texels' centres.
    centre = (np.arange(size) + 0.5) / size
    texture = np.stack(np.broadcast_arrays(centre[None, :], 1 - centre[:, None], 0.25), -1)
    pixels = Pixels.full([view])
    image = square()(torch.tensor(SQUARE), torch.tensor(texture, dtype=torch.float32), pixels)
    rays = centre_rays(view, pixels.x.numpy(), pixels.y.numpy())
    point = view.centre - view.centre[2] / rays[:, 2:] * rays
    u, v = point[:, 0] / 0.1, point[:, 1] / 0.1
    margin = np.minimum.reduce([u, v, 1 - u, 1 - v])
    inside, outside = margin > 1e-4, margin < -1e-4
    assert 400 < inside.sum() < 2500 and outside.sum() > 400
    for values in (image.rgb, image.normals, image.classes, image.mask):
        assert values[outside].abs().max() == 0
    np.testing.assert_array_equal(image.mask[inside], 1)
    np.testing.assert_allclose(image.normals[inside], np.tile([0, 0, 1], (inside.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(image.classes[inside], np.stack([1 - u, u], 1)[inside], atol=2e-5)
    linear = margin > 0.5 / size
    expected = np.stack([u, v, 0.25 + 0 * u], 1)[linear]
    np.testing.assert_allclose(image.rgb[linear], expected, atol=5e-5)


def test_the_inner_side_of_a_face_has_its_own_normal():
    view = camera((0.05, 0.05, -0.3), (0.05, 0.05, 0))
    image = square()(torch.tensor(SQUARE), None, Pixels.full([view]))
    assert image.mask.sum() > 400
    np.testing.assert_allclose(image.normals[image.mask == 1][:, 2], -1, atol=1e-6)
    assert image.rgb.abs().max() == 0  # no texture, no colour


def test_normals_of_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4)
    centre, radius = np.array([0.02, -0.03, 0.1]), 0.09
    vertices, triangles = radius * ball.vertices + centre, np.array(ball.faces)
    uvs = np.zeros((len(triangles), 3, 2), np.float32)
    renderer = Renderer(triangles, uvs, np.ones((len(vertices), 1), np.float32))
    view = camera((0.4, 0.2, 0.5), centre)
    pixels = Pixels.full([view])
    image = renderer(torch.tensor(vertices, dtype=torch.float32), None, pixels)
    rays = centre_rays(view, pixels.x.numpy(), pixels.y.numpy())
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = -((view.centre - centre) * rays).sum(1)
    miss = np.linalg.norm(view.centre - centre + along[:, None] * rays, axis=1)
    normal = view.centre - centre + (along - np.sqrt(np.maximum(radius**2 - miss**2, 0)))[:, None] * rays
    inside = miss < 0.97 * radius
    np.testing.assert_allclose(image.normals.norm(dim=1)[inside], 1, atol=1e-5)
    angle = np.degrees(np.arccos(np.clip((image.normals.numpy() * normal).sum(1)[inside] / radius, -1, 1)))
    assert angle.max() < 2 and angle.mean() < 0.3
    np.testing.assert_array_equal(image.mask[miss > radius], 0)
    np.testing.assert_allclose(image.classes[:, 0], image.mask, atol=1e-6)


def test_a_head_against_the_numpy_rasteriser():
    """Faces and barycentrics from the rasterizer, channels interpolated in NumPy."""
    renderer, vertices, pixels = tiny()
    texture = random_texture(64)
    image = renderer(vertices, texture, pixels)
    positions, uvs, classes = vertices.numpy(), texture_atlas(TINY), vertex_classes(TINY)[1]
    normals = vertex_normals(vertices, torch.tensor(TINY.triangles.astype(np.int64))).numpy()
    per_view = pixels.index[0].numel()
    for number, view in enumerate(pixels.cameras):
        here = slice(per_view * number, per_view * (number + 1))
        pixel_index = (pixels.y[here].numpy(), pixels.x[here].numpy())
        face, weight = (a[pixel_index] for a in rasterize(positions, TINY.triangles, view))
        part = {name: values[here].numpy() for name, values in vars(image).items()}
        corners = TINY.triangles[face]
        a, b, c = (positions[corners[:, k]] for k in range(3))
        towards = (np.cross(b - a, c - a) * (view.centre - a)).sum(1)
        normal = (weight[..., None] * normals[corners]).sum(1)
        normal *= (np.sign(towards) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9))[:, None]
        expected = {
            "mask": np.ones(per_view),
            "classes": (weight[..., None] * classes[corners]).sum(1),
            "normals": normal,
            "rgb": looked_up(texture.numpy(), (weight[..., None] * uvs[face]).sum(1)),
        }
        for name, values in expected.items():
            wrong = np.abs(part[name] - np.where((face >= 0).reshape(-1, *[1] * (values.ndim - 1)), values, 0))
            # A ray through an edge may fall on either of its faces.
            assert (wrong.reshape(per_view, -1).max(1) > 1e-3).mean() < 2e-3, name
        assert (face >= 0).sum() > 300


def looked_up(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear, clamped at the texture's border."""
    size = len(texture)
    x, y = np.clip(uv[:, 0] * size - 0.5, 0, size - 1), np.clip((1 - uv[:, 1]) * size - 0.5, 0, size - 1)
    column, row = (np.minimum(np.floor(p).astype(int), size - 2) for p in (x, y))
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    top = texture[row, column] * (1 - fx) + texture[row, column + 1] * fx
    bottom = texture[row + 1, column] * (1 - fx) + texture[row + 1, column + 1] * fx
    return top * (1 - fy) + bottom * fy


def test_a_subset_of_pixels_equals_the_whole_image():
    """Values are equal, and gradients, summed over a partition."""
    texture = random_texture(64)
    renderer, vertices, everywhere = tiny(edge_samples=64.0)
    whole = renderer(vertices, texture, everywhere)
    rng = torch.Generator().manual_seed(1)
    chosen = torch.rand(everywhere.index.shape, generator=rng) < 0.5
    weight = torch.rand(len(everywhere.view), 3, generator=rng)

    def gradient(pixels: Pixels, weights: torch.Tensor) -> torch.Tensor:
        attached = vertices.clone().requires_grad_()
        image = renderer(attached, texture, pixels)
        (weights * (image.rgb + image.normals)).sum().backward()
        return attached.grad.double()

    parts = []
    for mask in (chosen, ~chosen):
        pixels = Pixels.from_mask(everywhere.cameras, mask)
        image = renderer(vertices, texture, pixels)
        for name, values in vars(image).items():
            torch.testing.assert_close(values, getattr(whole, name)[everywhere.of_image(mask)])
        parts.append(gradient(pixels, weight[everywhere.of_image(mask)]))
    total = gradient(everywhere, weight)
    assert (parts[0] + parts[1] - total).norm() < 0.05 * total.norm()


def test_a_loss_of_one_pixel_moves_the_mesh():
    """Sums are in fixed point, their unit taken from a sample of the adjoint: a sparse adjoint must not vanish."""
    size = 200
    view = camera((0.05, 0.05, 0.3), (0.05, 0.05, 0), focal_px=600.0, width_px=size, height_px=size)
    pixels, attached = Pixels.full([view]), torch.tensor(SQUARE, requires_grad=True)
    classes = square()(attached, None, pixels).classes[:, 1]
    pixel = int(pixels.index[0, 101, 93])
    assert 0.1 < classes[pixel] < 0.9
    (gradient,) = torch.autograd.grad(classes[pixel], attached)
    # A visible point slides by -1 m when the square slides by 1 m; the class grows by 1 in 0.1 m.
    assert gradient[:, 0].sum().item() == pytest.approx(-10, rel=1e-3)


def test_a_mesh_outside_the_image_gives_zeros():
    facing_away = camera((0, 0, 1), (0, 0, 2))
    vertices = torch.tensor(SQUARE, requires_grad=True)
    image = square()(vertices, random_texture(8), Pixels.full([facing_away]))
    assert all(values.abs().max() == 0 for values in vars(image).values())
    (image.rgb.sum() + image.normals.sum() + image.mask.sum()).backward()
    assert vertices.grad.abs().max() == 0


def test_unwrap_is_the_transpose_of_the_look_up():
    """<look_up(texture), values> = <texture, unwrap(values)> for any texture and any values."""
    renderer, vertices, pixels = tiny()
    size, rng = 96, torch.Generator().manual_seed(2)
    texture = random_texture(size)
    values = torch.randn(len(pixels.view), 3, generator=rng)
    weights = torch.rand(len(pixels.view), generator=rng) * (torch.rand(len(pixels.view), generator=rng) < 0.7)
    total, density = renderer.unwrap(vertices, values, weights, pixels, size)
    shown = renderer(vertices, texture, pixels).rgb.double()
    here = (shown * values * weights[:, None]).sum().item()
    assert (total.double() * texture).sum().item() == pytest.approx(here, rel=1e-4)
    # A texture of ones looks up as the mask.
    covered = renderer(vertices, torch.ones(size, size, 3), pixels).rgb[:, 0].double()
    assert density.double().sum().item() == pytest.approx((covered * weights).sum().item(), rel=1e-5)
    # And it is the gradient with respect to the texture.
    attached = texture.clone().requires_grad_()
    (renderer(vertices, attached, pixels).rgb * values * weights[:, None]).sum().backward()
    torch.testing.assert_close(attached.grad, total, atol=1e-4, rtol=1e-4)


def test_unwrap_reuses_only_the_faces_of_the_same_scene():
    """The same result whether faces are cached or computed again; the cache never serves other vertices or pixels."""
    renderer, vertices, pixels = tiny()
    fewer = Pixels.full(pixels.cameras[:1])
    generator = torch.Generator().manual_seed(3)
    values = torch.rand(len(pixels.view), 3, generator=generator)
    weights = torch.rand(len(pixels.view), generator=generator)
    expected = renderer.unwrap(vertices, values, weights, pixels, 32)
    for rendered_vertices, rendered_pixels in ((vertices, pixels), (vertices * 1.05, pixels), (vertices, fewer)):
        renderer(rendered_vertices, None, rendered_pixels)
        again = renderer.unwrap(vertices, values, weights, pixels, 32)
        torch.testing.assert_close(again, expected, atol=1e-4, rtol=1e-4)
    # The adjoint of an older image moves the mesh back under the faces of the newer image.
    older = renderer(vertices.clone().requires_grad_(), None, fewer)
    renderer(vertices * 1.05, None, pixels)
    older.mask.sum().backward()
    again = renderer.unwrap(vertices, values, weights, pixels, 32)
    torch.testing.assert_close(again, expected, atol=1e-4, rtol=1e-4)


def test_invalid_coordinates_are_clamped_to_the_texture():
    """Barycentrics of rays that miss are arbitrary; a texel far outside the texture would crash the process."""
    size = 7
    for u, v in ((np.nan, 0.5), (0.5, np.nan), (np.inf, -np.inf), (1e30, -1e30)):
        footprint = TexelFootprint.from_uv(mi.Point2f(mi.Float([u, 0.3]), mi.Float([v, 0.3])), size)
        for texel, _ in footprint.texels():
            assert (np.array(texel) < size**2).all()


def test_another_forward_between_forward_and_backward():
    """A rendering's gradient belongs to its vertices, texture and pixels."""
    texture = random_texture(64)

    def gradients(disturb: bool) -> tuple[torch.Tensor, torch.Tensor]:
        renderer, vertices, pixels = tiny(edge_samples=4.0, seed=5)
        attached, colours = vertices.clone().requires_grad_(), texture.clone().requires_grad_()
        image = renderer(attached, colours, pixels)
        if disturb:
            other = Pixels.full(pixels.cameras[:1])
            renderer(vertices * 1.3 + 0.02, None, other)
            renderer.unwrap(vertices * 0.9, torch.ones(len(other.view), 3), torch.ones(len(other.view)), other, 32)
        (image.rgb.sum() + image.normals[:, 0].sum() + image.mask.sum()).backward()
        return attached.grad, colours.grad

    for calm, disturbed in zip(gradients(False), gradients(True), strict=True):
        # Parallel sums add up in another order each time.
        assert (calm - disturbed).norm() < 1e-4 * calm.norm()


def fit_step(renderer: Renderer, vertices: torch.Tensor, texture: torch.Tensor, pixels: Pixels) -> None:
    attached = vertices.clone().requires_grad_()
    image = renderer(attached, texture, pixels)
    (image.rgb.square().sum() + image.normals[:, 1].sum() + image.mask.sum() + image.classes[:, 0].sum()).backward()


def test_moving_geometry_compiles_no_new_kernel():
    """Other vertices, other numbers of silhouettes, hits and pixels: the same kernels."""
    import drjit as dr

    renderer, vertices, pixels = tiny(edge_samples=64.0)
    texture, rng = random_texture(64), torch.Generator().manual_seed(0)

    def step(k: int) -> None:
        noise = 0.001 * torch.randn(vertices.shape, generator=rng)
        chosen = torch.rand(pixels.index.shape, generator=rng) < 0.4 + 0.1 * k
        here = Pixels.from_mask(pixels.cameras, chosen)
        fit_step(renderer, vertices * (1 + 0.02 * k) + noise, texture, here)
        renderer.unwrap(vertices + noise, torch.ones(len(here.view), 3), torch.ones(len(here.view)), here, 64)

    for k in range(2):
        step(k)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for k in range(2, 6):
            step(k)
        launched = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    assert len(launched) > 20
    assert [kernel["hash"] for kernel in launched if not kernel["cache_hit"]] == []


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="no /proc here")
def test_memory_does_not_grow():
    renderer, vertices, pixels = tiny()
    texture, rng = random_texture(64), torch.Generator().manual_seed(0)

    def run(steps: int) -> float:
        for _ in range(steps):
            fit_step(renderer, vertices + 0.001 * torch.randn(vertices.shape, generator=rng), texture, pixels)
        gc.collect()
        return resident_mb()

    baseline_mb = run(60)
    # A leak of every step's images alone would be 2.6 MB x 200.
    assert run(200) < baseline_mb + 20


def test_many_rays_per_pixel_measure_an_area():
    """A disc's mask sums up to its projected area; its outline is grey."""
    corners = 256
    angle = 2 * np.pi * np.arange(corners) / corners
    circle = 0.06 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    vertices = torch.tensor(np.concatenate([circle, [[0, 0, 0]]]), dtype=torch.float32)
    after = np.roll(np.arange(corners), -1)
    triangles = np.stack([np.arange(corners), after, np.full(corners, corners)], 1)
    uvs, classes = np.zeros((corners, 3, 2), np.float32), np.ones((corners + 1, 1), np.float32)
    view = camera((0, 0, 0.5), (0, 0, 0))
    polygon = 0.5 * corners * np.sin(2 * np.pi / corners) * 0.06**2
    area = polygon * view.intrinsics[0, 0] * view.intrinsics[1, 1] / 0.5**2
    renderer = Renderer(triangles, uvs, classes, pixel_samples=16)
    mask = renderer(vertices, None, Pixels.full([view])).mask.double()
    assert mask.sum().item() == pytest.approx(area, rel=2e-3)
    grey = (mask > 0.01) & (mask < 0.99)
    assert 80 < grey.sum() < 250
    sharp = Renderer(triangles, uvs, classes)(vertices, None, Pixels.full([view])).mask
    assert set(sharp.unique().tolist()) == {0.0, 1.0}


def test_cameras_of_two_sizes_or_with_distortion_are_refused():
    view, vertices = camera((0, 0, 0.5)), torch.tensor(SQUARE)
    pixels = Pixels.full([view, view])
    for other in (replace(view, width_px=30), replace(view, distortion=(0.1, 0.0, 0.0, 0.0))):
        with pytest.raises(ValueError, match="one image size and no distortion"):
            square()(vertices, None, replace(pixels, cameras=(view, other)))


def test_a_mesh_with_fins_is_refused():
    with pytest.raises(InputError, match="not a manifold"):
        faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 3]])
        Renderer(faces, np.zeros((3, 3, 2), np.float32), np.ones((4, 1), np.float32))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_is_an_input_error():
    with pytest.raises(InputError, match="No CUDA device"):
        backend.activate("cuda")


@pytest.mark.cuda
def test_the_gpu_renders_and_differentiates_as_the_cpu_does():
    texture = random_texture(64)

    def rendered(variant: backend.Variant) -> tuple[Rendered, torch.Tensor]:
        device = backend.activate(variant)
        renderer, vertices, pixels = tiny(edge_samples=64.0)
        attached = vertices.to(device).requires_grad_()
        image = renderer(attached, texture.to(device), Pixels.full(pixels.cameras, device))
        (image.rgb.sum() + image.normals[:, 0].sum() + image.mask.sum() + image.classes[:, 0].sum()).backward()
        return Rendered(**{name: v.detach().cpu() for name, v in vars(image).items()}), attached.grad.cpu()

    (cpu, cpu_gradient), (gpu, gpu_gradient) = rendered("llvm"), rendered("cuda")
    for name, values in vars(cpu).items():
        wrong = (values - getattr(gpu, name)).abs().reshape(len(values), -1).amax(1)
        assert (wrong > 1e-3).double().mean() < 2e-3, name
    assert (cpu_gradient - gpu_gradient).norm() < 0.05 * cpu_gradient.norm()
