"""What landmarks do to the surface and to sliding: losses of one scale, and likelihoods by each landmark's spread.

    python -m bench.landmarks CAPTURE --model MODEL.npz [--recipe draft] [--views 10] [--cases exact] [--rows ...]

The capture has a scan, and a ground truth of the model's topology, as `gnmreg capture synth` writes it. `exact`
landmarks are the capture's, which state a spread of 0.3 px. `detected` ones imitate a detector: the points of scheme
`dense` lie 2 mm (standard deviation along each axis) beside the model's, by the same error in all views, with noise of
1.5 px in each. The rows of a case differ in the loss: no landmarks after the initial guess; one scale of 3 px for all;
the same with a thirty-fold weight while offsets are free; likelihoods, along the skin while offsets are free, or in all
directions. Distances of the scan's face from the mesh show the surface; the vertex error shows sliding too.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from registration.capture.landmark_files import write_landmarks
from registration.capture.native import read_capture
from registration.capture.scan import read_truth
from registration.fit.recipes import Recipe, load_recipe
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme, schemes_beside, write_scheme
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.types import Camera

EXACT_PX = 0.3
SCHEME_M, DETECTOR_PX, DETECTED = 2e-3, 1.5, "dense"


@dataclass(frozen=True, kw_only=True)
class Row:
    """A way to weigh landmarks."""

    stated: bool  # whether files state the spreads
    everywhere: Mapping[str, Any] = field(default_factory=dict)  # changed weights of all stages
    offsets: Mapping[str, Any] = field(default_factory=dict)  # and of those with free offsets

    def recipe(self, recipe: Recipe, steps: int | None) -> Recipe:
        """Return a recipe with these weights, and at most `steps` steps in each stage."""
        stages = []
        for stage in recipe.stages:
            changed = {**self.everywhere, **(self.offsets if stage.frees("offsets") else {})}
            count = stage.steps if steps is None else min(steps, stage.steps)
            stages.append(replace(stage, steps=count, weights=replace(stage.weights, **changed)))
        return replace(recipe, stages=tuple(stages))


ROWS: Mapping[str, Row] = {
    "none": Row(stated=False, everywhere={"landmarks": 0.0, "landmark_likelihood": 0.0}),
    "one-scale": Row(stated=False),
    "thirty-fold": Row(stated=False, offsets={"landmarks": 0.3}),
    "likelihood": Row(stated=True),
    "all-directions": Row(stated=True, offsets={"landmarks_along_skin": False}),
}
CASES = ("exact", "detected")


def with_spread(source: Path, target: Path, *, stated: bool) -> None:
    """Copy a capture; its landmarks state a spread of `EXACT_PX`, or none."""
    shutil.copytree(source, target)
    for view in read_capture(source).views:
        spreads = {name: np.full(len(points), EXACT_PX) for name, points in view.landmarks.items()} if stated else {}
        write_landmarks(target / "landmarks" / f"{view.name}.json", view.landmarks, spreads)


def with_detected(source: Path, target: Path, scheme: LandmarkScheme, *, stated: bool) -> None:
    """Copy a capture with the landmarks of one scheme, which err as a detector's."""
    shutil.copytree(source, target)
    capture, rng = read_capture(source), np.random.default_rng(0)
    assert capture.ground_truth is not None
    points = scheme.points(read_truth(capture.ground_truth).astype(np.float64))
    beside = points + SCHEME_M * rng.standard_normal(points.shape)
    for view in capture.views:
        rows = view.landmarks[scheme.name].copy()
        rows[:, :2] += _pixels(view.camera, beside) - _pixels(view.camera, points)
        rows[:, :2] += DETECTOR_PX * rng.standard_normal((len(rows), 2))
        spreads = {scheme.name: np.full(len(rows), DETECTOR_PX)} if stated else {}
        write_landmarks(target / "landmarks" / f"{view.name}.json", {scheme.name: rows}, spreads)


def _pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    return camera.project(points)[0]


def measure(source: Path, model: Path, case: str, row: Row, options: RegisterOptions, folder: Path) -> tuple[str, ...]:
    """Register a case; cells of the table after its name."""
    data = gnm_npz.read(model)
    schemes = schemes_beside(model, data.template_vertex_positions)
    capture, copy = folder / "capture", folder / model.name
    shutil.copy(model, copy)
    for scheme in schemes.values():
        vague = case == "detected" and scheme.name == DETECTED and row.stated
        write_scheme(replace(scheme, spread_m=np.full(len(scheme.indices), SCHEME_M) if vague else None), copy)
    if case == "exact":
        with_spread(source, capture, stated=row.stated)
    else:
        with_detected(source, capture, schemes[DETECTED], stated=row.stated)
    start = time.perf_counter()
    registration = register(capture, copy, folder / "out", options)
    seconds = time.perf_counter() - start
    figures = registration.figures
    surface, vertices = figures["scan_to_mesh"]["face"], figures["vertex_error"]["face"]
    cells = [_cell(statistics) for statistics in (surface, vertices)]
    return (registration.status, *cells, f"{seconds:.0f}")


def _cell(statistics: Mapping[str, Any]) -> str:
    return " / ".join(f"{statistics[key]:.3f}" for key in ("mean_mm", "median_mm", "p95_mm"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--views", type=int)
    parser.add_argument("--steps", type=int, help="at most so many steps in each stage, to try the command")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    options = parser.parse_args()
    heads = ("landmarks", "loss", "status", "surface mm", "vertex error mm", "s")
    table = Table(*heads, title="face, mean / median / 95 %")
    for case in options.cases:
        for name in options.rows:
            recipe = ROWS[name].recipe(load_recipe(options.recipe), options.steps)
            chosen = RegisterOptions(recipe=recipe, views=options.views, deterministic=True)
            with tempfile.TemporaryDirectory() as folder:
                cells = measure(options.capture, options.model, case, ROWS[name], chosen, Path(folder))
            table.add_row(case, name, *cells)
            print(case, name, *cells, sep="\t", flush=True)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
