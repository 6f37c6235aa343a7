"""Ablation of the terms of a fit: the draft recipe without each term, on a neutral and on an expression.

    python -m bench.ablation --model MODEL.npz --neutral CAPTURE --expression CAPTURE --out FOLDER [--only NAME ...]

Registrations are kept in FOLDER, so that an interrupted run resumes. The expression always starts from the neutral of
the complete recipe; the term is missing from its own fit only. Errors are in mm on the face; "too deep" counts vertices
more than 0.3 mm deeper in another part than in the template; seconds are the sum of the stages, under the machine's
load at the time.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from registration.capture.native import read_capture
from registration.evaluate.audit import BEYOND_KEY
from registration.evaluate.evaluation import evaluate_registration
from registration.fit.recipes import Recipe, Stage, draft
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.progress import console_progress
from registration.storage.registration_folder import load_registration
from registration.types import Registration


def _weights(**changes: float) -> Callable[[Recipe], Recipe]:
    def change(stage: Stage) -> Stage:
        return replace(stage, weights=replace(stage.weights, **changes))

    return lambda recipe: replace(recipe, stages=tuple(change(stage) for stage in recipe.stages))


def _without_large_steps(recipe: Recipe) -> Recipe:
    """Return the recipe with independent steps of all vertices, without the large-steps preconditioner."""

    def change(stage: Stage) -> Stage:
        return stage if stage.lengths is None else replace(stage, lengths=replace(stage.lengths, smoothing_mm=0.0))

    return replace(recipe, stages=tuple(change(stage) for stage in recipe.stages))


def _without_colour(recipe: Recipe) -> Recipe:
    stages = (
        replace(stage, texture=False, weights=replace(stage.weights, rgb=0.0, ssim=0.0, slide=0.0))
        for stage in recipe.stages
    )
    return replace(recipe, stages=tuple(stages))


VARIANTS: Mapping[str, Callable[[Recipe], Recipe]] = {
    "everything": lambda recipe: recipe,
    "edges": lambda recipe: replace(recipe, edge_samples=0.0),
    "UV SSIM": _weights(slide=0.0),
    "contacts": _weights(contacts=0.0, tongue=0.0),
    "large steps": _without_large_steps,
    "normals": _weights(normals=0.0),
    "classes": _weights(classes=0.0),
    "landmarks": _weights(landmarks=0.0, landmark_likelihood=0.0),
    "RGB and UV SSIM": _without_colour,
}


def _row(registration: Registration, drift: Mapping[str, Any] | None) -> list[str]:
    figures = registration.figures
    face = figures["scan_to_mesh"]["face"]
    cells = [f"{face['mean_mm']:.3f}", f"{face['median_mm']:.3f}"]
    if drift is not None:
        cells += [f"{drift['mean_mm']:.3f}", f"{drift['p95_mm']:.2f}"]
    stages = sum(seconds for name, seconds in registration.seconds.items() if name not in ("targets", "start"))
    return [*cells, str(figures["intersections"][BEYOND_KEY]), f"{stages:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "neutral", "expression", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--only", nargs="*", choices=VARIANTS, default=list(VARIANTS))
    options = parser.parse_args()
    whole = options.out / "everything" / "neutral"
    heads = ("without", "mean", "median", "too deep", "s")
    neutral_table = Table(*heads, title=f"{options.neutral.name}, draft")
    drifting = ("without", "mean", "median", "drift", "p95", "too deep", "s")
    expression_table = Table(*drifting, title=f"{options.expression.name}, draft, from the complete recipe's neutral")
    with console_progress() as progress:
        for name in dict.fromkeys(["everything", *options.only]):
            recipe, folder = VARIANTS[name](draft()), options.out / name.replace(" ", "_")
            recipe = replace(recipe, name=f"draft without {name}" if name != "everything" else "draft")
            progress.message(f"without {name}" if name != "everything" else name)
            chosen = RegisterOptions(recipe=recipe)
            result = register(options.neutral, options.model, folder / "neutral", chosen, progress=progress)
            neutral_table.add_row(name, *_row(result, None))
            result = register(
                options.expression, options.model, folder / "expression", chosen, neutral=whole, progress=progress
            )
            evaluation = evaluate_registration(
                result,
                read_capture(options.expression),
                neutral=load_registration(whole),
                neutral_capture=read_capture(options.neutral),
            )
            expression_table.add_row(name, *_row(result, evaluation.metrics["drift"]["face"]))
    for table in (neutral_table, expression_table):
        Console(width=100).print(table)


if __name__ == "__main__":
    main()
