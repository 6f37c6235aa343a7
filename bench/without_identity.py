"""Write a model that cannot represent one known person: their deviation is projected out of its identity basis.

    python -m bench.without_identity MODEL.npz SAMPLES.npz OUT.npz [--sample 0]

A fit with such a model shows how far vertices slide along the surface where no prior constrains them: the distance from
the scan does not measure it, the vertex error against the person's true mesh does. SAMPLES contains identity deltas
(S, V, 3) in metres, an array whose name contains "identity". Landmark schemes beside the model are copied beside the
new one.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.model import gnm_npz


def project_out(basis: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the basis (I, V, 3) without its part along `direction` (V, 3): every component is orthogonal to it."""
    unit = (direction / np.linalg.norm(direction)).astype(np.float64)
    rows = basis.astype(np.float64)
    return (rows - np.tensordot(rows, unit, 2)[:, None, None] * unit).astype(basis.dtype)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "samples", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--sample", type=int, default=0)
    options = parser.parse_args()
    data = gnm_npz.read(options.model)
    shape = data.template_vertex_positions.shape
    with np.load(options.samples) as samples:
        names = [name for name in samples.files if samples[name].shape[1:] == shape and "identity" in name]
        if not names:
            raise InputError(
                "No identity samples of this model",
                where=options.samples,
                expected=f"an array (S, {shape[0]}, 3) of identity deltas in metres",
                got=", ".join(f"{name} {samples[name].shape}" for name in samples.files),
                fix="pass the samples that belong to the model",
            )
        direction = samples[names[0]][options.sample]
    gnm_npz.write(replace(data, vertex_identity_basis=project_out(data.vertex_identity_basis, direction)), options.out)
    for scheme in options.model.parent.glob("head_sparse_*.txt"):
        shutil.copy(scheme, options.out.parent)
    print(f"{options.out}: without {names[0]}[{options.sample}]")


if __name__ == "__main__":
    main()
