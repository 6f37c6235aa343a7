"""Reads the decoders that Google released with GNM: Keras models in HDF5 files [GNM, Semantically Sampling GNM].

Only their dense layers are read; Keras is not needed. The order of the categories is that of the enumerations in
google/GNM's `semantic_sampler.py`.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coregister.sampler.categories import Factor, condition_size
from coregister.sampler.decoder import Decoder, Part, Sampler
from registration.errors import InputError
from registration.storage.hdf5_files import Hdf5, open_hdf5

FILES: dict[Part, str] = {"identity": "identity_decoder_model.h5", "expression": "expression_decoder_model.h5"}
FACTORS: dict[Part, tuple[Factor, ...]] = {
    "identity": (
        Factor(name="gender", categories=("female", "male")),
        Factor(name="ethnicity", categories=("middle_eastern", "asian", "white", "black")),
    ),
    "expression": (
        Factor(
            name="expression",
            categories=(
                *("surprise", "disgust", "suck", "compress_face", "stretch_face", "happy", "squint", "platysma"),
                *("blow", "funneler", "smile_wide", "corners_down", "pucker", "wink_left", "wink_right", "mouth_left"),
                *("mouth_right", "lips_roll_in", "snarl", "tongue_center"),
            ),
        ),
    ),
}
LATENT = 64
MAX_BYTES = 64 * 2**20
_MAX_LAYERS, _MAX_UNITS = 16, 8192
_WEIGHTS = "model_weights"
_TITLE, _FIX = "decoder", "give the decoder files that google/GNM publishes, unchanged"


def read_decoders(path: Path) -> Sampler:
    """Read one decoder, or both of a folder.

    Args:
        path: an HDF5 file, or a folder that holds `identity_decoder_model.h5`, `expression_decoder_model.h5` or both.

    Raises:
        InputError: there is no such file; it is no HDF5 file of a chain of dense layers, or its conditions are of
            neither kind.
    """
    files = [path] if not path.is_dir() else [path / name for name in FILES.values() if (path / name).is_file()]
    if not files:
        raise InputError.unreadable(_TITLE, where=path, expected=" or ".join(FILES.values()), got="neither", fix=_FIX)
    decoders = dict(read_decoder(file) for file in files)
    return Sampler(decoders=decoders, origin="the decoders released with GNM")


def read_decoder(file: Path) -> tuple[Part, Decoder]:
    """Read one decoder and tell by the number of its conditions which it is. Raises InputError as `read_decoders`."""
    refuse = partial(InputError.unreadable, _TITLE, where=file, fix=_FIX)
    with open_hdf5(file, refuse, max_bytes=MAX_BYTES) as hdf5:
        layers = _layers(hdf5, refuse)
    inputs = len(layers[0][0])
    known = {part: LATENT + condition_size(factors) for part, factors in FACTORS.items()}
    part = next((part for part, size in known.items() if size == inputs), None)
    if part is None:
        expected = " or ".join(f"{size} inputs ({part})" for part, size in known.items())
        raise refuse(expected=expected, got=f"{inputs} inputs")
    offset = np.zeros(len(layers[-1][1]), np.float32)
    return part, Decoder(factors=FACTORS[part], layers=tuple(layers), offset=offset)


def _layers(hdf5: Hdf5, refuse: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """The dense layers in the order of the model's configuration, which must be a chain."""
    layers = list[tuple[np.ndarray, np.ndarray]]()
    for name, last in _dense_names(hdf5, refuse):
        kernel, bias = (hdf5.array(f"{_WEIGHTS}/{name}/{name}/{kind}:0") for kind in ("kernel", "bias"))
        if kernel.ndim != 2 or bias.shape != kernel.shape[1:] or max(kernel.shape) > _MAX_UNITS or not kernel.size:
            expected = f"a kernel (inputs, units) and a bias (units) of at most {_MAX_UNITS}"
            raise refuse(expected=expected, got=f"{name}: {kernel.shape} and {bias.shape}")
        if layers and len(kernel) != layers[-1][0].shape[1]:
            got = f"{name}: {len(kernel)} inputs after {layers[-1][0].shape[1]} units"
            raise refuse(expected="layers that follow one another", got=got)
        layers.append((kernel.astype(np.float32), bias.astype(np.float32)))
        if last:
            return layers
    raise refuse(expected="dense layers of which the last is linear", got=f"{len(layers)} with ReLU")


def _dense_names(hdf5: Hdf5, refuse: Any) -> list[tuple[str, bool]]:
    """Names of the dense layers, and whether each is the last, which alone is linear."""
    text = hdf5.text_attribute("model_config")
    try:
        rows = [layer for layer in json.loads(text)["config"]["layers"] if layer["class_name"] == "Dense"]
        found = [(str(row["config"]["name"]), str(row["config"]["activation"])) for row in rows]
        foreign = {str(row["class_name"]) for row in json.loads(text)["config"]["layers"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise refuse(expected="a Keras model's configuration", got=f"{type(error).__name__}: {error}") from None
    foreign -= {"Dense", "Concatenate", "InputLayer"}
    activations = [activation for _, activation in found]
    wanted = ["relu"] * (len(found) - 1) + ["linear"]
    if foreign or not 1 <= len(found) <= _MAX_LAYERS or activations != wanted:
        expected = f"up to {_MAX_LAYERS} dense layers, ReLU but for the last, which is linear"
        raise refuse(expected=expected, got=f"{', '.join(activations)} {', '.join(sorted(foreign))}".strip())
    if any("/" in name or not name.isprintable() for name, _ in found):
        raise refuse(expected="names of layers", got="names with slashes or control characters")
    return [(name, number == len(found)) for number, (name, _) in enumerate(found, start=1)]
