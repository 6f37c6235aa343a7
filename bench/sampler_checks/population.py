"""A synthetic population of coefficients of the first model, with tags by construction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coregister.first_model import makehuman, population, tongue
from coregister.first_model.assembly import HeadAssembly, build_assembly
from coregister.first_model.build import TargetDisplacements
from coregister.first_model.population import SyntheticPerson
from coregister.synthetic.expressions import EXPRESSIONS
from registration.model.gnm_npz import GNMData, content_hash

ACTS = (  # 20 of the acts of `coregister/synthetic/expressions.py`
    *("stretch", "compress", "smile", "viseme_aa", "viseme_ee", "viseme_oo", "viseme_ff", "lips_rolled", "pucker"),
    *("funnel", "sadness", "fear", "anger", "tongue_out", "jaw_open", "jaw_left", "wink_left", "wink_right", "squint"),
    "cheeks_blown",
)
_ASSEMBLED = 900  # people whose heads are assembled; the others' coefficients are predicted from their weights
_PURE = 0.75  # least share of a person's ethnicity
_STRENGTH = (0.65, 1.05)  # of an act
_UNIT_SPREAD = 0.12  # of a unit's weight, relative
_SIDE_SPREAD = 0.10  # of the two sides' difference, relative
_OTHERS, _OTHER_STRENGTH = 2, 0.12  # units outside the act, and their largest weight


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticPopulation:
    """Coefficients with tags."""

    identity: Float[np.ndarray, "N I"]
    expression: Float[np.ndarray, "N E"]
    genders: Sequence[str]
    ethnicities: Sequence[str]
    labels: Sequence[str]
    error: float  # of predicted identity coefficients of people who were left out, rms


def make(data: GNMData, count: int, seed: int) -> SyntheticPopulation:
    """Make people, each with one act.

    Args:
        data: the first model.
        count: number of people.
        seed: of everything random.
    """
    source = makehuman.read(makehuman.fetch())
    assembly = build_assembly(source, population.mean_person())
    rng = np.random.default_rng([31, seed])
    people = [_person(assembly, rng) for _ in range(count)]
    identity, error = _identities(data, assembly, people)
    units = _unit_coefficients(data, assembly)
    labels = [ACTS[k % len(ACTS)] for k in range(count)]
    tongues = _TongueCoefficients(data, assembly)
    expression = np.stack([_act(label, units, tongues, rng) for label in labels])
    return SyntheticPopulation(
        identity=identity,
        expression=expression.astype(np.float32),
        genders=[str(person.tags["gender"]) for person in people],
        ethnicities=[str(person.tags["ethnicity"]) for person in people],
        labels=labels,
        error=error,
    )


def _person(assembly: HeadAssembly, rng: np.random.Generator) -> SyntheticPerson:
    """A person of the identity basis, of a clear gender and mostly one ethnicity."""
    sampled = population.sample_spanned_person(assembly.source, rng)
    own, share = int(rng.integers(3)), rng.uniform(_PURE, 1)
    mix = (1 - share) * rng.dirichlet(np.ones(3)) + share * np.eye(3)[own]
    male = float(rng.uniform(0, 0.15))
    male = 1 - male if rng.integers(2) else male
    sliders = {name: weight for name, weight in sampled.weights.items() if not name.startswith("macrodetails/")}
    macros = population._macros(mix, male, 0.5, 0.5, 0.5)
    return population._person({**sliders, **macros}, mix, male, 0.5)


def _identities(
    data: GNMData, assembly: HeadAssembly, people: Sequence[SyntheticPerson]
) -> tuple[Float[np.ndarray, "N I"], float]:
    """Coefficients by least squares of the first people's heads, and by a linear map of the weights for the others."""
    names = sorted({name for person in people for name in person.weights})
    weights = np.array([[person.weights.get(name, 0.0) for name in names] for person in people])
    displacements = TargetDisplacements(assembly.source)
    solve = _projection(data.vertex_identity_basis)
    template = data.template_vertex_positions.astype(np.float64)
    first = people[: min(_ASSEMBLED, len(people))]
    solved = np.stack([solve(assembly.assemble(person, displacements)[0] - template) for person in first])
    fitted = len(first) * 9 // 10
    inputs = np.concatenate([weights, np.ones((len(weights), 1))], 1)
    penalty = 1e-4 * np.eye(inputs.shape[1])
    known = inputs[:fitted]
    linear = np.linalg.solve(known.T @ known + penalty, known.T @ solved[:fitted])
    error = float(np.sqrt(np.mean((inputs[fitted : len(first)] @ linear - solved[fitted:]) ** 2)))
    identity = inputs @ linear
    identity[: len(first)] = solved
    return identity.astype(np.float32), error


def _projection(basis: Float[np.ndarray, "K V 3"]):  # type: ignore[no-untyped-def]
    """Return a function from displacements to their least-squares coefficients."""
    rows = basis.reshape(len(basis), -1).astype(np.float64)
    gram = rows @ rows.T
    used = np.diag(gram) > 0
    inverse = np.zeros_like(gram)
    inverse[np.ix_(used, used)] = np.linalg.pinv(gram[np.ix_(used, used)], rcond=1e-10)
    return lambda displacement: inverse @ (rows @ np.asarray(displacement, np.float64).ravel())


def _unit_coefficients(data: GNMData, assembly: HeadAssembly) -> dict[str, Float[np.ndarray, "E"]]:
    names = sorted(n for n in assembly.source.targets if n.startswith("faceunits/") and "tongue" not in n)
    solve = _projection(data.expression_basis)
    return {name.split("/")[1]: solve(assembly.expression_displacement(assembly.source.target(name))) for name in names}


class _TongueCoefficients:
    """Coefficients of tongue poses."""

    def __init__(self, data: GNMData, assembly: HeadAssembly):
        rows = assembly.slices["tongue"]
        self._rest = assembly.template[rows]
        self._out = assembly.tongue_displacement(assembly.source.target("faceunits/tongueOut"))[rows]
        self._own = np.char.startswith(data.expression_names, "tongue")
        self._solve = _projection(data.expression_basis[self._own][:, rows])

    def solve(self, pose: Mapping[str, float]) -> Float[np.ndarray, "E"]:
        result = np.zeros(len(self._own))
        result[self._own] = self._solve(tongue.displacement(self._rest, self._out, **pose))
        return result


def _act(
    label: str, units: Mapping[str, np.ndarray], tongues: _TongueCoefficients, rng: np.random.Generator
) -> Float[np.ndarray, "E"]:
    """An act with its own strength, weights and asymmetry, and a trace of other units."""
    act, strength = EXPRESSIONS[label], rng.uniform(*_STRENGTH)
    side = rng.normal(0, _SIDE_SPREAD)
    weights = dict.fromkeys(rng.choice(sorted(units), _OTHERS, replace=False).tolist(), 0.0)
    weights = {name: rng.uniform(0, _OTHER_STRENGTH) for name in weights}
    for name, weight in act.units.items():
        sign = (name.endswith("Left") - name.endswith("Right")) * side
        weights[name] = weight * strength * max(0.0, 1 + rng.normal(0, _UNIT_SPREAD) + sign)
    result = sum((weight * units[name] for name, weight in weights.items()), np.zeros_like(next(iter(units.values()))))
    if act.tongue:
        pose = {name: value * strength for name, value in act.tongue.items()}
        result += tongues.solve({**pose, "bend": rng.normal(0, 0.15), "turn": rng.normal(0, 0.1)})
    return result


def write(people: SyntheticPopulation, data: GNMData, file: Path) -> None:
    """Write the NPZ file of `gnmreg sampler train`."""
    np.savez(
        file,
        allow_pickle=False,
        identity=people.identity,
        expression=people.expression,
        subjects=np.array([f"p{number:05d}" for number in range(len(people.labels))]),
        labels=np.array(people.labels),
        tag_gender=np.array(people.genders),
        tag_ethnicity=np.array(people.ethnicities),
        model=np.array(content_hash(data)),
    )
