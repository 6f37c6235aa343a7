"""The decoders released with GNM: their outputs against Keras's, and what their latent dimensions do."""

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.sampler_checks import BenchOptions, Figure
from coregister.sampler.categories import condition_size
from coregister.sampler.decoder import Decoder
from coregister.sampler.keras_decoder import FILES, read_decoders

LIMIT = 1e-5
SAMPLES = 512


def figures(options: BenchOptions) -> Iterator[Figure]:
    decoders = read_decoders(options.decoders).decoders
    for part, decoder in decoders.items():
        rng = np.random.default_rng(options.seed)
        latent = 1.5 * rng.standard_normal((SAMPLES, decoder.latent)).astype(np.float32)
        conditions = rng.dirichlet(np.full(condition_size(decoder.factors), 0.3), SAMPLES).astype(np.float32)
        own = decoder.decode(latent, conditions)
        used = in_use(decoder, rng)
        yield Figure(name=f"{part}: latent dimensions in use", value=f"{min(used)} to {max(used)} by category")
        if options.keras is None:
            yield Figure(name=f"{part}: difference from Keras", value="not measured: no --keras")
            continue
        with tempfile.TemporaryDirectory() as folder:
            given, output = Path(folder) / "given.npz", Path(folder) / "output.npz"
            np.savez(given, latent=latent, conditions=conditions)
            words = [
                options.keras,
                Path(__file__).with_name("keras_outputs.py"),
                options.decoders / FILES[part],
                given,
                output,
            ]
            subprocess.run([str(word) for word in words], check=True, capture_output=True)
            arrays = np.load(output)
            difference = float(np.abs(arrays["outputs"] - own).max())
            value = f"{difference:.2g} of up to {np.abs(own).max():.1f}, Keras {arrays['version']}"
        kept = difference <= LIMIT
        yield Figure(name=f"{part}: largest difference from Keras", value=value, limit=f"<= {LIMIT}", kept=kept)


def in_use(decoder: Decoder, rng: np.random.Generator) -> list[int]:
    """Return, for each category of the last factor, how many latent dimensions move the output.

    A dimension is in use if drawing it anew changes the coefficients by more than 1 % of their variance.
    """
    sizes = [len(factor.categories) for factor in decoder.factors]
    counts = []
    for category in range(sizes[-1]):
        row = np.concatenate([np.eye(size)[0] for size in sizes[:-1]] + [np.eye(sizes[-1])[category]])
        conditions = np.tile(row, (400, 1))
        latent = rng.standard_normal((400, decoder.latent))
        output = decoder.decode(latent, conditions)
        total, moved = output.var(0).sum(), []
        for dimension in range(decoder.latent):
            other = latent.copy()
            other[:, dimension] = rng.standard_normal(400)
            moved.append(((decoder.decode(other, conditions) - output) ** 2).sum(1).mean() / 2 / total)
        counts.append(int((np.array(moved) > 0.01).sum()))
    return counts
