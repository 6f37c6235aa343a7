"""Synthetic persons outside the first model's span, as true meshes."""

import numpy as np
from jaxtyping import Float

from coregister.first_model import population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.build import TargetDisplacements


def true_neutrals(
    head: HeadAssembly, displacements: TargetDisplacements, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "N V 3"]:
    """Return neutrals of random persons of any adult age and build, metres, the model's frame."""
    persons = (population.sample_unspanned_person(head.source, rng) for _ in range(count))
    heads = [head.assemble(person, displacements)[0] for person in persons]
    return np.stack(heads)
