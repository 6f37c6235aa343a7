"""What changes along a fitted sequence: opening of the mouth, rotation of the head, residuals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.frames import MM_PER_M
from registration.landmark_fit.result import LandmarkFit
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme

# Scheme -> landmarks in the middle of the inner borders of the upper and the lower lip.
_INNER_LIPS = {"68": (62, 66), "face478": (13, 14)}
_FACING = np.diag([1.0, -1.0, -1.0])  # rotation of a head that looks into the camera (OpenCV's axes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Values of each frame."""

    rotation_deg: Float[np.ndarray, "F 3"]  # yaw, pitch, roll of the head towards the first camera; 0: it looks into it
    rms_px: Float[np.ndarray, "F"]
    distance_mm: Float[np.ndarray, "F"]  # of the head's root from the first camera


def curves_of(fit: LandmarkFit, data: GNMData) -> Curves:
    """Return the curves of a fit; yaw is positive to the subject's left, pitch where the head looks down."""
    camera = fit.cameras[0].T_cam_world
    head = Rotation.from_rotvec(fit.rotations[:, 0])
    for joint in _chain(data)[1:]:
        head = head * Rotation.from_rotvec(fit.rotations[:, joint])
    facing = Rotation.from_matrix(_FACING @ camera[:3, :3]) * head
    position = fit.translation @ camera[:3, :3].T + camera[:3, 3]
    return Curves(
        rotation_deg=facing.as_euler("YXZ", degrees=True),
        rms_px=fit.rms_px,
        distance_mm=MM_PER_M * np.linalg.norm(position, axis=1),
    )


def mouth_opening_mm(scheme: LandmarkScheme, vertices: Float[np.ndarray, "F V 3"]) -> Float[np.ndarray, "F"] | None:
    """Return the distance of the lips' inner borders in the middle; None for a scheme without these landmarks."""
    pair = _INNER_LIPS.get(scheme.name)
    if pair is None:
        return None
    points = scheme.points(vertices)
    return np.asarray(MM_PER_M * np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=-1))


def _chain(data: GNMData) -> list[int]:
    """The joints from the root to the one that moves most of the nose's tip."""
    template = data.template_vertex_positions
    joint = int(data.skinning_weights[:, int(template[:, 2].argmax())].argmax())
    parents = data.joint_parent_indices.tolist()
    chain = [joint]
    while parents[chain[0]] >= 0 and chain[0] != 0:
        chain.insert(0, int(parents[chain[0]]))
    return chain
