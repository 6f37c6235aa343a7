"""The loss against sliding: on a ball with a smaller ball in front of it, and on the official model's head.

Values, gradients by differences, ignored pixels; then slid vertices must be recovered, and must not move under a gain
and a blush.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.support import sliding
from bench.support.sliding import Problem
from registration.geometry.quads import corner_triangles, triangles_of
from registration.geometry.texels import eroded, texels
from registration.losses.uv_ssim import confident_texels
from registration.model import gnm_npz
from registration.model.regions import blush, exterior, inner_lips, lids
from registration.render import backend
from registration.types import Targets
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import ball, tiny_model

RADIUS = 0.08  # metres
SIZE_PX = 256  # of the textures that are compared
SURFACE = 0.05  # weight of the distance to the true surface


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A ball in four views; a small ball occludes a part of it. Six charts each."""
    backend.activate()
    sides = [ball(16, np.zeros(3), np.full(3, RADIUS)), ball(4, np.array([0.035, 0.01, 0.105]), np.full(3, 0.012))]
    points = np.concatenate([side[0] for side in sides])
    skin = np.arange(len(points)) < len(sides[0][0])
    triangles = triangles_of(np.concatenate([sides[0][1], sides[1][1] + skin.sum()]))
    flat = np.concatenate([sides[0][2] * [0.7, 1], sides[1][2] * [0.3, 1] + [0.7, 0]])
    corner_uvs = corner_triangles(flat).astype(np.float32)
    views = ((-40, 5), (-10, -25), (15, 20), (45, -5))
    cameras = [sliding.camera(np.zeros(3), *view, 2 * RADIUS, 96) for view in views]
    texture = sliding.noise_texture(triangles, corner_uvs, points, 512, contrast=0.15, wavelengths_mm=(8.0, 30.0))
    texture[:, int(0.7 * 512) :] = 0.02  # the small ball is dark
    return Problem(
        triangles=triangles,
        corner_uvs=corner_uvs,
        texture=texture,
        weights=skin.astype(float),
        truth=points,
        initial=sliding.slide(points, triangles, skin, 2.0),
        free=skin,
        evaluated=skin & (sliding.visible_camera_count(points, triangles, cameras) > 1),
        cheek=np.exp(-0.5 * np.square((points - [0, -0.02, RADIUS]) / 0.025).sum(1)),
        batch=sliding.render_targets(triangles, corner_uvs, points, texture, skin.astype(float), cameras, 0.005),
    )


def cost(problem: Problem, vertices: np.ndarray, batch: Targets | None = None, **changes) -> float:
    loss = replace(problem, **changes).loss(SIZE_PX)
    return loss(torch.as_tensor(vertices, dtype=torch.float32), batch or problem.batch).item()


def test_the_cost_of_sliding_exceeds_that_of_the_truth(problem):
    at_truth = cost(problem, problem.truth)
    assert 0 < at_truth < 0.03
    assert cost(problem, problem.initial) > 5 * at_truth
    # A uniform texture gives no information.
    assert cost(problem, problem.initial, texture=torch.full_like(problem.texture, 0.3)) > 0.3


def test_unknown_textures_and_pixels_cost_nothing(problem):
    vertices = torch.tensor(problem.initial, dtype=torch.float32, requires_grad=True)
    for silent in (
        replace(problem, weights=np.zeros(len(problem.truth))),
        replace(problem, batch=replace(problem.batch, rgb_weight=torch.zeros_like(problem.batch.rgb_weight))),
    ):
        value = silent.loss(SIZE_PX)(vertices, silent.batch)
        (gradient,) = torch.autograd.grad(value, vertices)
        assert value == 0 and not gradient.any()


def test_gradient_equals_finite_differences(problem):
    """Along random fields; in double precision, with steps so small that no point crosses into another pixel.

    All pixels are compared: at the borders of excluded pixels, texels appear and disappear, which the gradient ignores.
    """
    loss = problem.loss(SIZE_PX, torch.float64)
    rgb = problem.batch.rgb.double()
    batch = replace(problem.batch, rgb=rgb, rgb_weight=torch.ones_like(rgb[:, 0]))
    start = torch.as_tensor(problem.initial).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(start, batch), start)
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = torch.as_tensor(rng.standard_normal(start.shape))
        step = 1e-8
        with torch.no_grad():
            difference = (loss(start + step * direction, batch) - loss(start - step * direction, batch)) / (2 * step)
        assert (gradient * direction).sum().item() == pytest.approx(difference.item(), rel=1e-5)
    unobserved = torch.as_tensor(~problem.free | (problem.truth[:, 2] < -0.06))
    assert not gradient[unobserved].any()


def test_repeated_evaluations_are_equal(problem):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        runs = []
        for _ in range(4):
            vertices = torch.tensor(problem.initial, dtype=torch.float32, requires_grad=True)
            value = problem.loss(SIZE_PX)(vertices, problem.batch)
            runs.append((value, *torch.autograd.grad(value, vertices)))
    finally:
        torch.set_num_threads(threads)
    for run in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], run, strict=True))


def test_pixels_without_weight_have_no_effect(problem):
    batch = problem.batch
    image = batch.pixels.x > 50  # the right half of every image
    weight = batch.rgb_weight * ~image
    randomized = torch.where(image[:, None], torch.rand(batch.rgb.shape), batch.rgb)
    clean = cost(problem, problem.initial, replace(batch, rgb_weight=weight))
    assert cost(problem, problem.initial, replace(batch, rgb=randomized, rgb_weight=weight)) == clean
    assert cost(problem, problem.initial, replace(batch, rgb=randomized)) > clean + 0.05


def test_hidden_texels_are_not_compared(problem):
    """Without the small ball, its pixels are compared with the large ball's texture."""
    batch = replace(problem.batch, rgb_weight=torch.ones_like(problem.batch.rgb_weight))
    hidden = cost(problem, problem.truth, batch)
    visible = cost(
        problem, problem.truth, batch, triangles=problem.triangles[:3072], corner_uvs=problem.corner_uvs[:3072]
    )
    assert hidden < 0.02 and visible > 2 * hidden


def test_a_view_counts_by_its_squared_cosine_and_its_resolution(problem):
    """On the ball the normal is the direction from its centre."""
    loss = problem.loss(SIZE_PX)
    vertices = torch.as_tensor(problem.truth, dtype=torch.float32)
    points = loss._points(vertices).double().numpy()
    for camera in problem.batch.pixels.cameras:
        seen, weight = (values.numpy() for values in loss._visible_points(camera, vertices))
        to_camera = camera.centre - points[seen]
        distance = np.linalg.norm(to_camera, axis=1)
        cosine = (points[seen] * to_camera).sum(1) / np.linalg.norm(points[seen], axis=1) / distance
        depth = camera.project(points[seen])[1]
        px_per_mm = np.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1]) / depth / 1000
        assert len(seen) > 1000 and cosine.min() < 0.35 and cosine.max() > 0.99
        np.testing.assert_allclose(weight, (cosine * px_per_mm) ** 2, rtol=0.05)


def test_visibility_is_updated_with_the_mesh(problem):
    """Visibility is determined again when the mesh has moved: rotated by 180 degrees, the back is in front."""
    loss = problem.loss(SIZE_PX)
    loss(torch.as_tensor(problem.truth, dtype=torch.float32), problem.batch)
    rotated = torch.as_tensor(problem.truth * [-1, 1, -1], dtype=torch.float32)
    updated = loss(rotated, problem.batch).item()
    assert updated == problem.loss(SIZE_PX)(rotated, problem.batch).item()


def test_resolutions_of_the_reference_agree(problem):
    half = torch.nn.functional.avg_pool2d(problem.texture.permute(2, 0, 1), 2).permute(1, 2, 0)
    double = problem.texture.repeat_interleave(2, 0).repeat_interleave(2, 1)
    for texture in (half, double):
        assert cost(problem, problem.initial, texture=texture) == pytest.approx(
            cost(problem, problem.initial), rel=1e-4
        )


def test_windows_contain_one_chart(problem):
    """At every scale: texels with a weight are farther from all other charts than a window's radius."""
    loss = replace(problem, weights=np.ones(len(problem.truth))).loss(SIZE_PX)
    atlas = texels(problem.triangles, problem.corner_uvs, SIZE_PX)
    charts = atlas.image(atlas.chart, -1)
    first = [axis.min() // 4 * 4 for axis in np.nonzero(eroded(charts, 2))]  # where the compared part begins
    charts = charts[first[0] :, first[1] :]
    for number, scale in enumerate(loss._scales):
        block, weight = 2**number, scale.weight.numpy()
        compared_texels = np.argwhere(weight > 0)[:: 16 // block**2]
        assert len(compared_texels) > 900
        for row, column in compared_texels:
            above, left = (max(0, block * (index - 5)) for index in (row, column))
            near = charts[above : block * (row + 6), left : block * (column + 6)]
            assert len(np.unique(near[near >= 0])) == 1


def test_sizes_that_cannot_be_halved_are_refused(problem):
    with pytest.raises(ValueError, match="258 texels"):
        problem.loss(258)


def search(problem: Problem, start: np.ndarray, batch: Targets | None, stages, size_px: int = SIZE_PX) -> np.ndarray:
    """With the loss, or without if there is no batch."""
    surface, loss = sliding.OnSurface(problem), problem.loss(size_px)
    terms = {"surface": lambda vertices: SURFACE * surface(vertices)}
    if batch is not None:
        terms["slide"] = lambda vertices: loss(vertices, batch)
    return sliding.fit(problem, terms, start, stages)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


STAGES = ((40, 20.0, 4e-3, 2e-3), (40, 8.0, 2e-3, 1e-4))


def test_slid_vertices_are_recovered(problem):
    before = rms(problem.tangential_mm(problem.initial))
    assert 1.5 < before < 2.5
    without = search(problem, problem.initial, None, STAGES)
    assert rms(problem.tangential_mm(without)) > 0.7 * before
    back = search(problem, problem.initial, problem.batch, STAGES)
    assert rms(problem.tangential_mm(back)) < 0.3
    distance_m = np.linalg.norm(back[problem.evaluated], axis=1) - np.linalg.norm(
        problem.truth[problem.evaluated], axis=1
    )
    assert 1e3 * rms(distance_m) < 0.1  # still on the surface


def test_a_gain_and_a_blush_displace_no_vertex(problem):
    """A faint blush, for coarse images; the bench has three times as much in finer ones."""
    undisturbed = search(problem, problem.truth, problem.batch, STAGES[1:])
    disturbed = search(problem, problem.truth, problem.disturbed(1.2, 0.1), STAGES[1:])
    assert 1e3 * np.linalg.norm(disturbed - undisturbed, axis=1).max() < 0.1


def test_confident_texels_of_the_tiny_head():
    data = tiny_model()
    confidence = np.full(len(data.template_vertex_positions), 0.5)
    confidence[:600] = 0.1
    weights = confident_texels(data, confidence)
    assert ((weights > 0) == (exterior(data) & (np.arange(len(weights)) >= 600))).all()
    plain = (weights > 0) & (lids(data) + inner_lips(data) + blush(data) == 0)
    assert (weights[plain] == 1).all() and plain.any()
    cheeks = (weights > 0) & (blush(data) == 1) & (lids(data) == 0)
    assert (weights[cheeks] == 0.5).all() and cheeks.any()
    assert (weights[(weights > 0) & (lids(data) > 0.5)] < 0.6).all()


@needs_shared
@pytest.mark.slow
def test_an_expression_of_the_full_head():
    """Small; `python -m bench.uv_ssim` measures it at full size."""
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    coefficients = 0.8 * np.random.default_rng(3).standard_normal(60)
    views = ((-55, 0), (-25, -20), (0, 15), (20, -25), (50, 5))
    problem = sliding.head(
        data, coefficients=coefficients.tolist(), views=views, head_px=160, texture_px=1024, slide_mm=2.0
    )
    before = rms(problem.tangential_mm(problem.initial))
    back = search(problem, problem.initial, problem.batch, (*STAGES, (30, 4.0, 1e-3, 5e-5)), 320)
    print(before, rms(problem.tangential_mm(back)))
    assert before > 1.5 and rms(problem.tangential_mm(back)) < 0.3
