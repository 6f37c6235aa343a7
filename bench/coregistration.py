"""Two rounds of coregistration from the first model: what registrations teach a model about people it has not seen.

    python -m bench.coregistration [--out DIR] [--training 40] [--held-out 10] [--rounds 2] [--jobs 2]

A synthetic population of any adult age and build, neutrals only, 8 views of 256 x 256 (`gnmreg dataset synth`), goes
through the loop of `gnmreg coregister`. Held-out people are measured on their true meshes with the same number of
identity components for every model, in mm, in three ways: vertex to vertex on the head's skin, as `gnmreg model
evaluate` does; vertex to vertex on the whole outer skin by area; and surface to surface there, which is what scans see,
for it does not ask which vertex lies where on smooth skin, and no picture tells. Specificity: of 100 random heads from
the nearest of all true heads. `gain`: by which share of model 0's error the last model is nearer, with 20 components.
`negative_control`: the same of a model that is built from random heads of model 0 itself, as many as there are
subjects: what a build alone does. Run again with the same --out it goes on where it was interrupted.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from coregister.evaluate.evaluation import HeldOutSubject
from coregister.evaluate.linear_fit import LinearPart, fit_correspondence, identity_part
from coregister.evaluate.scan_fit import fit_scan
from coregister.evaluate.specificity import specificity_mm
from coregister.first_model import build as bootstrap
from coregister.next_model.build import build_model
from coregister.next_model.training_data import NEUTRAL, TrainingMesh, TrainingSubject
from coregister.stopping_rule import Rule
from coregister.synthetic.capture import Studio
from registration.capture.scan import read_truth
from registration.evaluate.distances import Surface, spread
from registration.geometry.topology import vertex_areas
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.progress import shown
from registration.render.studio.shoot import Quality
from workflows.engine.database import default_url
from workflows.engine.process import migrate
from workflows.farm.coregistration import coregister
from workflows.farm.plan import make_plan
from workflows.records.coregistration import FIRST
from workflows.records.held_out import read_held_out
from workflows.steps.hold_out import PEOPLE
from workflows.steps.synthesize import Population, synth_dataset

COMPONENTS = (10, 20, 40)
AT = "20"  # what counts
SAMPLES = 100
CONTROL = "control"
POINTS = 2000  # of a true surface
STUDIO = Studio(cameras=8, size_px=(256, 256), texture_size=512, quality=Quality(pixel_samples=2, light_rays=32))


def own_samples(data: GNMData, count: int, seed: int) -> list[TrainingSubject]:
    """Random heads of a model, coefficients of unit variance, seen everywhere."""
    drawn = np.random.default_rng(seed).standard_normal((count, len(data.vertex_identity_basis)))
    heads = data.template_vertex_positions + np.tensordot(drawn, data.vertex_identity_basis, 1)
    sure = np.ones(len(data.template_vertex_positions), np.float32)
    subjects = []
    for number, head in enumerate(heads.astype(np.float32)):
        mesh = TrainingMesh(name=NEUTRAL, label=NEUTRAL, vertices=head, confidence=sure, triangles=data.triangles)
        subjects.append(TrainingSubject(name=f"sample_{number:03d}", neutral=mesh))
    return subjects


def surface_part(data: GNMData) -> LinearPart:
    """Return the identity components on the whole exterior skin, vertices weighted by area."""
    part = identity_part(data, regions.exterior(data))
    area = vertex_areas(data.template_vertex_positions, data.triangles)[part.rows]
    return replace(part, weights=area / area.mean())


def vertices_mm(data: GNMData, people: Sequence[HeldOutSubject], part: LinearPart) -> dict[str, float]:
    """Number of components -> mean distance between the same vertices, over the people."""
    counts = [k for k in COMPONENTS if k <= len(part.basis)]
    found = [fit_correspondence(part, one.neutral[part.rows], counts) for one in people]
    means = np.array([[part.mean(one.distance_mm) for one in fits] for fits in found]).mean(0)
    return dict(zip(map(str, counts), means.tolist(), strict=True))


def surface_mm(data: GNMData, people: Sequence[HeldOutSubject], part: LinearPart) -> dict[str, float]:
    """The same of points of the true surface, spread by area, from the model's, with the number that counts."""
    count, outside = int(AT), identity_part(data, regions.exterior(data))
    if count > len(part.basis):
        return {}
    found = []
    for number, one in enumerate(people):
        start = fit_correspondence(part, one.neutral[part.rows], [count])
        truth = Surface(vertices=one.neutral[outside.rows].astype(np.float64), triangles=outside.triangles)
        points, _ = spread(truth, POINTS, seed=number)
        found.append(fit_scan(outside, points, start)[0].distance_mm.mean())
    return {AT: float(np.mean(found))}


def specific_mm(data: GNMData, truths: np.ndarray) -> float:
    """How far random heads are from the nearest real one, with the number of components that counts."""
    part = identity_part(data)
    if int(AT) > len(part.basis):
        return float("nan")
    return float(specificity_mm(part, truths[:, part.rows], (int(AT),), samples=SAMPLES).mean())


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
    people = Population(subjects=count, seed=options.seed, held_out=options.held_out, studio=STUDIO)
    begun = time.perf_counter()
    with shown() as progress:
        synth_dataset(options.out / "dataset", people, jobs=options.jobs, progress=progress)
        captured = time.perf_counter()
        plan = make_plan(
            options.out / "dataset",
            model_path=first,
            out=options.out / "rounds",
            recipe=options.recipe,
            seed=options.seed,
            components=COMPONENTS,
            samples=SAMPLES,
            rule=Rule(rounds=options.rounds, failures=1.0, early=False),
        )
        farm = options.out / "farm"
        url = default_url(farm)
        migrate(url)
        told = coregister(plan, url=url, folder=farm, workers=options.jobs, progress=progress)
    if "stopped" in told:
        sys.exit(told["stopped"])
    print(f"captures {count} seconds {captured - begun:.0f}; rounds {time.perf_counter() - captured:.0f}")
    people = read_held_out(options.out / "rounds" / "held_out" / PEOPLE).subjects
    models = {name: gnm_npz.read(Path(file)) for name, file in told["models"].items()}
    samples = own_samples(models[FIRST], options.training, options.seed)
    models[CONTROL] = build_model(samples, models[FIRST]).data
    figures = {}
    for measure, (distance_mm, part_of) in MEASURES.items():
        print(f"{measure:44}" + "".join(f"{k:>9} mm" for k in COMPONENTS))
        for name, data in models.items():
            row = figures[measure, name] = distance_mm(data, people, part_of(data))
            print(f"{name:44}" + "".join(f"{row[str(k)]:12.3f}" if str(k) in row else f"{'–':>12}" for k in COMPONENTS))
    for one in told["rounds"]:
        print(f"{one['name']} {one['decide']} rejected {[r['name'] for r in one['build']['rejected']]}")
    names = list(told["models"])
    truths = np.stack([read_truth(file) for file in sorted((options.out / "dataset").glob("*/*/ground_truth.npz"))])
    for number, name in enumerate(names):
        print(f"specificity {number} {specific_mm(models[name], truths):.3f}")
    for measure in MEASURES:  # the last lines are of the last one
        before, after = figures[measure, FIRST][AT], figures[measure, names[-1]].get(AT, np.nan)
        print(f"{measure}:")
        print(f"negative_control {1 - figures[measure, CONTROL].get(AT, np.nan) / before:.3f}")
        for number, name in enumerate(names):
            print(f"generalization_mm {number} {figures[measure, name].get(AT, float('nan')):.3f}")
        print(f"gain {1 - after / before:.3f}")


if __name__ == "__main__":
    main()
