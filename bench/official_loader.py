"""Compare the vertices that google/GNM's published code computes from a model file with ours.

    python -m bench.official_loader CHECKOUT MODEL.npz [--python PYTHON] [--backend numpy]

CHECKOUT is a clone of https://github.com/google/GNM. Its package is copied to a temporary folder, where MODEL replaces
its head model, and `GNM.from_local` of the backend reads and checks it in a separate process. PYTHON is the
interpreter of that process, with the package's dependencies, for example

    python -m venv gnm && gnm/bin/pip install "etils[epath,enp]" absl-py numpy      and torch or jax for those backends

Random identities, expressions, rotations of all joints and translations are evaluated by both; the last row is the
largest distance between corresponding vertices. Both compute in float32.
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

OFFICIAL_CODE = """
import importlib, sys
import numpy as np
backend, file, out = sys.argv[1:]
package = importlib.import_module(f"gnm.shape.gnm_{backend}")
model = package.GNM.from_local(version=package.GNMMajorVersion.V3, variant=package.GNMVariant.HEAD)
names = ("identity", "expression", "rotations", "translation")
array = importlib.import_module("torch").as_tensor if backend == "pytorch" else np.asarray
with np.load(file) as parameters:
    np.save(out, np.asarray(model(*(array(parameters[name]) for name in names))))
"""


def random_parameters(data: GNMData, count: int, seed: int) -> dict[str, np.ndarray]:
    """Return random parameters, float32: coefficients of unit variance, rotations of about ten degrees."""
    rng = np.random.default_rng(seed)
    shapes = {
        "identity": (1.0, (len(data.vertex_identity_basis),)),
        "expression": (1.0, (len(data.expression_basis),)),
        "rotations": (0.2, (len(data.joint_names), 3)),
        "translation": (0.3, (3,)),
    }
    return {name: rng.normal(0, size, (count, *shape)).astype(np.float32) for name, (size, shape) in shapes.items()}


def official_vertices(
    checkout: Path, model: Path, python: str, backend: str, parameters: dict[str, np.ndarray]
) -> np.ndarray:
    """Return the vertices (N, V, 3) by the checkout's code, metres."""
    source = checkout / "gnm" / "shape"
    if not (source / f"gnm_{backend}.py").is_file():
        raise InputError(
            "The folder is no checkout of google/GNM",
            where=checkout,
            expected=f"gnm/shape/gnm_{backend}.py in it",
            got="no such file",
            fix="clone https://github.com/google/GNM and pass that folder",
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(source, folder / "gnm" / "shape", ignore=shutil.ignore_patterns("*.npz", "*.h5", "assets"))
        target = folder / "gnm" / "shape" / "data" / "versions" / "v3_0" / "gnm_head.npz"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(model, target)
        np.savez(folder / "parameters.npz", allow_pickle=False, **parameters)
        command = [python, "-c", OFFICIAL_CODE, backend, str(folder / "parameters.npz"), str(folder / "vertices.npy")]
        subprocess.run(command, cwd=folder, check=True)
        return np.asarray(np.load(folder / "vertices.npy"), np.float64)


def our_vertices(data: GNMData, parameters: dict[str, np.ndarray]) -> np.ndarray:
    """Return the vertices (N, V, 3) by `registration.model.gnm`, metres."""
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
    parameters = random_parameters(data, options.count, options.seed)
    model = options.model.resolve()
    official = official_vertices(options.checkout, model, options.python, options.backend, parameters)
    ours = our_vertices(data, parameters)
    print(f"{options.backend}: {len(ours)} heads of {ours.shape[1]} vertices")
    print(f"largest_difference_m {np.linalg.norm(ours - official, axis=2).max():.2e}")


if __name__ == "__main__":
    main()
