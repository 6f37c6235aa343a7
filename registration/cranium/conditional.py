"""The whole head given its observed skin, under the auxiliary model [Ploumpis 2019].

Ploumpis regresses head coefficients on face coefficients; with 200 heads that inverse is ill-conditioned. The Gaussian
conditional has the same purpose and a posterior. See docs/algorithms.md, "Cranium".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.cranium.auxiliary_model import CraniumModel
from registration.geometry import rigid
from registration.geometry.topology import vertex_areas

TWIST_SIGMA = (0.05, 0.01)  # of what is left of the pose after the alignment: rad, m
_PATCH_M2 = 1e-4  # the noise is that of a square centimetre


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """A whole head as the auxiliary model expects it. Frame of the observed head, metres."""

    vertices: Float[np.ndarray, "V 3"]
    deviation: Float[np.ndarray, "V"]  # posterior standard deviation of the position, all three axes together


def patch_areas(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V"]:
    """Return the skin at each vertex in patches of a square centimetre, of which each is one observation."""
    return vertex_areas(vertices, triangles) / _PATCH_M2


def twist_fields(points: Float[np.ndarray, "V 3"], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 V 3"]:
    """Return displacements by a standard deviation of each rotation about `centre` and each translation, metres."""
    return rigid.motion_fields(points - centre) * np.repeat(TWIST_SIGMA, 3)[:, None, None]


def predict(model: CraniumModel, head: Float[np.ndarray, "V 3"], patches: Float[np.ndarray, "V"]) -> Prediction:
    """Return the whole head given its observed skin: b = (B_f' O B_f + s^2 I)^-1 B_f' O (x_f - mu_f).

    B also holds the small motions that the rigid alignment by the observed skin has left, so that the pose does not
    have to be known.

    Args:
        model: the auxiliary model.
        head: of metric size, in any pose of the whole head; metres.
        patches: weight O of each vertex, `patch_areas` where observed; 0: hidden.
    """
    T_model_head = rigid.align(head[None], model.mean, patches[None])[0]
    rotation, translation = T_model_head[:3, :3], T_model_head[:3, 3]
    local = head @ rotation.T + translation
    observed = np.flatnonzero(patches > 0)
    centre = np.average(model.mean[observed], axis=0, weights=patches[observed])
    basis = np.concatenate([model.basis, twist_fields(model.mean, centre)])
    rows = basis[:, observed].reshape(len(basis), -1)
    weighted = (basis[:, observed] * patches[observed, None]).reshape(len(basis), -1)
    system = weighted @ rows.T + model.noise**2 * np.eye(len(basis))
    coefficients = np.linalg.solve(system, weighted @ (local - model.mean)[observed].ravel())
    whole = model.mean + np.tensordot(coefficients, basis, 1)
    # Covariance s^2 system^-1 = (s R^-1)(s R^-1)' with system = R'R.
    root = model.noise * np.linalg.inv(np.linalg.cholesky(system).T)
    spread = np.einsum("kvc,kr->rvc", basis, root, optimize=True)
    variance = np.square(spread).sum((0, 2)) + model.residual**2
    return Prediction(vertices=(whole - translation) @ rotation, deviation=np.sqrt(variance))
