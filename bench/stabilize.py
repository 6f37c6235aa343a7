"""Stabilization against known truth: does the skull stand still, and are expressions what they were?

    python -m bench.stabilize [--subjects 20] [--run SUBJECT_OUT --model MODEL.npz] [--size]

Subjects that the first model does not span perform 20 expressions; their heads are turned by up to 5 degrees and moved
by up to 10 mm, with noise of 0.3 mm (smooth over 15 mm) and 0.1 mm (white) in each coordinate, and a tenth of the
vertices unseen and wrong. `--run` takes a subject's registrations and applies 50 motions to their vertices; `--size`
times 300 samples of 17,821 vertices. mm: rms displacement of the face mask by the motion that is left.
"""

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from coregister import anatomy as anatomy_of
from coregister import bootstrap, makehuman, population
from registration.artifacts import load_registration
from registration.geometry.rigid import align
from registration.model import gnm_npz
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.meshes import SkullSkin
from tests.stabilize import measures, performed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=20)
    arguments = parser.parse_args()
    data = gnm_npz.read(bootstrap.bootstrap())
    anatomy = anatomy_of.make(makehuman.read(makehuman.fetch()), population.mean_person())
    skin = SkullSkin.of(data)
    found, plain = [], []
    for number in range(arguments.subjects):
        truth = performed.perform(anatomy, 1000 + number)
        seen = performed.seen(truth, number)
        result = stabilize_subject(performed.meshes(truth, seen), skin)
        found.append(measures.left(result.T_neutral_expression, seen, truth, data))
        procrustes = align(seen.vertices, seen.neutral, np.ones(seen.confidence.shape))
        plain.append(measures.left(procrustes, seen, truth, data))
    deg, mm = np.concatenate(found, 1)
    print(f"median_deg {np.median(deg):.3f}")
    print(f"median_mm {np.median(mm):.3f}")
    print(f"p95_mm {np.percentile(mm, 95):.3f}")
    print(f"procrustes_mm {np.median(np.concatenate(plain, 1)[1]):.3f}")


if __name__ == "__main__":
    main()
