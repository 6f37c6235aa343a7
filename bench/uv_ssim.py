"""Accuracy, robustness and cost of the uv-space SSIM term (`losses/uv_ssim.py`), which prevents tangential sliding.

    python -m bench.uv_ssim [--model NPZ] [--head-px 256] [--photo] [--captures NEUTRAL EXPRESSION]

An expression of the model with a noise texture is rendered by eight cameras with pixel noise 0.01. Every vertex starts
one, two or three millimetres (rms) from its true position, on the true surface, where another term keeps it. Errors are
tangential, of the face without lids and inner lips, where at least two cameras see it at 60 degrees or less. `--photo`
adds the fit's photometric term, whose texture follows the images and so allows sliding. Disturbed fits start at the
truth; the displacement of all vertices from the undisturbed fit is shown. `--captures` are two folders of one subject
whose ground truth has the model's topology; the reference texture is then unwrapped from the neutral's images.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from bench.support import sliding
from bench.support.sliding import OnSurface, Problem, Term
from coregister.first_model.build import bootstrap
from registration.capture.native import read_capture
from registration.frames import MM_PER_M
from registration.losses import image
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group, inner_lips, lids, vertex_classes
from registration.render import backend
from registration.render.renderer import Renderer
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Targets

VIEWS = ((-75, 0), (-45, -20), (-25, 15), (-8, -30), (8, 25), (25, -15), (50, 15), (75, -5))  # yaw, pitch
STAGES = ((40, 20.0, 4e-3, 2e-3), (60, 8.0, 2e-3, 1e-3), (60, 4.0, 1e-3, 5e-5))  # steps, smoothing mm, rates m
STILL = STAGES[1:]  # from the truth
SLIDE = 0.5  # weights
SURFACE = 0.02
HELD = 0.3  # weight of the term that keeps vertices on the surface
NOISE = 0.01  # of the pixels, linear
REPEATS = 20


class Photo:
    """The fit's photometric term: a texture that is rendered, compared, and updated half way to the images."""

    def __init__(self, problem: Problem, size_px: int):
        ones = np.ones((len(problem.truth), 1), np.float32)
        self._renderer = Renderer(problem.triangles, problem.corner_uvs, ones)
        self._batch = replace(problem.batch, mask=problem.batch.rgb_weight)
        texture = problem.texture.permute(2, 0, 1)[None]
        self._texture = torch.nn.functional.interpolate(texture, (size_px, size_px), mode="area")[0].permute(1, 2, 0)

    def __call__(self, vertices: torch.Tensor) -> torch.Tensor:
        batch, texture = self._batch, self._texture.contiguous()
        rendered = self._renderer(vertices, texture, batch.pixels)
        hit = rendered.mask > 0.5
        loss = image.rgb_l1(rendered, batch, hit) + 0.2 * image.rgb_ssim(rendered, batch, hit)
        with torch.no_grad():
            change, weight = batch.rgb - rendered.rgb, batch.rgb_weight * hit
            total, density = self._renderer.unwrap(vertices, change, weight, batch.pixels, len(texture))
            step = torch.where(density > 1e-3, 0.5 / density.clamp_min(1e-3), 0.0)
            self._texture = (texture + step[..., None] * total).clamp(0, 1)
        return loss


def terms(
    problem: Problem, size_px: int, batches: Sequence[Targets] = (), photo: bool = False, held: float = SURFACE
) -> dict[str, Term]:
    """Return the surface term and the requested others; batches are used in turn."""
    surface, loss, steps = OnSurface(problem), problem.loss(size_px), iter(range(10**9))
    selected: dict[str, Term] = {"surface": lambda vertices: held * surface(vertices)}
    if photo:
        selected["photo"] = Photo(problem, size_px)
    if batches:
        selected["slide"] = lambda vertices: SLIDE * loss(vertices, batches[next(steps) % len(batches)])
    return selected


def row(name: str, problem: Problem, vertices: np.ndarray) -> tuple[str, ...]:
    error = problem.tangential_mm(vertices)
    figures = (np.sqrt(np.square(error).mean()), np.median(error), np.quantile(error, 0.95), error.max())
    return name, *(f"{figure:.3f}" for figure in figures)


def recovery(table: Table, name: str, problem: Problem, size_px: int, photo: bool, batches: Sequence[Targets]) -> None:
    table.add_row(*row(f"{name}: start", problem, problem.initial))
    cases = {"surface alone": terms(problem, size_px)}
    if photo:
        cases["photometric term"] = terms(problem, size_px, photo=True)
    cases["with the term"] = terms(problem, size_px, batches)
    if photo:
        cases["both"] = terms(problem, size_px, batches, photo=True)
    for case, used in cases.items():
        table.add_row(*row(f"{name}: {case}", problem, sliding.fit(problem, used, problem.initial, STAGES)))


def disturbances(problem: Problem, size_px: int) -> Table:
    table = Table(
        "from the truth", "median mm", "p99", "max", title="displacement from the undisturbed fit, all vertices"
    )
    still = sliding.fit(problem, terms(problem, size_px, [problem.batch], held=HELD), problem.truth, STILL)

    def add_displacement(name: str, from_: np.ndarray, to: np.ndarray) -> None:
        length = MM_PER_M * np.linalg.norm(to - from_, axis=1)[problem.free]
        table.add_row(name, *(f"{figure:.3f}" for figure in np.quantile(length, [0.5, 0.99, 1])))

    add_displacement("undisturbed, against the truth", problem.truth, still)
    for name, gain, blush in (("gain +20 %", 1.2, 0.0), ("blush +30 %", 1.0, 0.3), ("both", 1.2, 0.3)):
        batch = problem.disturbed(gain, blush)
        used = terms(problem, size_px, [batch], held=HELD)
        add_displacement(name, still, sliding.fit(problem, used, problem.truth, STILL))
    return table


def costs(problem: Problem, size_px: int) -> Table:
    """Return medians of wall and processor time of one call."""
    table = Table("ms", "wall", "processor", title=f"{len(problem.batch.names)} views, texture of {size_px} px")
    vertices = torch.tensor(problem.truth, dtype=torch.float32, requires_grad=True)

    def clocks() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])

    start = clocks()
    loss = problem.loss(size_px)
    built = clocks()
    loss(vertices, problem.batch)
    spent = {"build": [built - start], "first call, visibility of all views": [clocks() - built]}
    for _ in range(REPEATS):
        start = clocks()
        value = loss(vertices, problem.batch)
        forward = clocks()
        value.backward()
        spent.setdefault("forward", []).append(forward - start)
        spent.setdefault("backward", []).append(clocks() - forward)
    for name, times in spent.items():
        table.add_row(name, *(f"{1e3 * seconds:.0f}" for seconds in np.median(times, 0)))
    return table


def captured(data: GNMData, neutral: Path, expression: Path, head_px: int, size_px: int, slide_mm: float) -> Problem:
    """Return the problem of two captures with ground truth; the texture is the mean of the neutral's views."""
    device, corner_uvs = backend.activate(), texture_atlas(data)
    batches, truths = [], []
    for folder in (neutral, expression):
        capture = read_capture(folder)
        level = build_pyramid(capture, class_map(capture.classes), finest_head_px=head_px, levels=1)[0]
        batches.append(level.select(range(len(level.names)), device))
        truths.append(np.load(capture.ground_truth)["vertices"].astype(np.float64))
    reference, rest = batches[0], torch.as_tensor(truths[0], dtype=torch.float32)
    renderer = Renderer(data.triangles, corner_uvs, vertex_classes(data)[1])
    total, density = renderer.unwrap(rest, reference.rgb, reference.rgb_weight.square(), reference.pixels, size_px)
    truth, outside, cameras = truths[1], exterior(data), batches[1].pixels.cameras
    evaluated = outside & (group(data, "hockey_mask") > 0.5) & (lids(data) < 0.5) & (inner_lips(data) < 0.5)
    view_count = sliding.visible_camera_count(truths[0], data.triangles, reference.pixels.cameras)
    return Problem(
        triangles=data.triangles,
        corner_uvs=corner_uvs,
        texture=torch.where(density[..., None] > 1e-3, total / density.clamp_min(1e-3)[..., None], 0.3),
        weights=sliding.confident_texels(data, view_count / (view_count + 1)),
        truth=truth,
        initial=sliding.slide(truth, data.triangles, outside, slide_mm),
        free=outside,
        evaluated=evaluated & (sliding.visible_camera_count(truth, data.triangles, cameras) > 1),
        cheek=np.zeros(len(truth)),
        batch=batches[1],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, metavar="NPZ", help="default: the first model")
    parser.add_argument("--head-px", type=int, default=256, help="height of the head in the images, px")
    parser.add_argument("--slides", type=float, nargs="*", default=[1.0, 2.0, 3.0], metavar="MM")
    parser.add_argument("--photo", action="store_true")
    parser.add_argument("--captures", type=Path, nargs=2, metavar=("NEUTRAL", "EXPRESSION"))
    options = parser.parse_args()
    data = gnm_npz.read(options.model or bootstrap())
    size_px, console = 2 * options.head_px // 4 * 4, Console(width=110)
    table = Table("along the skin, mm", "rms", "median", "p95", "max")
    coefficients = (0.8 * np.random.default_rng(3).standard_normal(60)).tolist()
    for slide_mm in options.slides:
        problem = sliding.head(
            data,
            coefficients=coefficients[: len(data.expression_basis)],
            views=VIEWS,
            head_px=options.head_px,
            texture_px=1024,
            slide_mm=slide_mm,
            pixel_noise=NOISE,
        )
        recovery(table, f"{slide_mm:g} mm", problem, size_px, options.photo, [problem.batch])
    if options.slides:
        console.print(table, disturbances(problem, size_px), costs(problem, size_px))
    if options.captures:
        table = Table("captures: along the skin, mm", "rms", "median", "p95", "max")
        problem = captured(data, *options.captures, options.head_px, size_px, 2.0)
        batches = [views_of(problem.batch, seed) for seed in range(12)]
        recovery(table, "2 mm", problem, size_px, False, batches)
        still = sliding.fit(problem, terms(problem, size_px, batches), problem.truth, STILL)
        table.add_row(*row("from the truth: with the term", problem, still))
        console.print(table)


def views_of(batch: Targets, seed: int) -> Targets:
    """Return eight random views, like a batch of a fit."""
    chosen = np.random.default_rng(seed).choice(len(batch.names), min(8, len(batch.names)), replace=False)
    return batch.select(sorted(chosen.tolist()), batch.rgb.device)


if __name__ == "__main__":
    main()
