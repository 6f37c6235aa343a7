"""What the settings of a build are worth where subjects are few: people of the synthetic population, meshes as true.

    python -m bench.model_settings [--draws 3] [--shrinkage 0.2 0.4 chosen] [--by-area no yes] [--mirrored no yes]
                                   [--noise-mm 0] [--control]

Each draw is people that the first model does not span: `--training` of them make the next model, `--held-out` others
judge it against the first, at the same numbers of components: the mean distance of the nearest head from each true
mesh on the head's skin, vertex to vertex (`coregister.evaluate.linear_fit`), and how far random heads are from real
ones (`coregister.evaluate.specificity`; real: of both groups). A line a setting: means over draws of both, the gain
over the first model and the smallest of a draw. `--noise-mm` adds smooth noise of so many mm (rms; about 30 mm from
wave to wave) to
the training meshes, as registrations may be off. `--control` builds from heads drawn from the first model itself
instead, and judges by heads of it: there is nothing to gain. No timed test: seconds are wall-clock.
"""

import argparse
import time
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from coregister.evaluate.linear_fit import fit_correspondence, identity_part
from coregister.evaluate.specificity import specificity_mm
from coregister.first_model import assembly as anatomy_of
from coregister.first_model import build as bootstrap
from coregister.first_model import makehuman, population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.build import TargetDisplacements
from coregister.next_model import identity
from coregister.next_model.build import build_model
from coregister.next_model.identity import IdentitySettings
from coregister.next_model.recipes import true_meshes
from coregister.next_model.training_data import TrainingMesh, TrainingSubject
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData

COMPONENTS = (10, 20, 40)
# Eyelids are few vertices, and their correction takes half the time.
SETTINGS = IdentitySettings(variance_ratio=1.0, max_components=COMPONENTS[-1], eyelids_follow=False)
_SEED = 2026
_WAVE = 2 * np.pi / 30e-3  # of the noise, radians a metre
_WAVES = 60


def people(anatomy: HeadAssembly, targets: TargetDisplacements, count: int, draw: int) -> Float[np.ndarray, "N V 3"]:
    """True neutrals of any people, float32."""
    rng = np.random.default_rng([_SEED, draw])
    heads = [
        anatomy.assemble(population.sample_unspanned_person(anatomy.source, rng), targets)[0] for _ in range(count)
    ]
    return np.stack(heads).astype(np.float32)


def of_model(data: GNMData, count: int, draw: int) -> Float[np.ndarray, "N V 3"]:
    """Heads that the model itself draws."""
    head = np.setdiff1d(np.arange(len(data.vertex_identity_basis)), identity.transfer_components(data))
    drawn = np.random.default_rng([_SEED, draw]).standard_normal((count, len(head)))
    moved = np.tensordot(drawn, data.vertex_identity_basis[head], 1)
    return (data.template_vertex_positions + moved).astype(np.float32)


def noisy(heads: Float[np.ndarray, "N V 3"], rms_mm: float, draw: int) -> Float[np.ndarray, "N V 3"]:
    """Heads with smooth noise, each its own."""
    rng = np.random.default_rng([_SEED, draw, 1])
    found = []
    for head in heads:
        waves, phases = rng.normal(0, _WAVE / np.sqrt(3), (_WAVES, 3)), rng.uniform(0, 2 * np.pi, _WAVES)
        field = np.cos(head @ waves.T + phases) @ rng.normal(size=(_WAVES, 3))
        found.append(head + rms_mm * 1e-3 * field / np.sqrt((field**2).sum(1).mean()))
    return np.stack(found).astype(np.float32)


def next_model(heads: Float[np.ndarray, "N V 3"], previous: GNMData, settings: IdentitySettings) -> GNMData:
    """Of neutrals alone."""
    sure = np.ones(heads.shape[1], np.float32)
    triangles = previous.triangles
    meshes = [
        TrainingMesh(name=str(k), label="neutral", vertices=h, confidence=sure, triangles=triangles)
        for k, h in enumerate(heads)
    ]
    subjects = [TrainingSubject(name=mesh.name, neutral=mesh) for mesh in meshes]
    return build_model(subjects, previous, replace(true_meshes(), identity=settings)).data


def errors_mm(data: GNMData, heads: Float[np.ndarray, "N V 3"]) -> Float[np.ndarray, "k"]:
    part = identity_part(data)
    fits = [fit_correspondence(part, head[part.rows], COMPONENTS) for head in heads]
    return np.array([[one.distance_mm.mean() for one in found] for found in fits]).mean(0)


def specific_mm(data: GNMData, heads: Float[np.ndarray, "N V 3"], samples: int) -> Float[np.ndarray, "k"]:
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
    anatomy = anatomy_of.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    targets, sets = TargetDisplacements(anatomy.source), []
    for draw in range(options.draws):
        count = options.training + options.held_out
        heads = of_model(first, count, draw) if options.control else people(anatomy, targets, count, draw)
        training, held_out = heads[: options.training], heads[options.training :]
        sets.append((noisy(training, options.noise_mm, draw) if options.noise_mm else training, held_out, heads))
    before = np.array([errors_mm(first, held_out) for _, held_out, _ in sets])
    wide = np.array([specific_mm(first, heads, options.samples) for _, _, heads in sets])
    print("first model: held-out mm", before.mean(0).round(3), "specificity mm", wide.mean(0).round(3), flush=True)
    for by_area, mirrored, share in product(options.by_area, options.mirrored, options.shrinkage):
        begun = time.perf_counter()
        known = None if share == "chosen" else float(share)
        settings = replace(SETTINGS, shrinkage=known, by_area=by_area == "yes", mirrored=mirrored == "yes")
        found, special = [], []
        for training, held_out, heads in sets:
            data = next_model(training, first, settings)
            found.append(errors_mm(data, held_out))
            special.append(specific_mm(data, heads, options.samples))
        gain = 1 - np.array(found) / before
        worse = np.mean(special, 0) / wide.mean(0) - 1
        told = [f"by_area {by_area:3} mirrored {mirrored:3} previous {share:6}"]
        told += [f"mm {np.mean(found, 0).round(3)}", f"gain {gain.mean(0).round(3)}", f"least {gain.min(0).round(3)}"]
        told += [f"specificity {worse.round(3)}", f"seconds {time.perf_counter() - begun:.0f}"]
        print(" ".join(told), flush=True)


if __name__ == "__main__":
    main()
