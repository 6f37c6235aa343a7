"""Joints: how the first model's skin hangs on them, and where they are for a given surface [GNM, Head Identity]."""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from coregister.region_masks import smoothstep
from registration.model import regions
from registration.model.gnm_npz import GNMData

# The head's weight rises from 0 to 1 between two parallel planes through the neck, which slope down from the nape to
# under the chin: heights of y + _SLOPE z, metres, in the model's frame.
_SLOPE = 0.29
_NECK, _SKULL = 0.140, 0.222
_BAND = 12e-3  # metres above and below a joint in which the skin tells where it is
_MOST = 300  # candidates of one joint on one side
_LEAST_WEIGHT = 0.05  # of the joint in its candidates' motion
_SPREAD = 3e-4  # metres: how much accuracy the regressor gives for spreading its weights


def head_weight(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """Share of the head joint in the skin's motion; the neck joint, the root, has the rest [GNM, Head Identity]."""
    return smoothstep((vertices[:, 1] + _SLOPE * vertices[:, 2] - _NECK) / (_SKULL - _NECK))


def regressor(
    candidates: Int[np.ndarray, "N"],
    shapes: Float[np.ndarray, "S V 3"],
    joints: Float[np.ndarray, "S 3"],
) -> Float[np.ndarray, "V"]:
    """Weights of at least 0 that sum to one and give the joint of every shape from the candidates' positions, nearly.

    `shapes` are heads, or a head and displacements with `joints` to match: the first sums the weights.
    """
    rows = shapes[:, candidates].transpose(0, 2, 1).reshape(-1, len(candidates))
    one = np.ones((1, len(candidates)))
    A = np.concatenate([rows, one, _SPREAD * np.eye(len(candidates))])
    weights, _ = nnls(A, np.concatenate([joints.ravel(), [1.0], np.zeros(len(candidates))]), maxiter=50_000)
    result = np.zeros(shapes.shape[1])
    result[candidates] = weights / weights.sum()
    return result


def rebuilt(data: GNMData) -> Float[np.ndarray, "J V"]:
    """A regressor from a model's own joints, over all of its identities: what `joint_regressor` is built anew from.

    Sparse, mirror-symmetric, weights of at least 0 that sum to one in each row. A joint that carries a part of its own
    (an eye) is told by that part, which moves as a whole; any other by the exterior skin in its blend neighbourhood: a
    ring about it whose motion it shares.
    """
    mirror, template = data.mirror_indices, data.template_vertex_positions.astype(np.float64)
    shapes = np.concatenate([template[None], data.vertex_identity_basis.astype(np.float64)])
    places = np.concatenate([data.template_joint_positions[None], data.joint_identity_basis]).astype(np.float64)
    weights = data.skinning_weights / data.skinning_weights.sum(0)
    own_parts = (weights > 0.999) & ~regions.skin(data)
    found = np.zeros(weights.shape)
    for joint, twin in enumerate(_twins(weights, mirror)):
        if own_parts[joint].any() and twin != joint:
            if joint < twin:
                found[joint] = regressor(np.flatnonzero(own_parts[joint]), shapes[:1], places[:1, joint])
                found[twin] = found[joint][mirror]
            continue
        candidates = _ring(data, weights[joint], template, places[0, joint, 1])
        one = regressor(candidates, shapes, places[:, joint])
        found[joint] = (one + one[mirror]) / 2
    return found


def _twins(weights: Float[np.ndarray, "J V"], mirror: Int[np.ndarray, "V"]) -> list[int]:
    """Each joint's mirror image: the joint whose vertices are the mirror images of its own."""
    shared = np.minimum(weights[:, None, mirror], weights[None]).sum(-1)
    return shared.argmax(1).tolist()


def _ring(
    data: GNMData, weight: Float[np.ndarray, "V"], template: Float[np.ndarray, "V 3"], height: float
) -> Int[np.ndarray, "N"]:
    """Exterior skin without ears that moves with the joint, near its height, as many on both sides."""
    mirror = data.mirror_indices
    usable = regions.exterior(data) & ~regions.ears(data) & (weight > _LEAST_WEIGHT)
    usable &= usable[mirror] & (template[:, 0] >= template[mirror, 0] - 1e-9)
    away = np.abs(template[:, 1] - height)
    rows = np.flatnonzero(usable & (away < max(_BAND, np.sort(away[usable])[: _MOST // 10].max(initial=0))))
    rows = rows[:: max(1, -(-len(rows) // _MOST))]
    return np.unique(np.concatenate([rows, mirror[rows]]))
