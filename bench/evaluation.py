"""What head models are worth on people of the synthetic population, and how good any model of them could be.

    python -m bench.evaluation [--subjects 10] [--training 40 200] [--samples 100]

Held-out people that the first model does not span, with five expressions each, evaluated as `gnmreg model evaluate`
does. Beside the first model stand models of the true meshes of other people: what a rebuilt model could reach, if
registrations were perfect. A line's three figures: vertex to vertex; scan to surface, of 20,000 points of the true
face; specificity. One file, no timed test: seconds are wall-clock.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from coregister.evaluate.evaluation import EvaluationSettings, HeldOutSubject, evaluate
from coregister.first_model import assembly as anatomy_of
from coregister.first_model import build, makehuman, population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.build import TargetDisplacements
from coregister.synthetic import expressions
from registration.geometry.closest_point import barycentric_points
from registration.geometry.pca import dense_components
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

ACTS = ("smile", "jaw_open", "brows_up", "viseme_oo", "wink_left")
COMPONENTS = (10, 20, 40)
SCAN_POINTS = 20_000
_HELD_OUT_SEED, _TRAINING_SEED = 12345, 777


def people(anatomy: HeadAssembly, data: GNMData, targets: TargetDisplacements, count: int) -> list[HeldOutSubject]:
    rng = np.random.default_rng(_HELD_OUT_SEED)
    acts = [expressions.named(name) for name in ACTS]
    face = data.triangles[(regions.group(data, "hockey_mask") > 0.5)[data.triangles].all(1)]
    found = []
    for number in range(count):
        person = population.sample_unspanned_person(anatomy.source, rng)
        neutral, joints = anatomy.assemble(person, targets)
        a, b, c = (neutral[face[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        drawn = rng.choice(len(face), SCAN_POINTS, p=area / area.sum())
        found.append(
            HeldOutSubject(
                subject=f"person_{number}",
                neutral=neutral,
                expressions=np.stack([expressions.perform(anatomy, act, neutral, joints) for act in acts]),
                categories=tuple(act.category for act in acts),
                tags=person.tags,
                scan=barycentric_points(neutral, face, drawn, rng.dirichlet((1.0, 1.0, 1.0), SCAN_POINTS)),
            )
        )
    return found


def trained(anatomy: HeadAssembly, data: GNMData, targets: TargetDisplacements, count: int) -> GNMData:
    """The first model with the identity of other people's true meshes."""
    rng = np.random.default_rng(_TRAINING_SEED)
    heads = [
        anatomy.assemble(population.sample_unspanned_person(anatomy.source, rng), targets)[0] for _ in range(count)
    ]
    rows = np.stack(heads).reshape(count, -1)
    basis = dense_components(rows, 0.9999, centred=True)[0].reshape(-1, *heads[0].shape)
    return replace(
        data,
        template_vertex_positions=np.mean(heads, 0),
        vertex_identity_basis=basis,
        joint_identity_basis=np.zeros((len(basis), len(data.joint_names), 3)),
        identity_names=np.array([f"head_{k:03d}" for k in range(len(basis))]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=10)
    parser.add_argument("--training", type=int, nargs="*", default=[40, 200])
    parser.add_argument("--samples", type=int, default=100)
    arguments = parser.parse_args()
    data = gnm_npz.read(build.bootstrap())
    anatomy = anatomy_of.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    targets = TargetDisplacements(anatomy.source)
    subjects = people(anatomy, data, targets, arguments.subjects)
    models = {"first": data} | {f"true_{n}": trained(anatomy, data, targets, n) for n in arguments.training}
    for name, model in models.items():
        most = min(COMPONENTS[-1], len(model.vertex_identity_basis))
        components = (*(k for k in COMPONENTS if k < most), most)
        begun = time.perf_counter()
        settings = EvaluationSettings(components=components, samples=arguments.samples)
        one = evaluate({name: model}, subjects, model.triangles, settings).models[name]
        seconds = time.perf_counter() - begun
        for number, count in enumerate(one.identity.components):
            found = [one.identity, one.scans, one.specificity] if one.specificity else [one.identity, one.scans]
            told = [f"{curve.intervals[number].mean:.3f}" for curve in found if curve is not None]
            low, high = one.identity.intervals[number].low, one.identity.intervals[number].high
            print(f"{name} components {count} mm {' '.join(told)} interval {low:.3f} {high:.3f}", flush=True)
        for region, curve in one.expressions.items():
            told = " ".join(f"{k}:{found.mean:.3f}" for k, found in zip(curve.components, curve.intervals, strict=True))
            print(f"{name} {region} mm {told}")
        print(f"{name} unconverged {one.unconverged} seconds {seconds:.0f}", flush=True)


if __name__ == "__main__":
    main()
