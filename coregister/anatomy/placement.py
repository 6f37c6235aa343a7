"""First placement of teeth and tongue in a model's bases [GNM, Initial Placement of Teeth and Tongue]; docs/anatomy.md,
"Placement".

For models whose teeth and tongue came from elsewhere; once they are registered, `coregister.next_model` has them from
the registrations.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.storage import hashing

KIND, SCHEMA = "gnm-model-placement", 1
_LEAST_VERTICES = 3  # from which a motion is taken


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedModel:
    """A model with placed teeth and tongue, and what was done, as JSON values."""

    data: GNMData
    record: dict[str, Any]


def rigid_motion(
    basis: Float[np.ndarray, "K V 3"], data: GNMData, members: Bool[np.ndarray, "V"]
) -> Float[np.ndarray, "K V 3"]:
    """Return the motion w x p + t of some vertices in each component, at every vertex; metres.

    Fitted by least squares, by area, linearly: a finite rotation would not be linear in the coefficient
    (docs/algorithms.md, "Placement of teeth and tongue").
    """
    points = data.template_vertex_positions.astype(np.float64)
    area = vertex_areas(points, data.triangles) * members
    points = points - area @ points / area.sum()
    return np.tensordot(fit_twists(basis, points, area), motion_fields(points), 1)


def place(data: GNMData) -> PlacedModel:
    """Place teeth and tongue in every component that moves skin.

    Identity: teeth with their gums and the tongue are translated by the mean displacement of the inner lips, of the
    upper and of the lower one alike. Expression: lower teeth with their gums and the tongue take the rigid motion of
    lower lip and chin. Components that move no skin keep their values, as do all other vertices.

    Args:
        data: a model with the official components and groups.

    Raises:
        InputError: the model has no teeth or tongue, or fewer than three vertices of an inner lip or of lower lip and
            chin.
    """
    upper, lower = regions.inner_lip_vertices(data)
    jaw_skin = regions.lower_lip_and_chin(data)
    upper_gums, lower_gums = regions.gums(data)
    inside = regions.teeth(data) | upper_gums | lower_gums | regions.tongue(data)
    jaw_parts = regions.jaw_parts(data)
    for name, members, least in (
        ("the inner upper lip", upper, _LEAST_VERTICES),
        ("the inner lower lip", lower, _LEAST_VERTICES),
        ("lower lip and chin", jaw_skin, _LEAST_VERTICES),
        ("teeth, gums and tongue", inside, 1),
    ):
        if members.sum() < least:
            raise InputError(
                "Teeth and tongue of the model cannot be placed",
                where="vertex groups",
                expected=f"at least {least} vertices of {name}",
                got=int(members.sum()),
                fix="use a model file that carries the official vertex groups",
            )
    identity, expression = (basis.astype(np.float64) for basis in (data.vertex_identity_basis, data.expression_basis))
    moving = {"identity": _moving_skin(identity, data), "expression": _moving_skin(expression, data)}
    placed_identity, placed_expression = identity.copy(), expression.copy()
    rows = moving["identity"]
    mean = (identity[rows][:, upper].mean(1) + identity[rows][:, lower].mean(1)) / 2
    placed_identity[np.ix_(rows, inside)] = mean[:, None]
    rows = moving["expression"]
    motion = rigid_motion(expression[rows], data, jaw_skin)
    placed_expression[np.ix_(rows, jaw_parts)] = motion[:, jaw_parts]
    record = {
        "components": {name: len(rows) for name, rows in moving.items()},
        "vertices": {"identity": int(inside.sum()), "expression": int(jaw_parts.sum())},
        "moved_mm": {  # at one standard deviation of every component, root of the sum of squares, mean over vertices
            "identity": _change_mm(identity, placed_identity, inside),
            "expression": _change_mm(expression, placed_expression, jaw_parts),
        },
        "not_rigid_mm": _spread_mm(expression[rows][:, jaw_skin] - motion[:, jaw_skin]),
    }
    placed = replace(
        data,
        vertex_identity_basis=placed_identity.astype(np.float32),
        expression_basis=placed_expression.astype(np.float32),
    )
    return PlacedModel(data=placed, record=hashing.to_jsonable(record))


def manifest(placed: PlacedModel, previous: GNMData) -> dict[str, Any]:
    """Return the manifest of a model whose teeth and tongue were placed, as JSON values (docs/formats.md)."""
    inputs = {"previous": gnm_npz.content_hash(previous)}
    content: dict[str, Any] = hashing.to_jsonable(
        {
            "kind": KIND,
            "schema": SCHEMA,
            "content_id": gnm_npz.content_hash(placed.data),
            "input_hash": hashing.input_hash(inputs, {}),
            "inputs": inputs,
            "versions": hashing.versions(),
            "placement": placed.record,
        }
    )
    return content


def _moving_skin(basis: Float[np.ndarray, "K V 3"], data: GNMData) -> Int[np.ndarray, "M"]:
    return np.flatnonzero(np.abs(basis[:, regions.skin(data)]).max(axis=(1, 2), initial=0) > 0)


def _change_mm(
    before: Float[np.ndarray, "K V 3"], after: Float[np.ndarray, "K V 3"], members: Bool[np.ndarray, "V"]
) -> float:
    return _spread_mm(after[:, members] - before[:, members])


def _spread_mm(differences: Float[np.ndarray, "K N 3"]) -> float:
    return float(MM_PER_M * np.sqrt((differences**2).sum((0, 2))).mean()) if differences.size else 0.0
