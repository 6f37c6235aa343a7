"""A head model with known statistics: components with given standard deviations, orthogonal to one another and to rigid
motions over the head's skin. Based on the mesh and groups of the small fixture."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from registration.geometry.rigid import motion_fields
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from tests.conftest import FIXTURES

TINY = FIXTURES / "tiny_gnm.npz"
DEVIATIONS_MM = 0.5 * 0.7 ** np.arange(12)  # rms over the head's skin


def spectrum_model(seed: int = 0) -> GNMData:
    """12 identity components on the head's skin, 12 expression components within the lower face's mask."""
    data = gnm_npz.read(TINY)
    skin = regions.head_skin(data)
    mask = regions.expression_regions(data)["lower_face"][1]
    identity = _basis(data, skin.astype(float), seed)
    expression = _basis(data, mask.astype(float), seed + 1)
    return replace(
        with_identity(data, identity),
        expression_basis=expression,
        expression_names=np.array([f"lower_face_region_{k:03d}" for k in range(len(expression))]),
    )


def with_identity(data: GNMData, basis: Float[np.ndarray, "K V 3"]) -> GNMData:
    """The model with other identity components."""
    return replace(
        data,
        vertex_identity_basis=basis,
        joint_identity_basis=np.zeros((len(basis), len(data.joint_names), 3)),
        identity_names=np.array([f"head_{k:03d}" for k in range(len(basis))]),
    )


def _basis(data: GNMData, weights: np.ndarray, seed: int) -> Float[np.ndarray, "K V 3"]:
    rows = np.flatnonzero(weights)
    rest = data.template_vertex_positions[rows].astype(np.float64)
    fields = np.random.default_rng(seed).standard_normal((len(DEVIATIONS_MM), len(rows), 3)) * weights[rows][:, None]
    columns = np.concatenate([motion_fields(rest), fields]).reshape(6 + len(fields), -1).T
    free = np.linalg.qr(columns)[0].T[6:].reshape(fields.shape)
    basis = np.zeros((len(fields), *data.template_vertex_positions.shape))
    basis[:, rows] = free * (DEVIATIONS_MM * 1e-3 * np.sqrt(len(rows)))[:, None, None]
    return basis


def heads(data: GNMData, coefficients: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N V 3"]:
    return data.template_vertex_positions + np.tensordot(coefficients, data.vertex_identity_basis, 1)
