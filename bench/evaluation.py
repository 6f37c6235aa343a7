"""Evaluate head models on held-out subjects of the synthetic population, and the best models that its meshes allow.

    python -m bench.evaluation [--subjects 10] [--training 40 200] [--samples 100]

Held-out subjects outside the first model's span, with five expressions each, are evaluated as by `gnmreg model
evaluate`. The first model is compared with principal components of other subjects' true meshes, which is what perfect
registrations would give. Each row has three distances: vertex to vertex; scan to surface, for 20,000 points of the true
face; specificity. Seconds are wall-clock time.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from bench.support.population import true_neutrals
from coregister.evaluate.evaluation import EvaluationSettings, HeldOutSubject, evaluate
from coregister.first_model import assembly, build, makehuman, population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.build import TargetDisplacements
from coregister.synthetic import expressions
from registration.geometry.closest_point import barycentric_points
from registration.geometry.pca import dense_components
from registration.geometry.surface_samples import sample_surface
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

EXPRESSIONS = ("smile", "jaw_open", "brows_up", "viseme_oo", "wink_left")
COMPONENTS = (10, 20, 40)
SCAN_POINTS = 20_000
_HELD_OUT_SEED, _TRAINING_SEED = 12345, 777


def held_out_subjects(
    head: HeadAssembly, data: GNMData, displacements: TargetDisplacements, count: int
) -> list[HeldOutSubject]:
    """Return random subjects with expressions and points of the true face."""
    rng = np.random.default_rng(_HELD_OUT_SEED)
    performed = [expressions.expression_by_name(name) for name in EXPRESSIONS]
    face = data.triangles[(regions.group(data, "hockey_mask") > 0.5)[data.triangles].all(1)]
    subjects = []
    for number in range(count):
        person = population.sample_unspanned_person(head.source, rng)
        neutral, joints = head.assemble(person, displacements)
        triangles, barycentric = sample_surface(neutral, face, SCAN_POINTS, rng)
        subjects.append(
            HeldOutSubject(
                subject=f"person_{number}",
                neutral=neutral,
                expressions=np.stack([expressions.apply_expression(head, item, neutral, joints) for item in performed]),
                categories=tuple(expression.category for expression in performed),
                tags=person.tags,
                scan=barycentric_points(neutral, face, triangles, barycentric),
            )
        )
    return subjects


def model_of_true_meshes(head: HeadAssembly, data: GNMData, displacements: TargetDisplacements, count: int) -> GNMData:
    """Return the first model with template and identity basis of other subjects' true meshes."""
    heads = true_neutrals(head, displacements, count, np.random.default_rng(_TRAINING_SEED))
    basis = dense_components(heads.reshape(count, -1), 0.9999, centred=True)[0].reshape(-1, *heads.shape[1:])
    return replace(
        data,
        template_vertex_positions=np.mean(heads, 0),
        vertex_identity_basis=basis,
        joint_identity_basis=np.zeros((len(basis), len(data.joint_names), 3)),
        identity_names=np.array([f"head_{k:03d}" for k in range(len(basis))]),
    )


def print_metrics(name: str, model: GNMData, subjects: list[HeldOutSubject], samples: int) -> None:
    """Evaluate one model and print its distances."""
    available = min(COMPONENTS[-1], len(model.vertex_identity_basis))
    components = (*(k for k in COMPONENTS if k < available), available)
    start = time.perf_counter()
    settings = EvaluationSettings(components=components, samples=samples)
    metrics = evaluate({name: model}, subjects, model.triangles, settings).models[name]
    seconds = time.perf_counter() - start
    curves = [curve for curve in (metrics.identity, metrics.scans, metrics.specificity) if curve is not None]
    for index, count in enumerate(metrics.identity.components):
        means = " ".join(f"{curve.intervals[index].mean:.3f}" for curve in curves)
        interval = metrics.identity.intervals[index]
        print(f"{name} components {count} mm {means} interval {interval.low:.3f} {interval.high:.3f}", flush=True)
    for region, curve in metrics.expressions.items():
        means = " ".join(f"{k}:{i.mean:.3f}" for k, i in zip(curve.components, curve.intervals, strict=True))
        print(f"{name} {region} mm {means}")
    print(f"{name} unconverged {metrics.unconverged} seconds {seconds:.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=10)
    parser.add_argument("--training", type=int, nargs="*", default=[40, 200])
    parser.add_argument("--samples", type=int, default=100)
    options = parser.parse_args()
    data = gnm_npz.read(build.bootstrap())
    head = assembly.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    displacements = TargetDisplacements(head.source)
    subjects = held_out_subjects(head, data, displacements, options.subjects)
    print_metrics("first", data, subjects, options.samples)
    for count in options.training:
        model = model_of_true_meshes(head, data, displacements, count)
        print_metrics(f"true_{count}", model, subjects, options.samples)


if __name__ == "__main__":
    main()
