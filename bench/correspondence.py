"""Measure where registrations put the vertices of people outside the model: along the skin and across it.

    python -m bench.correspondence [--out DIR] [--subjects 6] [--recipe preview] [--model MODEL.npz]

Neutrals of any adult age and build, 8 views of 256 x 256 px (`gnmreg dataset synth`), are registered, and every vertex
is compared with where it truly is, in the capture's world. Along: the part of the difference in the tangent plane of
the true surface; across: the distance from the true surface. Root mean squares in mm over the vertices, then over the
subjects, with the standard error of the subjects' own: on the head's skin, its face, lips, lids and ears, and the neck
with the chest; and of those vertices that a camera sees. Sharp folds: the mean number in a subject's outer skin. The
second table is a bound: the model's most probable parameters, given the true vertices of the head's skin and the true
surface of the neck. With the same --out an interrupted run is resumed.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from bench.coregistration import STUDIO
from bench.support.known_head import known_head
from coregister.first_model import build
from registration.capture.scan import read_truth
from registration.evaluate.names import SHARP_FOLD_DEG
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.folds import Creases
from registration.geometry.topology import vertex_normals
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.progress import console_progress
from registration.types import Registration
from workflows.steps.synthesize import Population, synth_dataset

_SEEN = 0.1  # confidence of a vertex that a camera sees


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of the vertices of one registration, mm."""

    along: Float[np.ndarray, "V"]
    across: Float[np.ndarray, "V"]
    seen: Bool[np.ndarray, "V"]
    folds: int


def measure(registration: Registration, truth: Float[np.ndarray, "V 3"], data: GNMData) -> Errors:
    """Compare a registration with the true vertices of its capture."""
    truth, triangles = truth.astype(np.float64), data.triangles.astype(np.int64)
    outside = regions.exterior(data)
    skin = triangles[outside[triangles].all(1)]
    normals = vertex_normals(torch.as_tensor(truth), torch.as_tensor(skin)).numpy()
    apart = registration.vertices - truth
    along = apart - (apart * normals).sum(1, keepdims=True) * normals
    across = np.zeros(len(truth))
    across[outside] = closest_points(registration.vertices[outside].astype(np.float64), truth, skin)[0]
    creases = Creases.of(triangles, data.template_vertex_positions, outside)
    return Errors(
        along=MM_PER_M * np.linalg.norm(along, axis=1),
        across=MM_PER_M * across,
        seen=registration.confidence > _SEEN,
        folds=len(creases.sharp(registration.vertices, SHARP_FOLD_DEG)),
    )


def rms(values: Float[np.ndarray, "M"]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def table(errors: list[Errors], data: GNMData, title: str) -> Table:
    """Return the figures of all subjects."""
    head, neck = regions.head_skin(data), regions.exterior(data) & regions.neck_other(data)
    places = {"head": head, "face": regions.common_face(data)["face"], "neck": neck}
    detailed = regions.offset_regions(data)
    places |= {name: head & detailed[name] for name in ("lips", "lids", "ears")}
    shown = Table("skin", "along, mm", "across, mm", "seen: along", "seen: across", title=title)
    for place, members in places.items():
        cells = []
        for only_seen in (False, True):
            chosen = [members & one.seen if only_seen else members for one in errors]
            for kind in ("along", "across"):
                values = [rms(getattr(one, kind)[rows]) for one, rows in zip(errors, chosen, strict=True)]
                spread = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
                cells.append(f"{rms(np.array(values)):.3f} ± {spread:.3f}")
        shown.add_row(place, *cells)
    shown.caption = f"{len(errors)} subjects, {np.mean([one.folds for one in errors]):.1f} sharp folds each"
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/bench_correspondence"))
    parser.add_argument("--subjects", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recipe", default="preview")
    parser.add_argument("--model", type=Path, metavar="NPZ", help="the head model (default: the first model)")
    options = parser.parse_args()
    model = options.model or build.bootstrap()
    data = gnm_npz.read(model)
    population = Population(subjects=options.subjects, seed=options.seed, studio=STUDIO)
    chosen = RegisterOptions(recipe=options.recipe, seed=options.seed)
    errors, bounds = [], []
    with console_progress() as progress:
        synth_dataset(options.out / "dataset", population, progress=progress)
        for name in population.seeds:
            capture = options.out / "dataset" / name / "neutral"
            result = register(capture, model, options.out / options.recipe / name, chosen, progress=progress)
            truth = read_truth(capture / "ground_truth.npz")
            errors.append(measure(result, truth, data))
            bounds.append(measure(replace(result, vertices=known_head(data, result, truth)), truth, data))
    console = Console(width=100)
    console.print(table(errors, data, "registrations"))
    console.print(table(bounds, data, "the model, head known, neck known across"))


if __name__ == "__main__":
    main()
