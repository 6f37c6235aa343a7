import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from coregister.sampler.keras_decoder import FACTORS, FILES, read_decoder, read_decoders
from registration.errors import InputError
from tests.conftest import SHARED, needs_shared
from tests.coregister.sampler.hdf5_decoder import write_decoder

RELEASED = SHARED / "data" / "gnm"
SIZES = (84, 8, 16, 12)
# Outputs of Keras 3.15.1 with TensorFlow 2.21 for the latent vector 0.01, 0.02, ..., 0.64 and equal weights of all
# categories: coefficients 0, 1, 2, 100 and 200, and the sum of the absolute values of all.
KERAS = {
    "identity": ((-0.170034, 0.132176, -0.700662, 0.180075, 0.489526), 130.607788),
    "expression": ((-0.420043, -0.160510, 0.391065, -0.345647, -0.205862), 25.300846),
}


def test_layers_are_evaluated_in_their_order(tmp_path):
    file = tmp_path / "decoder.h5"
    layers = write_decoder(file, SIZES)
    part, decoder = read_decoder(file)
    assert part == "expression"
    assert (decoder.latent, decoder.coefficients) == (64, 12)
    rng = np.random.default_rng(1)
    latent, conditions = rng.normal(size=(5, 64)), rng.dirichlet(np.ones(20), 5)
    hidden = np.concatenate([latent, conditions], 1)
    for kernel, bias in layers[:-1]:
        hidden = np.maximum(hidden @ kernel + bias, 0)
    np.testing.assert_allclose(decoder.decode(latent, conditions), hidden @ layers[-1][0] + layers[-1][1], atol=1e-5)


@needs_shared
@pytest.mark.parametrize("part", KERAS)
def test_the_released_decoders_evaluate_as_in_keras(part):
    found, decoder = read_decoder(RELEASED / FILES[part])
    assert found == part
    conditions = np.concatenate([np.full(len(f.categories), 1 / len(f.categories)) for f in FACTORS[part]])
    values = decoder.decode(np.arange(1, 65)[None] / 100, conditions[None])[0]
    few, total = KERAS[part]
    np.testing.assert_allclose(values[[0, 1, 2, 100, 200]], few, atol=1e-5)
    np.testing.assert_allclose(np.abs(values).sum(), total, rtol=1e-6)


def test_a_folder_may_hold_one_decoder_or_both(tmp_path):
    write_decoder(tmp_path / FILES["identity"], (70, 8, 5))
    assert set(read_decoders(tmp_path).decoders) == {"identity"}
    write_decoder(tmp_path / FILES["expression"], (84, 8, 5))
    assert set(read_decoders(tmp_path).decoders) == {"identity", "expression"}
    with pytest.raises(InputError, match="decoder"):
        read_decoders(tmp_path.parent / "nowhere")


def _edit(change: Callable[[h5py.File], None]) -> Callable[[Path], None]:
    def damage(file: Path) -> None:
        with h5py.File(file, "r+") as opened:
            change(opened)

    return damage


KERNEL, BIAS = (f"model_weights/dense_5/dense_5/{name}:0" for name in ("kernel", "bias"))


def _replaced(path: str, value: object) -> Callable[[Path], None]:
    def change(file: h5py.File) -> None:
        del file[path]
        file[path] = value

    return _edit(change)


def _layer(number: int, **values: object) -> Callable[[Path], None]:
    def change(file: h5py.File) -> None:
        config = json.loads(file.attrs["model_config"])
        config["config"]["layers"][number] |= values
        file.attrs["model_config"] = json.dumps(config)

    return _edit(change)


def _huge(file: h5py.File) -> None:
    del file[KERNEL]
    file.create_dataset(KERNEL, shape=(2**20, 2**20), dtype="f4", chunks=(2**10, 2**10), compression="gzip")


DAMAGES: dict[str, Callable[[Path], None]] = {
    "no HDF5": lambda file: file.write_bytes(b"PK\3\4" + bytes(100)),
    "empty": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "no kernel": _edit(lambda file: file.__delitem__(KERNEL)),
    "a kernel of text": _replaced(KERNEL, "text"),
    "a kernel of whole numbers": _replaced(KERNEL, np.ones((8, 16), np.int32)),
    "a kernel that is not finite": _replaced(KERNEL, np.full((8, 16), np.nan, np.float32)),
    "a kernel of another size": _replaced(KERNEL, np.ones((9, 16), np.float32)),
    "a bias of another size": _replaced(BIAS, np.ones(17, np.float32)),
    "a kernel with three axes": _replaced(KERNEL, np.ones((8, 16, 1), np.float32)),
    "a kernel in another file": _replaced(KERNEL, h5py.ExternalLink("/etc/passwd", "/")),
    "a kernel behind a link": _replaced(KERNEL, h5py.SoftLink("/model_weights/dense_4/dense_4/kernel:0")),
    "a huge kernel": _edit(_huge),
    "no configuration": _edit(lambda file: file.attrs.__delitem__("model_config")),
    "a configuration of numbers": _edit(lambda file: file.attrs.__setitem__("model_config", 3)),
    "a configuration that is no JSON": _edit(lambda file: file.attrs.__setitem__("model_config", "{")),
    "another activation": _layer(3, config={"name": "dense_5", "activation": "tanh"}),
    "another layer": _layer(3, class_name="Dropout"),
    "a layer of another name": _layer(3, config={"name": "../dense_5", "activation": "relu"}),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_files_are_refused(tmp_path, damage):
    file = tmp_path / "decoder.h5"
    write_decoder(file, SIZES)
    damage(file)
    with pytest.raises(InputError):
        read_decoder(file)


def test_a_decoder_of_other_conditions_is_refused(tmp_path):
    write_decoder(tmp_path / "decoder.h5", (65, 8, 5))
    with pytest.raises(InputError, match="decoder") as caught:
        read_decoder(tmp_path / "decoder.h5")
    assert "70 inputs (identity)" in str(caught.value)
