"""Run rounds of coregistration on a synthetic population and measure how much the model improves.

    python -m bench.coregistration [--out DIR] [--training 40] [--held-out 10] [--rounds 2] [--jobs 2]

Neutrals of any adult age and build, 8 views of 256 x 256 px (`gnmreg dataset synth`), go through the loop of `gnmreg
coregister`. Models are evaluated on the true meshes of held-out subjects with the same numbers of identity components,
in mm, by three measures: vertex to vertex on the head's skin, as by `gnmreg model evaluate`; vertex to vertex on the
whole exterior skin, weighted by area; and surface to surface there, which is what scans measure: it does not depend on
the position of vertices along smooth skin, which images do not determine. Specificity: of 100 random heads from the
nearest true head. `gain`: relative reduction of model 0's distance by the last model, with 20 components.
`negative_control`: the same for a model that is built from as many random heads of model 0 itself: the effect of
building alone. `true_meshes`: the same for one that is built from the true meshes of the training subjects: what exact
registrations would gain, so that the difference is what registrations lose. With the same --out an interrupted run is
resumed.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.support.population import observed_everywhere
from coregister.evaluate.evaluation import HeldOutSubject
from coregister.evaluate.linear_fit import LinearPart, fit_correspondence, identity_part
from coregister.evaluate.scan_fit import fit_scan
from coregister.evaluate.specificity import specificity_mm
from coregister.first_model import build as bootstrap
from coregister.next_model.build import build_model
from coregister.next_model.training_data import NEUTRAL, TrainingSubject
from coregister.stopping_rule import StoppingRule
from coregister.synthetic.capture import Studio
from registration.capture.scan import read_truth
from registration.geometry.closest_point import barycentric_points
from registration.geometry.surface_samples import sample_surface
from registration.geometry.topology import vertex_areas
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.options import RegisterOptions
from registration.progress import console_progress
from registration.render.studio.shoot import Quality
from workflows.engine.database import default_url
from workflows.engine.process import migrate
from workflows.farm.coregistration import coregister
from workflows.farm.plan import RoundSettings, make_plan
from workflows.records.held_out import read_held_out
from workflows.records.round_files import FIRST_MODEL as FIRST
from workflows.steps.hold_out import HELD_OUT
from workflows.steps.synthesize import Population, synth_dataset

COMPONENTS = (10, 20, 40)
HEADLINE = "20"  # number of components of the gain
SAMPLES = 100
CONTROL, EXACT = "control", "true meshes"
POINTS = 2000  # of each true surface
STUDIO = Studio(cameras=8, size_px=(256, 256), texture_size=512, quality=Quality(pixel_samples=2, light_rays=32))


def model_samples(data: GNMData, count: int, seed: int) -> list[TrainingSubject]:
    """Return random heads of a model, coefficients of unit variance, observed everywhere."""
    coefficients = np.random.default_rng(seed).standard_normal((count, len(data.vertex_identity_basis)))
    heads = data.template_vertex_positions + np.tensordot(coefficients, data.vertex_identity_basis, 1)
    return observed_everywhere({f"sample_{number:03d}": head for number, head in enumerate(heads)}, data.triangles)


def surface_part(data: GNMData) -> LinearPart:
    """Return the identity components on the whole exterior skin, vertices weighted by area."""
    part = identity_part(data, regions.exterior(data))
    area = vertex_areas(data.template_vertex_positions, data.triangles)[part.rows]
    return replace(part, weights=area / area.mean())


def vertices_mm(data: GNMData, subjects: Sequence[HeldOutSubject], part: LinearPart) -> dict[str, float]:
    """Return number of components -> mean distance between corresponding vertices over the subjects."""
    counts = [k for k in COMPONENTS if k <= len(part.basis)]
    fits = [fit_correspondence(part, subject.neutral[part.rows], counts) for subject in subjects]
    means = np.array([[part.mean(fit.distance_mm) for fit in subject_fits] for subject_fits in fits]).mean(0)
    return dict(zip(map(str, counts), means.tolist(), strict=True))


def surface_mm(data: GNMData, subjects: Sequence[HeldOutSubject], part: LinearPart) -> dict[str, float]:
    """Return the mean distance of points of the true surface from the model's, with HEADLINE components."""
    count, exterior = int(HEADLINE), identity_part(data, regions.exterior(data))
    if count > len(part.basis):
        return {}
    distances = []
    for number, subject in enumerate(subjects):
        initial = fit_correspondence(part, subject.neutral[part.rows], [count])
        vertices = subject.neutral[exterior.rows].astype(np.float64)
        samples = sample_surface(vertices, exterior.triangles, POINTS, np.random.default_rng(number))
        points = barycentric_points(vertices, exterior.triangles, *samples)
        distances.append(fit_scan(exterior, points, initial)[0].distance_mm.mean())
    return {HEADLINE: float(np.mean(distances))}


def mean_specificity_mm(data: GNMData, truths: np.ndarray) -> float:
    """Return the mean distance of random heads from the nearest true one, with HEADLINE components."""
    part = identity_part(data)
    if int(HEADLINE) > len(part.basis):
        return float("nan")
    return float(specificity_mm(part, truths[:, part.rows], (int(HEADLINE),), samples=SAMPLES).mean())


MEASURES = {
    "head's skin, vertex to vertex": (vertices_mm, identity_part),
    "outer skin by area, vertex to vertex": (vertices_mm, surface_part),
    "outer skin by area, surface to surface": (surface_mm, surface_part),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/bench_coregistration"))
    parser.add_argument("--training", type=int, default=40)
    parser.add_argument("--held-out", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--recipe", default="preview")
    options = parser.parse_args()
    count = options.training + options.held_out
    first = bootstrap.bootstrap(options.out / "first" / "gnm_head_first.npz")
    population = Population(subjects=count, seed=options.seed, held_out=options.held_out, studio=STUDIO)
    start = time.perf_counter()
    with console_progress() as progress:
        synth_dataset(options.out / "dataset", population, jobs=options.jobs, progress=progress)
        captured = time.perf_counter()
        plan = make_plan(
            options.out / "dataset",
            first,
            options.out / "rounds",
            RegisterOptions(recipe=options.recipe, seed=options.seed),
            RoundSettings(
                components=COMPONENTS,
                samples=SAMPLES,
                rule=StoppingRule(max_rounds=options.rounds, max_failure_rate=1.0, early_stopping=False),
            ),
        )
        farm = options.out / "farm"
        url = default_url(farm)
        migrate(url)
        result = coregister(plan, url=url, folder=farm, workers=options.jobs, progress=progress)
    if result.stopped:
        sys.exit(result.stopped)
    print(f"captures {count} seconds {captured - start:.0f}; rounds {time.perf_counter() - captured:.0f}")
    subjects = read_held_out(options.out / "rounds" / "held_out" / HELD_OUT).subjects
    models = {name: gnm_npz.read(Path(file)) for name, file in result.state.models.items()}
    names = list(models)
    samples = model_samples(models[FIRST], options.training, options.seed)
    models[CONTROL] = build_model(samples, models[FIRST]).data
    held_out = {subject.subject for subject in subjects}
    exact = {
        name: read_truth(options.out / "dataset" / name / NEUTRAL / "ground_truth.npz")
        for name in population.seeds
        if name not in held_out
    }
    models[EXACT] = build_model(observed_everywhere(exact, models[FIRST].triangles), models[FIRST]).data
    distances = print_distances(models, subjects)
    for round_ in result.state.rounds:
        rejected = [registration.name for registration in round_.build.rejected]
        print(f"{round_.name} {round_.decide} rejected {rejected}")
    truths = np.stack([read_truth(file) for file in sorted((options.out / "dataset").glob("*/*/ground_truth.npz"))])
    for number, name in enumerate(names):
        print(f"specificity {number} {mean_specificity_mm(models[name], truths):.3f}")
    print_gains(distances, names)


def print_distances(
    models: dict[str, GNMData], subjects: Sequence[HeldOutSubject]
) -> dict[tuple[str, str], dict[str, float]]:
    """Print a table for each measure; return (measure, model) -> number of components -> mm."""
    distances = {}
    for measure, (distance_mm, part_of) in MEASURES.items():
        print(f"{measure:44}" + "".join(f"{k:>9} mm" for k in COMPONENTS))
        for name, data in models.items():
            row = distances[measure, name] = distance_mm(data, subjects, part_of(data))
            print(f"{name:44}" + "".join(f"{row[str(k)]:12.3f}" if str(k) in row else f"{'–':>12}" for k in COMPONENTS))
    return distances


def print_gains(distances: dict[tuple[str, str], dict[str, float]], names: Sequence[str]) -> None:
    """Print distances and gain with HEADLINE components; the last rows are those of the last measure."""
    for measure in MEASURES:
        first, last = distances[measure, FIRST][HEADLINE], distances[measure, names[-1]].get(HEADLINE, np.nan)
        print(f"{measure}:")
        for label, name in (("negative_control", CONTROL), ("true_meshes", EXACT)):
            print(f"{label} {1 - distances[measure, name].get(HEADLINE, np.nan) / first:.3f}")
        for number, name in enumerate(names):
            print(f"generalization_mm {number} {distances[measure, name].get(HEADLINE, np.nan):.3f}")
        print(f"gain {1 - last / first:.3f}")


if __name__ == "__main__":
    main()
