"""Cost of one iteration of the renderer, relative to ray casting alone.

    python -m bench.renderer --case 22x512 --case 8x512 --case 8x256 [--variant llvm|cuda] [--memory] [--stock]

A case is VIEWSxSIDE: the first model's head and the studio's rig; the vertices change in every iteration. The baseline
is one coherent cast of *all* pixels with the BVH already built. The renderer renders the pixels that a fit compares,
those in and near the head. Stages are medians over interleaved repeats. `misses` counts kernels that were compiled
after the second iteration; `memory_growth` is the process's size at iteration 1,000 divided by that at 100, minus 1.
`--stock` also compares an iteration of Mitsuba's projective integrator [Zhang 2023] with the same baseline.
"""

import argparse
import itertools
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from coregister.first_model.build import bootstrap
from coregister.synthetic.capture import label_weights
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.render import backend
from registration.render.studio.rig import RigOptions, make_rig
from registration.types import Pixels

REPEATS = 7
CLASSES = 9  # 16 channels: colour, normal, mask and these
TEXTURE_PX = 512
NEAR = 0.08  # distance from the head, relative to its height, up to which a fit compares pixels
MOTION = 1e-4  # standard deviation of the vertices' motion, metres
CAST, MOVE, FORWARD, INTERIOR, EDGES, CROSSINGS, WHOLE, STOCK = (
    "ray cast of all pixels (baseline)",
    "vertex update and BVH",
    "forward, 16 channels",
    "interior adjoint, with texture",
    "silhouettes",
    "intersection curves",
    "whole iteration",
    "Mitsuba's projective integrator, whole iteration, 3 channels",
)
STAGES = (MOVE, FORWARD, INTERIOR, EDGES, CROSSINGS)
STOCK_CASE = "2x256"


class Case:
    """One scene on the device."""

    def __init__(self, views: int, side: int, device: torch.device):
        from registration.render.renderer import Renderer

        data = gnm_npz.read(bootstrap())
        head = data.template_vertex_positions.astype(np.float64)
        centre = (head.min(0) + head.max(0)) / 2
        options = RigOptions(cameras=views, size_px=(side, side))
        cameras = make_rig(options, centre=centre, head_height_m=float(np.ptp(head[:, 1])))
        self.triangles = triangles = data.triangles.astype(np.int64)
        classes = label_weights(data)[:, :CLASSES]
        self.corner_uvs = texture_atlas(data)
        self.renderer = Renderer(triangles, self.corner_uvs, classes.astype(np.float32))
        self.all = Pixels.full(cameras, device)
        self.rest = torch.as_tensor(head, dtype=torch.float32, device=device)
        generator = torch.Generator().manual_seed(0)
        self.texture = torch.rand(TEXTURE_PX, TEXTURE_PX, 3, generator=generator).to(device).requires_grad_()
        with torch.no_grad():
            mask = self.all.image(self.renderer(self.rest, None, self.all).mask[:, None])[..., 0] > 0
        self.hits = float(mask.float().mean())
        near = np.stack([_near(m) for m in mask.cpu().numpy()])
        self.pixels = Pixels.from_mask(cameras, torch.as_tensor(near, device=device))
        count = len(self.pixels.view)
        shapes = ((count, 3), (count, 3), (count,), (count, CLASSES))
        self.adjoint = [torch.rand(shape, generator=generator).to(device) for shape in shapes]
        displacements = MOTION * torch.randn((8, *self.rest.shape), generator=generator).to(device)
        self._vertices = itertools.cycle([(self.rest + delta).requires_grad_() for delta in displacements])

    def next_vertices(self) -> torch.Tensor:
        """Return other vertices than before, so that the BVH is rebuilt."""
        return next(self._vertices)

    def iterate(self) -> None:
        vertices = self.next_vertices()
        rendered = self.renderer(vertices, self.texture, self.pixels)
        image = (rendered.rgb, rendered.normals, rendered.mask, rendered.classes)
        torch.autograd.grad(image, (vertices, self.texture), self.adjoint)


def _near(mask: np.ndarray) -> np.ndarray:
    """Return the pixels that a fit compares: those of the head and around it."""
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return distance < NEAR * np.ptp(np.flatnonzero(mask.any(1))) + 2


@dataclass
class Clock:
    """Accumulates the seconds spent in each of the renderer's stages."""

    seconds: dict[str, float]

    def wrap(self, owner: Any, name: str, stage: str) -> None:
        import drjit as dr

        inner: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            dr.sync_thread()
            start = time.perf_counter()
            result = inner(*args, **kwargs)
            dr.sync_thread()
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
            return result

        setattr(owner, name, timed)

    def take(self) -> dict[str, float]:
        seconds, self.seconds = self.seconds, {}
        return seconds


def baseline(case: Case) -> Callable[[], None]:
    """Return the cast of all pixels, row by row, with Mitsuba's own BVH of the mesh."""
    import drjit as dr
    import mitsuba as mi

    from registration.render.cameras import upload

    mesh = mi.Mesh("head", len(case.rest), len(case.triangles))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(case.rest.reshape(-1))
    params["faces"] = mi.UInt32(case.triangles.astype(np.uint32).ravel())
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    pixels = case.all
    view, y, x = (a.to(torch.int32) for a in (pixels.index >= 0).nonzero(as_tuple=True))
    origin, direction = upload(replace(pixels, view=view, x=x, y=y)).rays((0.5, 0.5))
    dr.eval(origin, direction)
    dr.sync_thread()

    def cast() -> None:
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=True, active=mi.Bool(True))
        dr.eval(hit.t, hit.prim_index, hit.prim_uv)
        dr.sync_thread()

    return cast


def timed(call: Callable[[], None]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def measure(case: Case) -> dict[str, float]:
    """Return the median seconds of every stage."""
    from registration.render.renderer import Renderer
    from registration.render.scene import TriangleScene

    cast = baseline(case)
    for _ in range(3):
        case.iterate()
        cast()
    clock = Clock({})
    originals = [(owner, name, getattr(owner, name)) for owner, name in _stages(Renderer, TriangleScene)]
    samples: dict[str, list[float]] = {}
    for _ in range(REPEATS):
        samples.setdefault(CAST, []).append(timed(cast))
        samples.setdefault(WHOLE, []).append(timed(case.iterate))
        for (owner, name, _original), stage in zip(originals, STAGES, strict=True):
            clock.wrap(owner, name, stage)
        case.iterate()
        for owner, name, original in originals:
            setattr(owner, name, original)
        for stage, seconds in clock.take().items():
            samples.setdefault(stage, []).append(seconds)
    return {stage: statistics.median(seconds) for stage, seconds in samples.items()}


def measure_stock(case: Case) -> dict[str, float]:
    """Return the median seconds of the baseline, of our iteration and of Mitsuba's integrator."""
    from bench.support import stock_renderer

    stock = stock_renderer.iteration(
        case.all.cameras, case.triangles, case.corner_uvs, case.texture, case.next_vertices
    )
    calls = {CAST: baseline(case), WHOLE: case.iterate, STOCK: stock}
    for _ in range(3):
        for call in calls.values():
            call()
    rounds = [{stage: timed(call) for stage, call in calls.items()} for _ in range(REPEATS)]
    return {stage: statistics.median(seconds[stage] for seconds in rounds) for stage in calls}


def _stages(renderer: type, scene: type) -> list[tuple[type, str]]:
    adjoint = ("_interior_gradients", "_silhouette_gradients", "_intersection_gradients")
    return [(scene, "update_vertices"), (renderer, "_render"), *((renderer, name) for name in adjoint)]


def misses(case: Case, iterations: int = 5) -> int:
    """Return the number of kernels compiled in further iterations."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in range(iterations):
            case.iterate()
        return sum(not entry["cache_hit"] for entry in dr.kernel_history() if "cache_hit" in entry)


def resident_bytes() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def memory_growth(device: torch.device) -> float:
    case = Case(8, 128, device)
    for iteration in range(1, 1001):
        case.iterate()
        if iteration == 100:
            early = resident_bytes()
    return resident_bytes() / early - 1


def show(name: str, case: Case, seconds: dict[str, float]) -> None:
    title = f"{name}: {len(case.all.view):,} rays, {case.hits:.0%} hit, {len(case.pixels.view):,} pixels compared"
    table = Table("stage", "ms", "x baseline", title=title, title_justify="left")
    for stage in (CAST, *STAGES, WHOLE, STOCK):
        if stage in seconds:
            table.add_row(stage, f"{1000 * seconds[stage]:.1f}", f"{seconds[stage] / seconds[CAST]:.2f}")
    Console(width=110).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", default=[], metavar="VIEWSxSIDE")
    parser.add_argument("--variant", choices=("llvm", "cuda"), default="llvm")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--stock", action="store_true")
    options = parser.parse_args()
    device = backend.activate(options.variant)
    lines, missed = [], 0
    for name in options.case:
        views, side = map(int, name.split("x"))
        case = Case(views, side, device)
        seconds = measure(case)
        missed += misses(case)
        show(name, case, seconds)
        lines.append(f"ratio {name} {seconds[WHOLE] / seconds[CAST]:.2f}")
    print(*lines, f"misses {missed}", sep="\n")
    if options.memory:
        print(f"memory_growth {memory_growth(device):.4f}")
    if options.stock:
        case = Case(*map(int, STOCK_CASE.split("x")), device)
        seconds = measure_stock(case)
        show(STOCK_CASE, case, seconds)
        print(f"ratio {STOCK_CASE} {seconds[WHOLE] / seconds[CAST]:.2f}")
        print(f"stock {STOCK_CASE} {seconds[STOCK] / seconds[CAST]:.1f}")


if __name__ == "__main__":
    main()
