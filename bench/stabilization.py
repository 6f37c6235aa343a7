"""Measure the accuracy of stabilization on known motions: remaining head motion, and energy lost by expressions.

    python -m bench.stabilization [--subjects 20]
    python -m bench.stabilization --run OUT --model MODEL.npz

Subjects outside the first model's span have 20 expressions; their heads are rotated by up to 5 degrees and translated
by up to 10 mm, with noise of 0.3 mm (smooth over 15 mm) and 0.1 mm (white) in each coordinate, and a tenth of the
vertices unobserved and wrong. mm: rms displacement of the face mask by the remaining motion; body_stays: of heads that
rotate on their necks. Then rigid motions of two kinds (1 degree and 2 mm, one standard deviation) are added to a third
of the true samples, for the regional stage to remove; the worst of five draws. `--run` reads a subject's registrations,
as `gnmreg subject` wrote them, and applies 50 motions to their vertices. Seconds are wall-clock time.
"""

import argparse
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.support import performances, stabilization_measures
from coregister.first_model import assembly, build, makehuman, population
from registration.geometry.rigid import align
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.components import HeadGeometry
from registration.stabilize.pipeline import (
    Stabilization,
    StabilizedSubject,
    apply_corrections,
    automatic_stage,
    regional_stage,
)
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes
from workflows.records.run import read_run

DRAWS = 5
MOTIONS = 50


def measure_population(subjects: int) -> None:
    """Print all metrics for synthetic subjects, the headline ones last."""
    data = gnm_npz.read(build.bootstrap())
    head_assembly = assembly.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    truths = [performances.true_subject(head_assembly, 1000 + number) for number in range(subjects)]
    results = [stabilization_measures.remove_injected_motion(truths, data, seed) for seed in range(DRAWS)]
    print(f"spurious_energy_reduced {min(result.reduced for result in results):.3f}")
    print(f"spurious_expression_lost {max(result.lost for result in results):.4f}")
    skin, head, settings = SkullSkin.from_model(data), HeadGeometry.from_model(data), Stabilization()
    stabilized: list[StabilizedSubject] = []
    remaining, procrustes_mm, neck_mm, seconds = [], [], [], 0.0
    for number, truth in enumerate(truths):
        observed = performances.observe(truth, number)
        meshes = performances.observed_meshes(truth, observed)
        start = time.perf_counter()
        stabilized.append(automatic_stage(meshes, head, skin, settings))
        seconds += time.perf_counter() - start
        remaining.append(
            stabilization_measures.remaining_motion(stabilized[-1].T_neutral_expression, observed, truth, data)
        )
        on_necks = stabilize_subject(
            performances.observed_meshes(truth, performances.with_still_body(observed, data)), skin
        )
        neck_mm.append(stabilization_measures.remaining_motion(on_necks.T_neutral_expression, observed, truth, data)[1])
        procrustes = align(observed.vertices, observed.neutral, np.ones(observed.confidence.shape))
        procrustes_mm.append(stabilization_measures.remaining_motion(procrustes, observed, truth, data)[1])
    samples = sum(len(subject.names) for subject in stabilized)
    print(f"automatic_seconds {seconds:.1f}  # {samples} samples of {len(head.points):,} vertices")
    start = time.perf_counter()
    _, corrections = regional_stage(lambda: iter(stabilized), head, settings)
    final = [apply_corrections(subject, corrections, performances.COUNT * k) for k, subject in enumerate(stabilized)]
    print(f"regional_seconds {time.perf_counter() - start:.1f}")
    print(f"peak_gb {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f}")
    deg, mm = np.concatenate(remaining, 1)
    print(f"body_stays_median_mm {np.median(np.concatenate(neck_mm)):.3f}")
    print(f"p95_deg {np.percentile(deg, 95):.3f}")
    print(f"median_deg {np.median(deg):.3f}")
    print(f"median_mm {np.median(mm):.3f}")
    print(f"p95_mm {np.percentile(mm, 95):.3f}")
    print(f"procrustes_mm {np.median(np.concatenate(procrustes_mm)):.3f}")
    print(f"energy_lost {max(stabilization_measures.energy_lost(final, truths, head).values()):.4f}")


def measure_run(run: Path, data: GNMData) -> None:
    """Print the remaining motion for registrations of one pose, to which known motions are added."""
    skin, rng = SkullSkin.from_model(data), np.random.default_rng(0)
    remaining = []
    for meshes in read_run(run, data).meshes():
        face = meshes.neutral[stabilization_measures.face_mask(data)].astype(np.float64)
        for motions in _random_motions(meshes, rng):
            result = stabilize_subject(performances.transformed(meshes, motions), skin)
            remaining.append(stabilization_measures.motion_size(result.T_neutral_expression @ motions, face))
    deg, mm = np.concatenate(remaining, 1)[:, :MOTIONS]
    print(f"run_median_deg {np.median(deg):.3f}\nrun_median_mm {np.median(mm):.3f}\nrun_worst_mm {mm.max():.3f}")


def _random_motions(meshes: SubjectMeshes, rng: np.random.Generator) -> Iterator[np.ndarray]:
    for _ in range(-(-MOTIONS // len(meshes.names))):
        yield np.stack([performances.random_motion(rng, 5.0, 10.0, meshes.neutral.mean(0)) for _ in meshes.names])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=20)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--model", type=Path)
    arguments = parser.parse_args()
    if arguments.run is None:
        measure_population(arguments.subjects)
    else:
        measure_run(arguments.run, gnm_npz.read(arguments.model))


if __name__ == "__main__":
    main()
