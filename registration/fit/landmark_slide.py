"""Carries the skin along itself to where its landmarks are.

Images tell where smooth skin is across itself and not along: there a vertex stays where the model's parameters put it,
up to the motion that the landmarks of known place tell, and their neighbours with them. A step of the offsets cannot
do that: its size follows from the largest gradients, and landmarks strong enough to move the skin between them would
leave the surface less of it (docs/recipes.md, "Landmarks").
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from registration.fit.context import FitContext
from registration.fit.initialization import UNKNOWN_SPREAD_M
from registration.fit.variables import Variables
from registration.geometry.rasterizer import RayCaster
from registration.geometry.surface_field import FieldPrior, expected_field
from registration.geometry.topology import vertex_normals
from registration.model.gnm_npz import GNMData
from registration.model.regions import eyeball_shells, lids_by_eye
from registration.types import Camera

# Of the model's people and others: 0.93 mm along the skin, in two directions.
PRIOR = FieldPrior(deviation_m=0.7e-3, range_m=70e-3)
_LEAST_SPREAD_M = 0.1e-3  # of a landmark: edges are a millimetre long
_OPEN_EYE = 0.03  # of an eyeball's vertices that a camera sees; of a half-closed eye 0.1, of an open one a third


def slide_to_landmarks(
    context: FitContext, variables: Variables, landmarks_used: Mapping[str, Bool[np.ndarray, "L"]]
) -> None:
    """Displace the skin along itself towards the triangulated landmarks, between two stages.

    A landmark whose point on the mesh no view sees does not count: between closed lids or lips a detector marks the
    line that it sees, not the edge that is covered. Nor does one on the lids of a closed eye, where detectors are
    several times farther off than their spread says, which is that of open eyes.

    Args:
        context: with the landmarks, and how far they may be off.
        variables: their offsets take up the motion.
        landmarks_used: scheme -> landmarks that are no outliers.
    """
    if not context.triangulated:
        return
    vertices = variables.vertices(variables.skin_offsets()).detach()
    normals = vertex_normals(vertices, context.triangles).double().cpu().numpy()
    mesh = vertices.double().cpu().numpy()
    skin = variables.skin
    row = np.full(len(mesh), -1)
    row[skin] = np.arange(len(skin))
    caster, cameras = RayCaster(mesh, context.data.triangles), context.pyramid[0].pixels.cameras
    closed_lids = _closed_lids(context.data, mesh, caster, cameras)
    indices, weights, observed, spread = [], [], [], []
    for name, points in context.triangulated.items():
        scheme, stated = context.schemes[name], context.landmark_spread_m(name)
        known = np.full(len(points), UNKNOWN_SPREAD_M) if stated is None else np.maximum(stated, _LEAST_SPREAD_M)
        corners = row[scheme.indices]
        used = landmarks_used[name] & np.isfinite(points).all(1) & np.isfinite(known) & (corners >= 0).all(1)
        places = scheme.points(mesh)
        used &= caster.visible_to_any(places, cameras) & ~closed_lids[scheme.indices].any(1)
        difference = points - places
        indices.append(corners[used])
        weights.append(scheme.weights[used])
        observed.append(_along(difference, scheme.points(normals))[used])
        spread.append(known[used])
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


def _closed_lids(
    data: GNMData, vertices: Float[np.ndarray, "V 3"], mesh: RayCaster, cameras: Sequence[Camera]
) -> Bool[np.ndarray, "V"]:
    """The skin around the eyes of which no camera sees more than a trace."""
    closed = np.zeros(len(vertices), bool)
    for ball, lids in zip(eyeball_shells(data), lids_by_eye(data), strict=True):
        if mesh.visible_to_any(vertices[ball], cameras).mean() < _OPEN_EYE:
            closed |= lids > 0
    return closed


def _along(vectors: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The parts of vectors in the planes of normals of any length."""
    squared = np.square(normals).sum(1, keepdims=True)
    return vectors - (vectors * normals).sum(1, keepdims=True) / np.maximum(squared, 1e-12) * normals
