"""Captures of synthetic subjects: a sampled person with an expression, rendered in the studio."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coregister.first_model import build, makehuman, population
from coregister.first_model.assembly import HeadAssembly, build_assembly
from coregister.first_model.population import SyntheticPerson
from coregister.synthetic import expressions
from coregister.synthetic.capture import Studio, check_studio, render_capture
from registration.errors import InputError, check_seed
from registration.model import gnm_npz
from registration.model.landmarks import schemes_beside
from registration.render.studio.skin import SkinAppearance

_ROTATION_STD_DEG = 4.0  # of a head in the studio, about each axis
_TRANSLATION_STD_M = 8e-3
_MAX_WEIGHT = 2.0  # of a target; MakeHuman's are designed for 1


def synthesize_capture(
    root: Path,
    *,
    seed: int = 0,
    expression: str = "neutral",
    spanned: bool = False,
    targets: Mapping[str, float] | None = None,
    tags: Mapping[str, Any] | None = None,
    studio: Studio | None = None,
) -> Path:
    """Render a sampled subject with an expression and write a native capture folder.

    Args:
        root: the folder to write; must not exist.
        seed: determines the subject, in all its expressions, and its appearance.
        expression: name of the expression.
        spanned: whether to sample from the people of the first model's identity basis; otherwise subjects are
            asymmetric and of any adult age and build, outside the basis.
        targets: weights of MakeHuman targets by name, which replace the sampled ones.
        tags: tags of the capture besides the subject's.
        studio: the settings; its `look` is replaced by the subject's.

    Returns:
        `root`.

    Raises:
        InputError: unknown names, settings out of range, an existing folder, or MakeHuman's head cannot be downloaded.
    """
    studio = studio or Studio()
    check_studio(root, studio)
    performed = expressions.expression_by_name(expression)
    person = sample_subject(seed, spanned=spanned, targets=targets)
    model = build.bootstrap()
    assembly = _assembly()
    displacements = {name: assembly.source.target(name) for name in person.weights}
    vertices, joints = assembly.assemble(person, displacements)
    vertices = expressions.apply_expression(assembly, performed, vertices, joints)
    rng = np.random.default_rng([seed, *expression.encode()])
    rotation = Rotation.from_rotvec(rng.normal(0, np.radians(_ROTATION_STD_DEG), 3))
    pivot = assembly.eye_centres.mean(0)
    vertices = rotation.apply(vertices - pivot) + pivot + rng.normal(0, _TRANSLATION_STD_M, 3)
    data = gnm_npz.read(model)
    return render_capture(
        root,
        data=data,
        vertices=vertices,
        schemes=schemes_beside(model, data.template_vertex_positions),
        subject=f"synth_{seed:04d}",
        expression=expression,
        tags={**person.tags, "category": performed.category, **(tags or {})},
        studio=replace(studio, look=_appearance(seed, person)),
    )


def _appearance(seed: int, person: SyntheticPerson) -> SkinAppearance:
    appearance = SkinAppearance.sample(seed)
    return replace(appearance, stubble=0.0) if person.tags["gender"] == "female" else appearance


def sample_subject(seed: int, *, spanned: bool = False, targets: Mapping[str, float] | None = None) -> SyntheticPerson:
    """Sample a person.

    Args:
        seed: determines the person.
        spanned: whether to sample from the people of the first model's identity basis.
        targets: weights of MakeHuman targets by name, which replace the sampled ones.

    Raises:
        InputError: an unknown target, or a number out of range.
    """
    check_seed(seed)
    for name, weight in (targets or {}).items():
        if not abs(weight) <= _MAX_WEIGHT:  # also true of NaN
            raise _input_error("A target's weight is out of range", name, f"-{_MAX_WEIGHT} to {_MAX_WEIGHT}", weight)
    source = _assembly().source
    rng = np.random.default_rng(seed)
    sample = population.sample_spanned_person if spanned else population.sample_unspanned_person
    person = sample(source, rng)
    for name in targets or {}:
        source.target(name)  # raises for an unknown one
    return replace(person, weights={**person.weights, **(targets or {})})


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change this argument")


@lru_cache(maxsize=1)
def _assembly() -> HeadAssembly:
    return build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
