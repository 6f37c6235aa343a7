"""The written file: the schema that google/GNM's loader checks, and its evaluation of the file against ours.

Google's code is used if the environment variable GNM_CHECKOUT names a clone of https://github.com/google/GNM, as for
`python -m bench.official_loader`. Without it, an evaluation by the published formula in NumPy takes its place, and the
figure's name says so.
"""

import os
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.anatomy_checks import Figure
from bench.official_loader import official_vertices, our_vertices, random_parameters
from coregister.anatomy.assemble import AnatomySettings, regenerate
from coregister.anatomy.teeth import TeethSettings
from coregister.anatomy.tongue import TongueSettings
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.gnm_numpy import evaluate

CHECKOUT = "GNM_CHECKOUT"
_COUNT = 4  # random heads


def figures(data: GNMData) -> Iterator[Figure]:
    """Write a model with all parts regenerated, from few samples, and read it."""
    few = AnatomySettings(teeth=TeethSettings(samples=120), tongue=TongueSettings(samples=60))
    made = regenerate(data, few)
    for name, count in made.anatomy["layout"].items():
        yield Figure(name=f"components: {name}", value=count, unit="")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "gnm_head.npz"
        gnm_npz.write(made.data, file)
        names = {Path(name).stem for name in zipfile.ZipFile(file).namelist()}
        yield Figure(
            name="fields outside the schema, or missing", value=len(names ^ set(gnm_npz.AXES)), unit="", most=0
        )
        read = gnm_npz.read(file)
        parameters = random_parameters(read, _COUNT, 0)
        ours = our_vertices(read, parameters)
        checkout = os.environ.get(CHECKOUT)
        if checkout:
            others, by = official_vertices(Path(checkout), file, sys.executable, "numpy", parameters), "google/GNM"
        else:
            rows = [{name: values[k].astype(float) for name, values in parameters.items()} for k in range(_COUNT)]
            others, by = np.stack([evaluate(read, **row) for row in rows]), f"the formula in NumPy (no {CHECKOUT})"
    worst = np.linalg.norm(ours - others, axis=2).max()
    yield Figure(name=f"vertices against {by}", value=float(worst), unit="m", most=1e-5)
