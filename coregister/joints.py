"""Joints: the first model's head and neck weights, and joint positions from vertices [GNM, Head Identity];
docs/algorithms.md, "Joint regressor"."""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from registration.geometry.smoothstep import smoothstep
from registration.model import regions
from registration.model.gnm_npz import GNMData

# The head's weight rises from 0 to 1 between two parallel planes through the neck, which slope down from the nape to
# under the chin: heights of y + _SLOPE z, metres, in the model's frame.
_SLOPE = 0.29
_NECK, _SKULL = 0.140, 0.222
_BAND = 12e-3  # metres above and below a joint, from which exterior skin is a candidate of its regressor
_MAX_CANDIDATES = 300  # of one joint on one side
_MIN_WEIGHT = 0.05  # of the joint in its candidates' motion
_REGULARIZATION = 3e-4  # metres: weight of the quadratic term that spreads the regressor's weights


def head_weight(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """Return the skinning weight of the head joint, 0 to 1; the neck joint, the root, has the rest.

    Args:
        vertices: of the skin, metres, the model's frame.
    """
    return smoothstep(0, 1, (vertices[:, 1] + _SLOPE * vertices[:, 2] - _NECK) / (_SKULL - _NECK))


def regressor(
    candidates: Int[np.ndarray, "N"],
    shapes: Float[np.ndarray, "S V 3"],
    joints: Float[np.ndarray, "S 3"],
) -> Float[np.ndarray, "V"]:
    """Return non-negative weights with sum one that best give a joint of every shape from the candidates' positions.

    Args:
        candidates: vertices that may have a weight.
        shapes: heads; or a head, then displacements. Metres.
        joints: of the shapes: positions, or a position, then displacements.
    """
    rows = shapes[:, candidates].transpose(0, 2, 1).reshape(-1, len(candidates))
    ones = np.ones((1, len(candidates)))
    A = np.concatenate([rows, ones, _REGULARIZATION * np.eye(len(candidates))])
    weights, _ = nnls(A, np.concatenate([joints.ravel(), [1.0], np.zeros(len(candidates))]), maxiter=50_000)
    result = np.zeros(shapes.shape[1])
    result[candidates] = weights / weights.sum()
    return result


def rebuild_regressor(data: GNMData) -> Float[np.ndarray, "J V"]:
    """Return a joint regressor fitted to a model's own joints over all its identity components.

    Sparse, mirror-symmetric, weights of at least 0 with sum one in each row. A joint with a rigid part of its own (an
    eye) depends on that part; any other one on a ring of exterior skin about it that moves with it.
    """
    mirror, template = data.mirror_indices, data.template_vertex_positions.astype(np.float64)
    shapes = np.concatenate([template[None], data.vertex_identity_basis.astype(np.float64)])
    positions = np.concatenate([data.template_joint_positions[None], data.joint_identity_basis]).astype(np.float64)
    weights = data.skinning_weights / data.skinning_weights.sum(0)
    rigid_parts = (weights > 0.999) & ~regions.skin(data)
    rows = np.zeros(weights.shape)
    for joint, mirror_joint in enumerate(_mirror_joints(weights, mirror)):
        if rigid_parts[joint].any() and mirror_joint != joint:
            if joint < mirror_joint:
                rows[joint] = regressor(np.flatnonzero(rigid_parts[joint]), shapes[:1], positions[:1, joint])
                rows[mirror_joint] = rows[joint][mirror]
            continue
        candidates = _ring(data, weights[joint], template, positions[0, joint, 1])
        row = regressor(candidates, shapes, positions[:, joint])
        rows[joint] = (row + row[mirror]) / 2
    return rows


def _mirror_joints(weights: Float[np.ndarray, "J V"], mirror: Int[np.ndarray, "V"]) -> list[int]:
    """Each joint's mirror image: the joint whose vertices are the mirror images of its own."""
    overlap = np.minimum(weights[:, None, mirror], weights[None]).sum(-1)
    return overlap.argmax(1).tolist()


def _ring(
    data: GNMData, weight: Float[np.ndarray, "V"], template: Float[np.ndarray, "V 3"], height: float
) -> Int[np.ndarray, "N"]:
    """Exterior skin without ears that moves with the joint, near its height, as many vertices on both sides."""
    mirror = data.mirror_indices
    usable = regions.exterior(data) & ~regions.ears(data) & (weight > _MIN_WEIGHT)
    usable &= usable[mirror] & (template[:, 0] >= template[mirror, 0] - 1e-9)
    distance = np.abs(template[:, 1] - height)
    nearest = np.sort(distance[usable])[: _MAX_CANDIDATES // 10]
    rows = np.flatnonzero(usable & (distance < max(_BAND, nearest.max(initial=0))))
    rows = rows[:: max(1, -(-len(rows) // _MAX_CANDIDATES))]
    return np.unique(np.concatenate([rows, mirror[rows]]))
