"""CPU time of one step in every stage of a recipe, of what comes before the stages, and the memory of both.

    python -m bench.steps CAPTURE --model MODEL.npz [--recipe draft] [--steps 6]

A few steps of each stage are taken, one stage after the other; a step is the median without the first two, which
compile kernels. `whole` is that times the recipe's number of steps. CPU time counts all threads and hardly depends on
what else the machine does, unlike wall time; OMP_NUM_THREADS=1 keeps waiting threads out of it.
"""

import argparse
import resource
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from registration import pipeline
from registration.fit.problem import FitProblem
from registration.fit.recipes import Stage, load_recipe
from registration.fit.start import initial_guess
from registration.inputs import read_inputs
from registration.options import RegisterOptions
from registration.progress import NullProgress
from registration.render import backend

_COMPILED = 2  # steps of a stage, after which no kernel is new


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--steps", type=int, default=6, help="of each stage, at least 4")
    options = parser.parse_args()
    recipe = load_recipe(options.recipe)
    short = replace(recipe, stages=tuple(replace(stage, steps=max(4, options.steps)) for stage in recipe.stages))
    seconds: dict[str, float] = {"starting": time.process_time()}
    device = backend.activate()
    with _timed(seconds, "reading and checking the capture"):
        inputs = read_inputs(options.capture, options.model, RegisterOptions(recipe=short), None)
    with _timed(seconds, "targets"):
        context = pipeline._context(inputs, 0, device, NullProgress())
    targets_gb = _peak_gb()
    with _timed(seconds, "initial guess"):
        problem = FitProblem(context, initial_guess(context, None))
    ends: dict[str, list[float]] = {}

    def on_step(stage: Stage, step: int) -> None:
        ends.setdefault(stage.name, []).append(time.process_time())

    problem.run(short.stages, on_step)
    pixels = [len(level.pixels.view) for level in context.pyramid]
    table = Table("stage", "pixels a step", "ms a step", "whole, s", title=f"{recipe.name}: CPU time")
    total = 0.0
    for stage in recipe.stages:
        times = ends[stage.name][_COMPILED - 1 :]
        step = statistics.median(after - before for before, after in zip(times, times[1:], strict=False))
        total += step * stage.steps
        count = pixels[stage.level] * min(stage.views_per_step, context.view_count) // context.view_count
        table.add_row(stage.name, f"{count:,}", f"{1e3 * step:.0f}", f"{step * stage.steps:.1f}")
    for name, value in {**seconds, "all steps": total}.items():
        table.add_row(name, "", "", f"{value:.1f}")
    console = Console()
    console.print(table)
    console.print(f"peak memory: {targets_gb:.2f} GB with the targets, {_peak_gb():.2f} GB with the stages")


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    before = time.process_time()
    yield
    seconds[name] = time.process_time() - before


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    main()
