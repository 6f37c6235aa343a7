"""Regenerate eyes, teeth, tongue and pupils of a model and put all components into the paper's order.

Identity: head | eyes | teeth; expression: left eye | right eye | lower face | tongue | pupil
[GNM, Model Implementation Details]. Components of the head keep their rows, also those of eyes, teeth and tongue,
which follow the face.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from coregister.anatomy.eyes import EyeSettings, eye_basis, pupils_basis
from coregister.anatomy.part_basis import PartBasis, PartName
from coregister.anatomy.teeth import TeethSettings, teeth_basis
from coregister.anatomy.tongue import TongueSettings, TongueSources, tongue_basis
from registration.anatomy.eye_structure import find_eyes
from registration.anatomy.tongue_structure import find_tongue
from registration.anatomy.tooth_structure import find_teeth
from registration.errors import InputError, check_seed
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.storage import hashing

KIND, SCHEMA = "gnm-model-anatomy", 1
_IDENTITY: tuple[PartName, ...] = ("eyes", "teeth")  # the order of their components, after the head's


@dataclass(frozen=True, kw_only=True)
class AnatomySettings:
    """Which parts are regenerated, and how.

    Attributes:
        parts: their names; in any order.
        seed: of everything random.
        eyes: of the eyeballs; the seeds in here are not used.
        teeth: of the dentitions.
        tongue: of the tongue's poses.
    """

    parts: tuple[PartName, ...] = field(default_factory=lambda: tuple(BUILDERS))
    seed: int = 0
    eyes: EyeSettings = field(default_factory=EyeSettings)
    teeth: TeethSettings = field(default_factory=TeethSettings)
    tongue: TongueSettings = field(default_factory=TongueSettings)

    def check(self) -> None:
        """Raises InputError for an unknown or repeated part, or a seed out of range."""
        check_seed(self.seed)
        if not self.parts or not set(self.parts) <= set(BUILDERS) or len(set(self.parts)) < len(self.parts):
            raise InputError(
                "These parts cannot be regenerated",
                where="parts",
                expected=f"some of {', '.join(BUILDERS)}, each once",
                got=", ".join(self.parts) or "none",
                fix="leave the option out for all of them",
            )


Builder = Callable[[GNMData, AnatomySettings, TongueSources], PartBasis]
# In the order in which they are built: pupils put the iris in place before the eyes' components move it, and the tongue
# is posed among the new teeth.
BUILDERS: Mapping[PartName, Builder] = {
    "pupils": lambda data, settings, tongues: pupils_basis(data),
    "eyes": lambda data, settings, tongues: eye_basis(data, replace(settings.eyes, seed=settings.seed)),
    "teeth": lambda data, settings, tongues: teeth_basis(data, replace(settings.teeth, seed=settings.seed)),
    "tongue": lambda data, settings, tongues: tongue_basis(
        data, replace(settings.tongue, seed=settings.seed), sources=tongues
    ),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class RegeneratedModel:
    """A model with regenerated parts, and the manifest's section on them."""

    data: GNMData
    anatomy: dict[str, Any]  # JSON values; docs/formats.md


def regenerate(
    data: GNMData,
    settings: AnatomySettings = AnatomySettings(),  # noqa: B008  frozen
    tongues: TongueSources | None = None,
) -> RegeneratedModel:
    """Replace the components of some parts of a model, and their template where a part has a new one.

    Joints and joint regressor stay; the bases are float32, whatever they were, as half precision would move vertices by
    a micrometre.

    Args:
        data: any model of the official schema.
        settings: parts and seed.
        tongues: registrations and recordings of tongues; None: none.

    Raises:
        InputError: as the parts' builders; nothing is returned then.
    """
    settings.check()
    bases: list[PartBasis] = []
    for part, build in BUILDERS.items():
        if part in settings.parts:
            basis = build(data, settings, tongues or TongueSources())
            data = _with_template(data, basis)
            bases.append(basis)
    removed = _removed(data, settings.parts)
    result = _with_expression(_with_identity(data, bases), bases)
    counts = {name: len(rows) for name, rows in (identity_order(result) | expression_order(result)).items()}
    anatomy = {
        "settings": settings,
        "parts": {basis.part: {"components": len(basis.components), **basis.record} for basis in bases},
        "replaced": removed,
        "layout": counts,
    }
    return RegeneratedModel(data=result, anatomy=hashing.to_jsonable(anatomy))


def check_structures(data: GNMData, parts: Sequence[PartName]) -> None:
    """Raise InputError if a model lacks the structure that some parts need: a check of a second, without samples."""
    finders = {"eyes": find_eyes, "pupils": find_eyes, "teeth": find_teeth, "tongue": find_tongue}
    for find in dict.fromkeys(finders[part] for part in parts):
        find(data)


def manifest(
    regenerated: RegeneratedModel,
    previous: GNMData,
    settings: AnatomySettings,
    digests: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return the manifest of a model whose parts were regenerated, as JSON values (docs/formats.md).

    Args:
        regenerated: the new model.
        previous: the model that it was.
        settings: parts and seed.
        digests: of the files of real tongues, by name.
    """
    inputs = {"previous": gnm_npz.content_hash(previous), **(digests or {})}
    content: dict[str, Any] = hashing.to_jsonable(
        {
            "kind": KIND,
            "schema": SCHEMA,
            "content_id": gnm_npz.content_hash(regenerated.data),
            "input_hash": hashing.input_hash(inputs, hashing.to_jsonable(settings)),
            "inputs": inputs,
            "versions": hashing.versions(),
            "anatomy": regenerated.anatomy,
        }
    )
    return content


def identity_order(data: GNMData) -> dict[str, Int[np.ndarray, "_"]]:
    """Return the identity components by what they move: only eyes, only teeth and gums, else the head."""
    moved = _moved(data, data.vertex_identity_basis)
    eyes = np.flatnonzero(moved["eyes"] & ~moved["others"] & ~moved["teeth"])
    teeth = np.flatnonzero(moved["teeth"] & ~moved["others"] & ~moved["eyes"])
    head = np.setdiff1d(np.arange(len(data.identity_names)), np.concatenate([eyes, teeth]))
    return {"head": head, "eyes": eyes, "teeth": teeth}


def expression_order(data: GNMData) -> dict[str, Int[np.ndarray, "_"]]:
    """Return the expression components by region, tongue and pupils, those without any of these names before the
    tongue's."""
    modes = regions.expression_modes(data)
    names = data.expression_names.tolist()
    pupils = np.array([k for k, name in enumerate(names) if name.startswith("pupil")], np.int64)
    order = {region: modes.get(region, np.empty(0, np.int64)) for region in ("left_eye", "right_eye", "lower_face")}
    named = np.concatenate([*order.values(), modes["tongue"], pupils])
    others = np.setdiff1d(np.arange(len(names)), named)
    return order | ({"others": others} if len(others) else {}) | {"tongue": modes["tongue"], "pupils": pupils}


def _moved(data: GNMData, basis: Float[np.ndarray, "K V 3"]) -> dict[str, Bool[np.ndarray, "K"]]:
    left, right = regions.eyeballs(data)
    upper, lower = regions.gums(data)
    members = {"eyes": left | right, "teeth": regions.teeth(data) | upper | lower}
    members["others"] = ~(members["eyes"] | members["teeth"])
    return {name: np.abs(basis[:, rows]).max(axis=(1, 2), initial=0) > 0 for name, rows in members.items()}


def _removed(data: GNMData, parts: Sequence[PartName]) -> dict[str, list[str]]:
    """Names of the components that are replaced, by part."""
    identity, expression = identity_order(data), expression_order(data)
    names = {
        part: data.identity_names[identity[part]] if part in _IDENTITY else data.expression_names[expression[part]]
        for part in parts
    }
    return {part: list(map(str, values)) for part, values in names.items()}


def _with_template(data: GNMData, basis: PartBasis) -> GNMData:
    if basis.template is None:
        return data
    template = data.template_vertex_positions.copy()
    template[basis.vertices] = basis.template
    return replace(data, template_vertex_positions=template)


def _with_identity(data: GNMData, bases: Sequence[PartBasis]) -> GNMData:
    order = identity_order(data)
    new = {basis.part: basis for basis in bases}
    vertex_rows, joint_rows, names = [], [], []
    for part, rows in order.items():
        if (basis := new.get(part)) is not None:  # type: ignore[call-overload]
            vertex_rows.append(_scattered(basis, data))
            joint_rows.append(np.zeros((len(basis.components), *data.joint_identity_basis.shape[1:])))
            names += basis.names
        else:
            vertex_rows.append(data.vertex_identity_basis[rows])
            joint_rows.append(data.joint_identity_basis[rows])
            names += data.identity_names[rows].tolist()
    return replace(
        data,
        vertex_identity_basis=np.concatenate(vertex_rows).astype(np.float32),
        joint_identity_basis=np.concatenate(joint_rows).astype(data.joint_identity_basis.dtype),
        identity_names=np.array(names),
    )


def _with_expression(data: GNMData, bases: Sequence[PartBasis]) -> GNMData:
    new = {basis.part: basis for basis in bases}
    values, names = [], []
    for part, rows in expression_order(data).items():
        if (basis := new.get(part)) is not None:  # type: ignore[call-overload]
            values.append(_scattered(basis, data))
            names += basis.names
        else:
            values.append(data.expression_basis[rows])
            names += data.expression_names[rows].tolist()
    return replace(data, expression_basis=np.concatenate(values).astype(np.float32), expression_names=np.array(names))


def _scattered(basis: PartBasis, data: GNMData) -> Float[np.ndarray, "K V 3"]:
    """A part's components over all vertices of the model."""
    result = np.zeros((len(basis.components), *data.template_vertex_positions.shape), np.float32)
    result[:, basis.vertices] = basis.components
    return result
