"""People for single pictures: sampled from a model, or from MakeHuman's targets, outside both models."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from bench.landmark_fits.heads import HeadModel
from coregister.first_model import makehuman, population
from coregister.first_model.assembly import HeadAssembly, build_assembly
from coregister.first_model.build import TargetDisplacements
from coregister.synthetic.expressions import EXPRESSIONS, Expression, apply_expression


class People(Protocol):
    """Posed heads of one topology, near the origin of its rest pose."""

    name: str
    template: Float[np.ndarray, "V 3"]  # a head of the topology without expression, metres
    skin: Int[np.ndarray, "F 3"]  # triangles of the outer skin
    face: Int[np.ndarray, "G 3"]  # of these, the face's
    landmarks: dict[str, Float[np.ndarray, "L 3"]]  # on the template, by scheme

    def heads(self, seed: int) -> Iterator[Float[np.ndarray, "V 3"]]:
        """Vertices of one person after another, without end, not turned as a whole."""
        ...


@dataclass(eq=False)
class OfModel:
    """People of a model's prior: identity coefficients N(0, 1), expression coefficients of its own spread, gaze."""

    model: HeadModel

    def __post_init__(self) -> None:
        self.name = f"sampled from the {self.model.name}"
        self.template, self.skin, self.face = _of_model(self.model)
        self.landmarks = _landmarks(self.model)

    def heads(self, seed: int) -> Iterator[np.ndarray]:
        """Sample a person with an expression."""
        rng = np.random.default_rng([11, seed])
        while True:
            yield self.model.vertices(self.model.sample(rng, turn=0.0))


@dataclass(eq=False)
class OfMakeHuman:
    """MakeHuman's people of all ages and builds, asymmetric, with mixtures of two named expressions.

    They have the first model's topology. Neither model spans them.
    """

    model: HeadModel  # the first model

    def __post_init__(self) -> None:
        self.name = "MakeHuman people of any age and build"
        self.template, self.skin, self.face = _of_model(self.model)
        self.landmarks = _landmarks(self.model)
        self._assembly: HeadAssembly = build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
        self._targets = TargetDisplacements(self._assembly.source)

    def heads(self, seed: int) -> Iterator[np.ndarray]:
        """Sample a person with an expression."""
        rng = np.random.default_rng([12, seed])
        assembly = self._assembly
        while True:
            person = population.sample_unspanned_person(assembly.source, rng)
            vertices, joints = assembly.assemble(person, self._targets)
            yield apply_expression(assembly, _mixture(rng), vertices, joints)


def _of_model(model: HeadModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return model.template, model.outer_triangles, model.face_triangles


def _landmarks(model: HeadModel) -> dict[str, np.ndarray]:
    return {name: model.schemes[name].points(model.template) for name in ("68", "face478") if name in model.schemes}


def _mixture(rng: np.random.Generator) -> Expression:
    """Two of the named expressions, at random weights, and a random gaze."""
    units: dict[str, float] = {}
    for name in rng.choice(sorted(EXPRESSIONS), 2, replace=False):
        weight = rng.uniform(0.2, 0.9)
        for unit, value in EXPRESSIONS[name].units.items():
            units[unit] = min(1.0, units.get(unit, 0.0) + weight * value)
    gaze = rng.normal(size=2) * (8, 5)
    return Expression(category="mixture", units=units, gaze_deg=(float(gaze[0]), float(gaze[1])))


def turned(
    vertices: Float[np.ndarray, "V 3"], pivot: Float[np.ndarray, "3"], rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """The head turned as a whole: 25 degrees about the vertical, 10 about the other axes (standard deviations)."""
    degrees = np.clip(rng.normal(size=3) * (25, 10, 10), -60, 60)
    return Rotation.from_euler("yxz", degrees, degrees=True).apply(vertices - pivot) + pivot
