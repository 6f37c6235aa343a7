"""Reference implementation of the GNM function in NumPy, float64, with which tests compare `gnm.py`."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.model.gnm_npz import GNMData


def evaluate(
    data: GNMData,
    *,
    identity: Float[np.ndarray, "I"],
    expression: Float[np.ndarray, "E"],
    rotations: Float[np.ndarray, "J 3"],
    translation: Float[np.ndarray, "3"],
    scale: float = 1.0,
    offsets: Float[np.ndarray, "V 3"] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """Return the posed vertices of one sample, metres, world [GNM, Model Formulation].

    Args:
        data: the model.
        identity: coefficients.
        expression: coefficients.
        rotations: axis-angle (radians), each joint relative to its parent.
        translation: metres.
        scale: applied to the posed mesh before the translation.
        offsets: added in the bind pose, metres.
    """
    bind = data.template_vertex_positions.astype(np.float64)
    for coefficient, mode in zip(identity, data.vertex_identity_basis, strict=True):
        bind = bind + coefficient * mode
    for coefficient, mode in zip(expression, data.expression_basis, strict=True):
        bind = bind + coefficient * mode
    local = [Rotation.from_rotvec(rotation).as_matrix() for rotation in rotations]
    feature = np.concatenate([(matrix - np.eye(3)).ravel() for matrix in local])
    bind = bind + (feature @ data.pose_correctives_regressor.astype(np.float64)).reshape(-1, 3)
    if offsets is not None:
        bind = bind + offsets

    joints = data.template_joint_positions.astype(np.float64)
    for coefficient, mode in zip(identity, data.joint_identity_basis, strict=True):
        joints = joints + coefficient * mode

    posed: list[np.ndarray] = []  # T_model_joint
    for j, parent in enumerate(data.joint_parent_indices):
        if j == 0:
            posed.append(_affine(local[j], joints[j]))
        else:
            posed.append(posed[parent] @ _affine(local[j], joints[j] - joints[parent]))

    homogeneous = np.concatenate([bind, np.ones((len(bind), 1))], 1)
    blended = np.zeros_like(homogeneous)
    for weights, T_model_joint, joint in zip(data.skinning_weights, posed, joints, strict=True):
        T_joint_bind = _affine(np.eye(3), -joint)
        blended += weights[:, None] * (homogeneous @ (T_model_joint @ T_joint_bind).T)
    return scale * blended[:, :3] / blended[:, 3:] + translation


def _affine(linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix
