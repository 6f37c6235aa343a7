"""Compare settings of model building with few subjects: true meshes of the synthetic population.

    python -m bench.model_settings [--draws 3] [--shrinkage 0.2 0.4 chosen] [--by-area no yes] [--mirrored no yes]
                                   [--noise-mm 0] [--control]

Each draw samples subjects outside the first model's span. `--training` of them make the next model, `--held-out` others
evaluate it against the first, with the same numbers of components: mean distance of the best fit from each true mesh on
the head's skin, vertex to vertex (`coregister.evaluate.linear_fit`), and distance of random heads from real ones
(`coregister.evaluate.specificity`; real: of both groups). One row a setting: means of both over the draws, the gain
over the first model, and the smallest gain of a draw. `--noise-mm` adds smooth noise (rms; wavelength about 30 mm) to
the training meshes, as registrations may have. `--control` builds from random heads of the first model itself and
evaluates on others: no gain is possible. Seconds are wall-clock time.
"""

import argparse
import time
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from bench.support.population import observed_everywhere, true_neutrals
from coregister.evaluate.linear_fit import fit_correspondence, identity_part
from coregister.evaluate.specificity import specificity_mm
from coregister.first_model import assembly, makehuman, population
from coregister.first_model import build as bootstrap
from coregister.first_model.build import TargetDisplacements
from coregister.next_model import identity
from coregister.next_model.build import build_model
from coregister.next_model.identity import IdentitySettings
from coregister.next_model.recipes import true_meshes
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData

COMPONENTS = (10, 20, 40)
# Eyelids are few vertices, and their correction takes half the time.
SETTINGS = IdentitySettings(variance_ratio=1.0, max_components=COMPONENTS[-1], eyelids_follow=False)
_SEED = 2026
_WAVENUMBER = 2 * np.pi / 30e-3  # of the noise, radians a metre
_WAVES = 60


def model_samples(data: GNMData, count: int, draw: int) -> Float[np.ndarray, "N V 3"]:
    """Return random heads of the model itself, metres, float32."""
    head = np.setdiff1d(np.arange(len(data.vertex_identity_basis)), identity.transfer_components(data))
    coefficients = np.random.default_rng([_SEED, draw]).standard_normal((count, len(head)))
    displacements = np.tensordot(coefficients, data.vertex_identity_basis[head], 1)
    return (data.template_vertex_positions + displacements).astype(np.float32)


def add_noise(heads: Float[np.ndarray, "N V 3"], rms_mm: float, draw: int) -> Float[np.ndarray, "N V 3"]:
    """Return the heads with smooth noise, sampled for each head."""
    rng = np.random.default_rng([_SEED, draw, 1])
    noisy = []
    for head in heads:
        waves, phases = rng.normal(0, _WAVENUMBER / np.sqrt(3), (_WAVES, 3)), rng.uniform(0, 2 * np.pi, _WAVES)
        field = np.cos(head @ waves.T + phases) @ rng.normal(size=(_WAVES, 3))
        noisy.append(head + rms_mm * 1e-3 * field / np.sqrt((field**2).sum(1).mean()))
    return np.stack(noisy).astype(np.float32)


def next_model(heads: Float[np.ndarray, "N V 3"], previous: GNMData, settings: IdentitySettings) -> GNMData:
    """Return the model that is built from neutrals alone."""
    subjects = observed_everywhere({str(number): head for number, head in enumerate(heads)}, previous.triangles)
    return build_model(subjects, previous, replace(true_meshes(), identity=settings)).data


def generalization_mm(data: GNMData, heads: Float[np.ndarray, "N V 3"]) -> Float[np.ndarray, "k"]:
    """Return the mean distance of the best fits from the heads, for each number of components."""
    part = identity_part(data)
    fits = [fit_correspondence(part, head[part.rows], COMPONENTS) for head in heads]
    return np.array([[fit.distance_mm.mean() for fit in head_fits] for head_fits in fits]).mean(0)


def mean_specificity_mm(data: GNMData, heads: Float[np.ndarray, "N V 3"], samples: int) -> Float[np.ndarray, "k"]:
    """Return the mean distance of random heads from the nearest of the heads."""
    part = identity_part(data)
    return specificity_mm(part, heads[:, part.rows], COMPONENTS, samples=samples).mean(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--training", type=int, default=40)
    parser.add_argument("--held-out", type=int, default=10)
    parser.add_argument("--shrinkage", nargs="*", default=["0.2", "0.3", "0.4", "0.5", "chosen"])
    for name in ("--by-area", "--mirrored"):
        parser.add_argument(name, nargs="*", choices=("no", "yes"), default=["no", "yes"])
    parser.add_argument("--noise-mm", type=float, default=0.0)
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--control", action="store_true")
    options = parser.parse_args()
    first = gnm_npz.read(bootstrap.bootstrap())
    head = assembly.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    displacements, draws = TargetDisplacements(head.source), []
    for draw in range(options.draws):
        count = options.training + options.held_out
        if options.control:
            heads = model_samples(first, count, draw)
        else:
            rng = np.random.default_rng([_SEED, draw])
            heads = true_neutrals(head, displacements, count, rng).astype(np.float32)
        training, held_out = heads[: options.training], heads[options.training :]
        training = add_noise(training, options.noise_mm, draw) if options.noise_mm else training
        draws.append((training, held_out, heads))
    first_mm = np.array([generalization_mm(first, held_out) for _, held_out, _ in draws])
    first_specificity = np.array([mean_specificity_mm(first, heads, options.samples) for *_, heads in draws]).mean(0)
    print(
        "first model: held-out mm", first_mm.mean(0).round(3), "specificity mm", first_specificity.round(3), flush=True
    )
    for by_area, mirrored, shrinkage in product(options.by_area, options.mirrored, options.shrinkage):
        start = time.perf_counter()
        settings = replace(
            SETTINGS,
            shrinkage=None if shrinkage == "chosen" else float(shrinkage),
            by_area=by_area == "yes",
            mirrored=mirrored == "yes",
        )
        distances, specificity = [], []
        for training, held_out, heads in draws:
            data = next_model(training, first, settings)
            distances.append(generalization_mm(data, held_out))
            specificity.append(mean_specificity_mm(data, heads, options.samples))
        gain = 1 - np.array(distances) / first_mm
        change = np.mean(specificity, 0) / first_specificity - 1
        row = [f"by_area {by_area:3} mirrored {mirrored:3} shrinkage {shrinkage:6}"]
        row += [f"mm {np.mean(distances, 0).round(3)}", f"gain {gain.mean(0).round(3)}"]
        row += [f"min_gain {gain.min(0).round(3)}", f"specificity {change.round(3)}"]
        print(" ".join([*row, f"seconds {time.perf_counter() - start:.0f}"]), flush=True)


if __name__ == "__main__":
    main()
