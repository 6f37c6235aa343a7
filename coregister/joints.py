"""Joints of the first model: how the skin hangs on them, and where they are for a given surface."""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from coregister.expression import smoothstep

# The head's weight rises from 0 to 1 between two parallel planes through the neck, which slope down from the nape to
# under the chin: heights of y + _SLOPE z, metres, in the model's frame.
_SLOPE = 0.29
_NECK, _SKULL = 0.140, 0.222
_SPREAD = 3e-4  # metres: how much accuracy the regressor gives for spreading its weights


def head_weight(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """Share of the head joint in the skin's motion; the neck joint, the root, has the rest (paper, Fig. Template)."""
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
