"""What stabilization left, against the truth."""

import numpy as np

from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import angle_deg
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from tests.stabilize.performed import Performed, Seen


def left(T_neutral_expression: np.ndarray, seen: Seen, truth: Performed, data: GNMData) -> np.ndarray:
    """Degrees and mm (rms over the face mask) of each residual motion, (2, S)."""
    face = truth.neutral[group(data, "hockey_mask") > 0.5]
    return residual(T_neutral_expression @ seen.T_expression_neutral, face)


def residual(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Degrees and rms mm at some points of each motion (S, 4, 4), as (2, S)."""
    moved = np.stack([transform_points(motion, points) - points for motion in motions])
    return np.stack([angle_deg(motions), MM_PER_M * np.sqrt((moved**2).sum(-1).mean(1))])
