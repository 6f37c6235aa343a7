"""Synthetic persons outside the first model's span, as true meshes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from coregister.first_model import population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.build import TargetDisplacements
from coregister.next_model.training_data import NEUTRAL, TrainingMesh, TrainingSubject


def true_neutrals(
    head: HeadAssembly, displacements: TargetDisplacements, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "N V 3"]:
    """Return neutrals of random persons of any adult age and build, metres, the model's frame."""
    persons = (population.sample_unspanned_person(head.source, rng) for _ in range(count))
    heads = [head.assemble(person, displacements)[0] for person in persons]
    return np.stack(heads)


def observed_everywhere(
    neutrals: Mapping[str, Float[np.ndarray, "V 3"]], triangles: Int[np.ndarray, "F 3"]
) -> list[TrainingSubject]:
    """Return subjects of given neutrals, by name, with full confidence in every vertex."""
    subjects = []
    for name, head in neutrals.items():
        ones, vertices = np.ones(len(head), np.float32), head.astype(np.float32)
        mesh = TrainingMesh(name=NEUTRAL, label=NEUTRAL, vertices=vertices, confidence=ones, triangles=triangles)
        subjects.append(TrainingSubject(name=name, neutral=mesh))
    return subjects
