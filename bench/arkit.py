"""Measure ARKit's shapes of a head model: coverage, residual and motion elsewhere, and what eyelids and lips do.

    python -m bench.arkit [MODEL.npz]

The shapes are solved on the model's template; without a file, the first model's.
"""

import argparse
from pathlib import Path

import numpy as np

from coregister.first_model.build import bootstrap
from registration.export.arkit import NAMES, arkit_shapes
from registration.export.arkit_anatomy import Anatomy, lid_aperture
from registration.model import gnm_npz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", type=Path, help="a GNM NPZ file (default: the first model)")
    data = gnm_npz.read(parser.parse_args().model or bootstrap())
    points = data.template_vertex_positions.astype(np.float64)
    found, head = arkit_shapes(data, points), Anatomy.of(data, points)
    every = {**found.shapes, **found.missing}
    print(f"{'shape':20} coverage  residual mm  elsewhere mm  largest mm")
    for name in NAMES:
        shape = every[name]
        largest = 1e3 * np.linalg.norm(shape.displacement, axis=1).max()
        figures = f"{shape.coverage:8.3f} {shape.residual_mm:12.2f} {shape.elsewhere_mm:13.2f} {largest:11.1f}"
        print(f"{name:20} {figures}{'' if name in found.shapes else '  left out'}")
    moved = {name: points + shape.displacement for name, shape in every.items()}
    print(f"left eye at rest {1e3 * head.aperture:.2f} mm,", end=" ")
    for name in ("eyeBlinkLeft", "eyeWideLeft", "eyeBlinkRight"):
        print(f"{name} {1e3 * lid_aperture(head, moved[name]):.2f} mm", end=", " if name != "eyeBlinkRight" else "\n")
    upper, lower = head.areas["upper_edge"], head.areas["lower_edge"]
    closed = moved["jawOpen"] + every["mouthClose"].displacement
    for name, place in (("at rest", points), ("jawOpen", moved["jawOpen"]), ("jawOpen + mouthClose", closed)):
        print(f"between the lips, {name}: {1e3 * (place[upper].mean(0) - place[lower].mean(0))[1]:.2f} mm")


if __name__ == "__main__":
    main()
