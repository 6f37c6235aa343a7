"""Synthetic subjects before the studio's cameras: a person from the population, an expression, a capture folder."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coregister.first_model import assembly, build, makehuman, population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.population import SyntheticPerson
from coregister.synthetic import expressions
from coregister.synthetic.capture import Studio, check, write_capture
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.landmarks import schemes_beside
from registration.render.studio.skin import Look

_TURN_DEG = 4.0  # standard deviation of a subject's head in the studio, about each axis
_SHIFT = 8e-3  # metres
_MOST_WEIGHT = 2.0  # of a target; MakeHuman draws them for 1


def capture(
    root: Path,
    *,
    seed: int = 0,
    expression: str = "neutral",
    spanned: bool = False,
    targets: Mapping[str, float] | None = None,
    tags: Mapping[str, Any] | None = None,
    studio: Studio | None = None,
) -> Path:
    """Photograph the subject that a seed draws and write a native capture folder; returns `root`.

    `spanned` draws from the people that the first model's identity basis is made of; otherwise subjects are asymmetric
    and of any adult age and build, which the basis does not span. `targets` sets weights of MakeHuman targets by name;
    `tags` are told besides the subject's own. One seed is one subject, with one look (the studio's own is not used), in
    whatever expression. Raises InputError for unknown names, settings out of range, an existing folder, and where
    MakeHuman's head cannot be had.
    """
    studio = studio or Studio()
    check(root, studio)
    act = expressions.named(expression)
    person = subject(seed, spanned=spanned, targets=targets)
    model = build.bootstrap()
    made = _anatomy()
    moves = {name: made.source.target(name) for name in person.weights}
    vertices, joints = made.assemble(person, moves)
    vertices = expressions.perform(made, act, vertices, joints)
    rng = np.random.default_rng([seed, *expression.encode()])
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(_TURN_DEG), 3))
    middle = made.eye_centres.mean(0)
    vertices = turn.apply(vertices - middle) + middle + rng.normal(0, _SHIFT, 3)
    data = gnm_npz.read(model)
    return write_capture(
        root,
        data=data,
        vertices=vertices,
        schemes=schemes_beside(model, len(data.template_vertex_positions)),
        subject=f"synth_{seed:04d}",
        expression=expression,
        tags={**person.tags, "category": act.category, **(tags or {})},
        studio=replace(studio, look=_look(seed, person)),
    )


def _look(seed: int, person: SyntheticPerson) -> Look:
    look = Look.drawn(seed)
    return replace(look, stubble=0.0) if person.tags["gender"] == "female" else look


def subject(seed: int, *, spanned: bool = False, targets: Mapping[str, float] | None = None) -> SyntheticPerson:
    """The person that a seed draws. Raises InputError for targets that there are not and for numbers out of range."""
    if seed < 0:
        raise _wrong("The seed is out of range", "seed", "a whole number from 0", seed)
    for name, weight in (targets or {}).items():
        if not abs(weight) <= _MOST_WEIGHT:  # nor NaN
            raise _wrong("A target's weight is out of range", name, f"-{_MOST_WEIGHT} to {_MOST_WEIGHT}", weight)
    source = _anatomy().source
    rng = np.random.default_rng(seed)
    sample = population.sample_spanned_person if spanned else population.sample_unspanned_person
    person = sample(source, rng)
    for name in targets or {}:
        source.target(name)  # raises for an unknown one
    return replace(person, weights={**person.weights, **(targets or {})})


def _wrong(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change it")


@lru_cache(maxsize=1)
def _anatomy() -> HeadAssembly:
    return assembly.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
