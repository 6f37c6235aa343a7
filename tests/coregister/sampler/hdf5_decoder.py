"""A decoder as Keras stores it, written with h5py."""

import json
from pathlib import Path

import h5py
import numpy as np


def write_decoder(file: Path, sizes: tuple[int, ...], seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Write a chain of dense layers and return their kernels and biases."""
    rng = np.random.default_rng(seed)
    layers = [
        (rng.normal(size=(a, b)).astype(np.float32) / a**0.5, rng.normal(size=b).astype(np.float32))
        for a, b in zip(sizes, sizes[1:], strict=False)
    ]
    rows = [{"class_name": kind, "config": {"name": kind.lower()}} for kind in ("InputLayer", "Concatenate")]
    with h5py.File(file, "w") as target:
        for number, (kernel, bias) in enumerate(layers):
            name, last = f"dense_{number + 4}", number == len(layers) - 1
            config = {"name": name, "activation": "linear" if last else "relu"}
            rows.append({"class_name": "Dense", "config": config})
            target[f"model_weights/{name}/{name}/kernel:0"] = kernel
            target[f"model_weights/{name}/{name}/bias:0"] = bias
        target.attrs["model_config"] = json.dumps({"class_name": "Functional", "config": {"layers": rows}})
    return layers
