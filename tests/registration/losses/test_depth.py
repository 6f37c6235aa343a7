"""The distance from depth maps: by hand on a plane, its gradient, what takes no part, and outliers that do not pull."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from registration.losses.depth import compared, distances, robust
from registration.render import backend
from registration.types import Pixels, Rendered, SurfaceHits, Targets
from tests.registration.render.test_renderer import SQUARE, SQUARE_TRIANGLES, camera, square

CAMERAS = [camera((0.02, 0.03, 0.4), (0.05, 0.05, 0)), camera((0.2, 0.1, 0.35), (0.05, 0.05, 0))]
VERTICES = torch.tensor(SQUARE)
TRIANGLES = torch.tensor(SQUARE_TRIANGLES)


def depth_of_plane(pixels: Pixels, z: float) -> Tensor:
    """Depth along the optical axis of the plane at a height, at each pixel."""
    depth = []
    for view, x, y in zip(pixels.view.tolist(), pixels.x.tolist(), pixels.y.tolist(), strict=True):
        cam = CAMERAS[view]
        ray = cam.T_cam_world[:3, :3].T @ np.linalg.inv(cam.intrinsics) @ [x + 0.5, y + 0.5, 1]
        depth.append((z - cam.centre[2]) / ray[2])
    return torch.tensor(depth, dtype=torch.float32)


def targets_at(z: float) -> Targets:
    pixels = Pixels.full(CAMERAS)
    ones = torch.ones(len(pixels.view))
    return Targets(
        names=("a", "b"),
        class_names=("left", "right"),
        pixels=pixels,
        rgb=ones[:, None].repeat(1, 3),
        rgb_weight=ones,
        normals=torch.tensor([0.0, 0, 1]).repeat(len(ones), 1),
        normal_weight=ones,
        mask=ones,
        mask_weight=ones,
        classes=ones[:, None].repeat(1, 2),
        class_weight=ones,
        depth=depth_of_plane(pixels, z),
        landmarks={},
        px_per_head=50.0,
    )


def seen(targets: Targets, vertices: Tensor = VERTICES) -> tuple[Rendered, SurfaceHits]:
    backend.activate()
    renderer = square()
    rendered = renderer(vertices, None, targets.pixels)
    return rendered, renderer.surface(vertices, targets.pixels)


@pytest.mark.parametrize("z", [0.0, -1e-3, 2e-3])
def test_the_value_by_hand(z: float) -> None:
    """The square lies at 0: it is in front of a plane below it."""
    targets = targets_at(z)
    rendered, hits = seen(targets)
    distance = distances(VERTICES, TRIANGLES, hits, rendered, targets)
    assert 1000 < len(distance) < len(targets.pixels.view)
    torch.testing.assert_close(distance, torch.full_like(distance, -z), atol=2e-7, rtol=1e-4)
    loss = robust(distance, torch.full_like(distance, 0.5), targets, 1e-3)
    expected = 0.5 * len(distance) / len(targets.mask) * 1e-6 * z**2 / (1e-6 + z**2)
    assert loss.item() == pytest.approx(expected, rel=1e-3, abs=1e-15)


def test_the_gradient_is_exact() -> None:
    """Against finite differences, of a bent square; and, for its height, with the pixels assigned anew."""
    targets = targets_at(-4e-4)
    bent = VERTICES + torch.tensor([[0, 0, 0.0], [0, 0, 2e-3], [0, 0, 0], [0, 0, -1e-3]])
    rendered, hits = seen(targets, bent)

    def loss(vertices: Tensor) -> Tensor:
        distance = distances(vertices, TRIANGLES, hits, rendered, targets)
        return robust(distance, torch.ones_like(distance), targets, 1e-3)

    def anew(vertices: Tensor) -> Tensor:
        rendered, hits = seen(targets, vertices)
        distance = distances(vertices, TRIANGLES, hits, rendered, targets)
        return robust(distance, torch.ones_like(distance), targets, 1e-3)

    def slope(of: Callable[[Tensor], Tensor], direction: Tensor) -> float:
        return (of(bent + 1e-4 * direction) - of(bent - 1e-4 * direction)).item() / 2e-4

    variable = bent.clone().requires_grad_()
    loss(variable).backward()
    assert variable.grad is not None
    for row in range(4):
        for axis in range(3):
            direction = torch.zeros(4, 3)
            direction[row, axis] = 1
            assert variable.grad[row, axis].item() == pytest.approx(slope(loss, direction), rel=0.03, abs=2e-6)
    up = torch.tensor([0.0, 0, 1]).repeat(4, 1)
    assert variable.grad[:, 2].sum().item() == pytest.approx(slope(anew, up), rel=0.03)


def test_what_takes_no_part() -> None:
    """Pixels without a depth, without a normal's weight, of another surface, or of a class that is left out."""
    targets = targets_at(0.0)
    assert targets.depth is not None
    rendered, hits = seen(targets)
    agree = torch.ones(len(targets.mask), dtype=torch.bool)
    chosen, weight = compared(hits, rendered, targets, [], agree)
    assert len(chosen.pixel) == len(hits.pixel) and (weight == 1).all()
    some = hits.pixel[::3]
    for change in (targets.depth, targets.normal_weight, agree):
        before = change.clone()
        change[some] = 0
        assert len(compared(hits, rendered, targets, [], agree)[1]) == len(hits.pixel) - len(some)
        change.copy_(before)
    right = compared(hits, rendered, targets, [0], agree)[0]  # class 0 is the left half
    assert (rendered.classes[right.pixel, 0] < 0.5).all() and 0 < len(right.pixel) < len(hits.pixel)


def test_outliers_do_not_pull() -> None:
    """A tenth of the pixels are 3 mm off to one side: the loss is lowest at the others' height."""
    targets = targets_at(-6e-4)
    assert targets.depth is not None
    targets.depth[::10] -= 3e-3
    slopes = []
    for height_m in (-6.3e-4, -5.7e-4):
        height = torch.tensor([height_m], requires_grad=True)
        vertices = VERTICES + height * torch.tensor([0.0, 0, 1])
        rendered, hits = seen(targets, vertices.detach())
        distance = distances(vertices, TRIANGLES, hits, rendered, targets)
        robust(distance, torch.ones_like(distance), targets, 5e-4).backward()
        assert height.grad is not None
        slopes.append(height.grad.item())
    assert slopes[0] < 0 < slopes[1]
