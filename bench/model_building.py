"""Build a model of many made subjects: the time and memory of every part of a build, and a sketch's accuracy.

    python -m bench.model_building [--neutrals 200] [--expressions 4000] [--paper] [--memory-gb 4]

Neutrals are random heads of the first model with smooth differences that it does not have; expressions are its own
displacements and smooth fields of decreasing size, made while they are read, never stored. `--paper`: 5,000 neutrals
and 150,000 expressions, as many as [GNM] was built from. The identity basis is built with the default settings, the
share of the prior given, then chosen; then every region of the expressions, and the statistics of their coefficients.
Alignment runs on the neutrals. What is made is not timed apart: making an expression takes as long as reading one from
disk. Seconds are those of the processor; the last row is the peak memory of the process.
"""

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from coregister.first_model import build
from coregister.next_model.alignment import AlignmentSettings, align_neutrals
from coregister.next_model.expression import coefficient_statistics, regional_bases
from coregister.next_model.identity import build_identity_basis, transfer_components
from coregister.next_model.recipes import few_registrations
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData

PAPER = 5000, 150_000
_WAVES = 120  # fields that the first model does not have
_WAVENUMBER = 60.0  # of these, radians a metre
_SIZE_M = 1e-3  # rms of the first one; the others decrease
_BLOCK = 64


def smooth_fields(points: Float[np.ndarray, "V 3"], rng: np.random.Generator) -> Float[np.ndarray, "F D"]:
    """Return smooth fields of decreasing size, metres."""
    waves, phases = rng.normal(0, _WAVENUMBER, (_WAVES, 3)), rng.uniform(0, 2 * np.pi, _WAVES)
    fields = np.cos(waves @ points.T + phases[:, None])[:, :, None] * rng.normal(size=(_WAVES, 1, 3))
    return (_SIZE_M * np.arange(1, _WAVES + 1)[:, None] ** -0.75 * fields.reshape(_WAVES, -1)).astype(np.float32)


class MadeDisplacements:
    """Displacements of a basis and of smooth fields, equal each time they are read."""

    def __init__(self, count: int, modes: Float[np.ndarray, "M D"]):
        self._count, self._modes = count, modes

    def __iter__(self) -> Iterator[Float[np.ndarray, "V 3"]]:
        rng = np.random.default_rng(2)
        for first in range(0, self._count, _BLOCK):
            coefficients = rng.standard_normal((min(_BLOCK, self._count - first), len(self._modes)), np.float32)
            yield from (coefficients @ self._modes).reshape(len(coefficients), -1, 3)


def made_neutrals(data: GNMData, count: int, fields: Float[np.ndarray, "F D"]) -> Float[np.ndarray, "N V 3"]:
    """Return heads of the model with fields that it does not have, metres."""
    head = np.setdiff1d(np.arange(len(data.vertex_identity_basis)), transfer_components(data))
    modes = np.concatenate([data.vertex_identity_basis[head].reshape(len(head), -1), fields])
    heads = np.empty((count, *data.template_vertex_positions.shape), np.float32)
    for index, displacement in enumerate(MadeDisplacements(count, modes)):
        heads[index] = data.template_vertex_positions + displacement
    return heads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--neutrals", type=int, default=200)
    parser.add_argument("--expressions", type=int, default=4000)
    parser.add_argument("--paper", action="store_true", help="as many as [GNM]: 5,000 and 150,000")
    parser.add_argument("--memory-gb", type=float, default=4.0)
    options = parser.parse_args()
    neutrals, expressions = PAPER if options.paper else (options.neutrals, options.expressions)
    data, recipe = gnm_npz.read(build.bootstrap()), few_registrations()
    fields = smooth_fields(data.template_vertex_positions.astype(np.float64), np.random.default_rng(1))
    heads = made_neutrals(data, neutrals, fields)
    confidence = np.ones(heads.shape[:2], np.float32)
    start = time.process_time()

    def report(part: str, *words: object) -> None:
        gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
        print(f"{part}: minutes {(time.process_time() - start) / 60:.1f} peak_gb {gigabytes:.2f}", *words, flush=True)

    names = [str(k) for k in range(neutrals)]
    aligned = align_neutrals(heads, confidence, names, data, AlignmentSettings(), mirrored=True)
    report("alignment", f"rejected {len(aligned.rejected)}")
    del heads, confidence
    given = replace(recipe.identity, shrinkage=0.2)
    build_identity_basis(aligned.vertices, data, given, options.memory_gb)
    report("identity, share given")
    head = build_identity_basis(aligned.vertices, data, recipe.identity, options.memory_gb)
    words = f"share {head.shrinkage} components {len(head.basis)} of {head.variance_ratio:.4f} {head.method}"
    report("identity, share chosen", words, f"could_miss {head.missed:.1e}")
    del aligned
    modes = np.concatenate([data.expression_basis.reshape(len(data.expression_basis), -1), fields])
    displacements, weights = MadeDisplacements(expressions, modes), np.ones(expressions)
    bases = regional_bases(displacements, weights, data, recipe.expressions, options.memory_gb)
    for name, region in bases.items():
        words = f"components {len(region.basis)} of {region.variance_ratio:.4f} {region.method}"
        report(name, words, f"could_miss {region.missed:.1e}")
    coefficient_statistics(displacements, weights, bases, data)
    report("statistics of coefficients")


if __name__ == "__main__":
    main()
