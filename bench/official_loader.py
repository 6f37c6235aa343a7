"""Whether google/GNM's own published code reads a model file of ours and makes the same vertices of it.

    python -m bench.official_loader CHECKOUT MODEL.npz [--python THEIRS] [--backend numpy]

CHECKOUT is a clone of https://github.com/google/GNM. Its package is copied to a temporary folder, MODEL takes the place
of its head model there, and `GNM.from_local` of the backend reads it, with its checks, in a process of its own. THEIRS
is the Python to do that with: one that has what the package needs, say

    python -m venv gnm && gnm/bin/pip install "etils[epath,enp]" absl-py numpy      and torch or jax for those backends

Random identities, expressions, rotations of all joints and translations go through both; the last line is the largest
distance of a vertex from its twin. Ours are computed in float32, as theirs are.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.types import Parameters

THEIRS = """
import importlib, sys
import numpy as np
backend, given, out = sys.argv[1:]
theirs = importlib.import_module(f"gnm.shape.gnm_{backend}")
model = theirs.GNM.from_local(version=theirs.GNMMajorVersion.V3, variant=theirs.GNMVariant.HEAD)
names = ("identity", "expression", "rotations", "translation")
array = importlib.import_module("torch").as_tensor if backend == "pytorch" else np.asarray
with np.load(given) as drawn:
    np.save(out, np.asarray(model(*(array(drawn[name]) for name in names))))
"""


def drawn(data: GNMData, count: int, seed: int) -> dict[str, np.ndarray]:
    """Random parameters, float32: coefficients of unit variance, turns of about ten degrees."""
    rng = np.random.default_rng(seed)
    shapes = {
        "identity": (1.0, (len(data.vertex_identity_basis),)),
        "expression": (1.0, (len(data.expression_basis),)),
        "rotations": (0.2, (len(data.joint_names), 3)),
        "translation": (0.3, (3,)),
    }
    return {name: rng.normal(0, size, (count, *shape)).astype(np.float32) for name, (size, shape) in shapes.items()}


def theirs(checkout: Path, model: Path, python: str, backend: str, parameters: dict[str, np.ndarray]) -> np.ndarray:
    """Vertices (N, V, 3) by the checkout's code."""
    source = checkout / "gnm" / "shape"
    if not (source / f"gnm_{backend}.py").is_file():
        raise InputError(
            "That is no checkout of google/GNM",
            where=checkout,
            expected=f"gnm/shape/gnm_{backend}.py in it",
            got="no such file",
            fix="clone https://github.com/google/GNM and give that folder",
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(source, folder / "gnm" / "shape", ignore=shutil.ignore_patterns("*.npz", "*.h5", "assets"))
        place = folder / "gnm" / "shape" / "data" / "versions" / "v3_0" / "gnm_head.npz"
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(model, place)
        np.savez(folder / "given.npz", allow_pickle=False, **parameters)
        command = [python, "-c", THEIRS, backend, str(folder / "given.npz"), str(folder / "vertices.npy")]
        subprocess.run(command, cwd=folder, check=True)
        return np.asarray(np.load(folder / "vertices.npy"), np.float64)


def ours(data: GNMData, parameters: dict[str, np.ndarray]) -> np.ndarray:
    """The same by `registration.model.gnm`."""
    tensors = {name: torch.as_tensor(values) for name, values in parameters.items()}
    with torch.no_grad():
        vertices = GNM(data)(Parameters(**tensors, scale=torch.ones(len(parameters["identity"]))))
    return vertices.numpy().astype(np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--backend", default="numpy", choices=("numpy", "pytorch", "jax"))
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    data = gnm_npz.read(options.model)
    parameters = drawn(data, options.count, options.seed)
    other = theirs(options.checkout, options.model.resolve(), options.python, options.backend, parameters)
    mine = ours(data, parameters)
    print(f"{options.backend}: {len(mine)} heads of {mine.shape[1]} vertices")
    print(f"largest_difference_m {np.linalg.norm(mine - other, axis=2).max():.2e}")


if __name__ == "__main__":
    main()
