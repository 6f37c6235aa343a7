"""Joint regressors of models with known joints."""

import numpy as np
import pytest

from coregister import joints
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import HERE

RECONSTRUCTED = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


def _model(name: str, request: pytest.FixtureRequest) -> gnm_npz.GNMData:
    if name == "first":
        return request.getfixturevalue("model")
    return gnm_npz.read(HERE / "tiny_gnm.npz" if name == "tiny" else RECONSTRUCTED)


@pytest.mark.parametrize("name", ["tiny", "first", pytest.param("reconstructed", marks=needs_shared)])
def test_a_regressor_gives_the_joints_of_random_heads(name: str, request: pytest.FixtureRequest):
    model = _model(name, request)
    regressor = joints.rebuild_regressor(model)
    assert regressor.min() >= 0
    np.testing.assert_allclose(regressor.sum(1), 1, atol=1e-9)
    mirror_joints = {"neck": "neck", "head": "head", "left_eye": "right_eye", "right_eye": "left_eye"}
    names = model.joint_names.tolist()
    for joint, mirror_joint in mirror_joints.items():
        mirrored = regressor[names.index(mirror_joint)][model.mirror_indices]
        np.testing.assert_allclose(regressor[names.index(joint)], mirrored, atol=1e-12)
    # Sparse: rings of skin, or the eye.
    count = (regressor > 0).sum(1)
    assert (
        count[:2].max() < 0.05 * regressor.shape[1] + 20 and not (regressor[:2] > 0)[:, ~regions.exterior(model)].any()
    )
    for ball, row in zip(regions.eyeballs(model), regressor[2:], strict=True):
        assert not (row > 0)[~ball].any()
    rng = np.random.default_rng(0)
    c = rng.normal(size=(100, len(model.vertex_identity_basis)))
    heads = model.template_vertex_positions + np.tensordot(c, model.vertex_identity_basis.astype(np.float64), 1)
    truth = model.template_joint_positions + np.tensordot(c, model.joint_identity_basis.astype(np.float64), 1)
    error = 1e3 * np.linalg.norm(np.einsum("jv,nvc->njc", regressor, heads) - truth, axis=2)
    print(f"{name}: joint error {error.mean():.3f} mm, {error.max():.3f} at most")
    assert error.max() < 0.5
