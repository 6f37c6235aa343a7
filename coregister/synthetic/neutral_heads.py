"""Neutral heads of MakeHuman's population in the first model's topology, without pictures."""

import numpy as np
from jaxtyping import Float

from coregister.first_model import makehuman, population
from coregister.first_model.assembly import build_assembly
from coregister.first_model.build import TargetDisplacements


def neutral_heads(count: int, seed: int) -> Float[np.ndarray, "N V 3"]:
    """Return neutral heads of random people of any adult age and build, metres, the first model's frame.

    Args:
        count: how many.
        seed: of the people; other seeds give other people.

    Raises:
        InputError: MakeHuman's head cannot be downloaded.
    """
    assembly = build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    displacements, rng = TargetDisplacements(assembly.source), np.random.default_rng([13, seed])
    people = (population.sample_unspanned_person(assembly.source, rng) for _ in range(count))
    return np.stack([assembly.assemble(person, displacements)[0].astype(np.float32) for person in people])
