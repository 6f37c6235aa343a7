"""Stabilization against known truth: does the skull stand still, and are expressions what they were?

    python -m bench.stabilization [--subjects 20]
    python -m bench.stabilization --run OUT --model MODEL.npz

Subjects that the first model does not span perform 20 expressions; their heads are turned by up to 5 degrees and moved
by up to 10 mm, with noise of 0.3 mm (smooth over 15 mm) and 0.1 mm (white) in each coordinate, and a tenth of the
vertices unseen and wrong. mm: rms displacement of the face mask by the motion that is left; body_stays: of heads that
turn on their necks. Then rigid motions of two kinds (1 degree and 2 mm, one standard deviation) are put into a third
of the true samples, which the second stage is to find; the worst of five draws. `--run` takes a subject's
registrations, as `gnmreg subject` wrote them, and applies 50 motions to their vertices. Seconds are wall-clock.
"""

import argparse
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.support import performances, stabilization_measures
from coregister.first_model import assembly as anatomy_of
from coregister.first_model import build, makehuman, population
from registration.geometry.rigid import align
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.components import Head
from registration.stabilize.pipeline import (
    Stabilization,
    StabilizedSubject,
    automatic_stage,
    corrected,
    regional_stage,
)
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes
from workflows.records.run import read_run

DRAWS = 5
MOTIONS = 50


def population_bench(subjects: int) -> None:
    """The figures that count, last."""
    data = gnm_npz.read(build.bootstrap())
    anatomy = anatomy_of.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    truths = [performances.perform(anatomy, 1000 + number) for number in range(subjects)]
    injected = [stabilization_measures.injected(truths, data, seed) for seed in range(DRAWS)]
    print(f"spurious_energy_reduced {min(found.reduced for found in injected):.3f}")
    print(f"spurious_expression_lost {max(found.lost for found in injected):.4f}")
    skin, head, settings = SkullSkin.of(data), Head.of(data), Stabilization()
    steady: list[StabilizedSubject] = []
    figures, plain, necks, seconds = [], [], [], 0.0
    for number, truth in enumerate(truths):
        seen = performances.seen(truth, number)
        meshes = performances.meshes(truth, seen)
        begun = time.perf_counter()
        steady.append(automatic_stage(meshes, head, skin, settings))
        seconds += time.perf_counter() - begun
        figures.append(stabilization_measures.left(steady[-1].T_neutral_expression, seen, truth, data))
        turned = stabilize_subject(performances.meshes(truth, performances.body_stays(seen, data)), skin)
        necks.append(stabilization_measures.left(turned.T_neutral_expression, seen, truth, data)[1])
        procrustes = align(seen.vertices, seen.neutral, np.ones(seen.confidence.shape))
        plain.append(stabilization_measures.left(procrustes, seen, truth, data)[1])
    samples = sum(len(subject.names) for subject in steady)
    print(f"automatic_seconds {seconds:.1f}  # {samples} samples of {len(head.points):,} vertices")
    begun = time.perf_counter()
    _, correction = regional_stage(lambda: iter(steady), head, settings)
    final = [corrected(subject, correction, performances.COUNT * k) for k, subject in enumerate(steady)]
    print(f"regional_seconds {time.perf_counter() - begun:.1f}")
    print(f"peak_gb {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}")
    deg, mm = np.concatenate(figures, 1)
    print(f"body_stays_median_mm {np.median(np.concatenate(necks)):.3f}")
    print(f"p95_deg {np.percentile(deg, 95):.3f}")
    print(f"median_deg {np.median(deg):.3f}")
    print(f"median_mm {np.median(mm):.3f}")
    print(f"p95_mm {np.percentile(mm, 95):.3f}")
    print(f"procrustes_mm {np.median(np.concatenate(plain)):.3f}")
    print(f"energy_lost {max(stabilization_measures.lost_by_label(final, truths, head).values()):.4f}")


def moved_run(run: Path, data: GNMData) -> None:
    """Registrations whose skulls are known to stand still (one pose in all captures), set in motion."""
    skin, rng = SkullSkin.of(data), np.random.default_rng(0)
    found = []
    for meshes in read_run(run, data).meshes():
        face = meshes.neutral[stabilization_measures.face(data)].astype(np.float64)
        for motions in _rounds(meshes, rng):
            result = stabilize_subject(performances.moved(meshes, motions), skin)
            found.append(stabilization_measures.residual(result.T_neutral_expression @ motions, face))
    deg, mm = np.concatenate(found, 1)[:, :MOTIONS]
    print(f"run_median_deg {np.median(deg):.3f}\nrun_median_mm {np.median(mm):.3f}\nrun_worst_mm {mm.max():.3f}")


def _rounds(meshes: SubjectMeshes, rng: np.random.Generator) -> Iterator[np.ndarray]:
    for _ in range(-(-MOTIONS // len(meshes.names))):
        yield np.stack([performances.motion(rng, 5.0, 10.0, meshes.neutral.mean(0)) for _ in meshes.names])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=20)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--model", type=Path)
    arguments = parser.parse_args()
    if arguments.run is None:
        population_bench(arguments.subjects)
    else:
        moved_run(arguments.run, gnm_npz.read(arguments.model))


if __name__ == "__main__":
    main()
