"""Carries the skin along itself to where its landmarks are.

Images tell where smooth skin is across itself and not along: there a vertex stays where the model's parameters put it,
up to the motion that the landmarks of known place tell, and their neighbours with them. A step of the offsets cannot
do that: its size follows from the largest gradients, and landmarks strong enough to move the skin between them would
leave the surface less of it (docs/recipes.md, "Landmarks").
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from registration.fit.context import FitContext
from registration.fit.initialization import UNKNOWN_SPREAD_M
from registration.fit.variables import Variables
from registration.geometry.surface_field import FieldPrior, expected_field
from registration.geometry.topology import vertex_normals

# Of the model's people and others: 0.93 mm along the skin, in two directions.
PRIOR = FieldPrior(deviation_m=0.7e-3, range_m=70e-3)
_LEAST_SPREAD_M = 0.1e-3  # of a landmark: edges are a millimetre long


def slide_to_landmarks(
    context: FitContext, variables: Variables, landmarks_used: Mapping[str, Bool[np.ndarray, "L"]]
) -> None:
    """Displace the skin along itself towards the triangulated landmarks, between two stages.

    Args:
        context: with the landmarks, and how far they may be off.
        variables: their offsets take up the motion.
        landmarks_used: scheme -> landmarks that are no outliers.
    """
    vertices = variables.vertices(variables.skin_offsets()).detach()
    normals = vertex_normals(vertices, context.triangles).double().cpu().numpy()
    mesh = vertices.double().cpu().numpy()
    skin = variables.skin
    row = np.full(len(mesh), -1)
    row[skin] = np.arange(len(skin))
    indices, weights, observed, spread = [], [], [], []
    for name, points in context.triangulated.items():
        scheme, stated = context.schemes[name], context.landmark_spread_m(name)
        known = np.full(len(points), UNKNOWN_SPREAD_M) if stated is None else np.maximum(stated, _LEAST_SPREAD_M)
        corners = row[scheme.indices]
        used = landmarks_used[name] & np.isfinite(points).all(1) & np.isfinite(known) & (corners >= 0).all(1)
        difference = points - scheme.points(mesh)
        indices.append(corners[used])
        weights.append(scheme.weights[used])
        observed.append(_along(difference, scheme.points(normals))[used])
        spread.append(known[used])
    if not observed:
        return
    field = expected_field(
        context.skin.triangles,
        context.skin.points.astype(np.float64),
        np.concatenate(indices),
        np.concatenate(weights).astype(np.float64),
        np.concatenate(observed),
        np.concatenate(spread),
        PRIOR,
    )
    displacement = np.zeros_like(mesh)
    displacement[skin] = _along(field, normals[skin])
    variables.move_skin(displacement)


def _along(vectors: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The parts of vectors in the planes of normals of any length."""
    squared = np.square(normals).sum(1, keepdims=True)
    return vectors - (vectors * normals).sum(1, keepdims=True) / np.maximum(squared, 1e-12) * normals
