"""Joints told from the skin: by models of which they are known."""

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
def test_a_regressor_gives_the_joints_of_random_people(name: str, request: pytest.FixtureRequest):
    model = _model(name, request)
    found = joints.rebuild_regressor(model)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-9)
    twins = {"neck": "neck", "head": "head", "left_eye": "right_eye", "right_eye": "left_eye"}
    names = model.joint_names.tolist()
    for joint, twin in twins.items():
        mirrored = found[names.index(twin)][model.mirror_indices]
        np.testing.assert_allclose(found[names.index(joint)], mirrored, atol=1e-12)
    # Sparse: rings of skin, or the eye itself.
    count = (found > 0).sum(1)
    assert count[:2].max() < 0.05 * found.shape[1] + 20 and not (found[:2] > 0)[:, ~regions.exterior(model)].any()
    for ball, row in zip(regions.eyeballs(model), found[2:], strict=True):
        assert not (row > 0)[~ball].any()
    rng = np.random.default_rng(0)
    c = rng.normal(size=(100, len(model.vertex_identity_basis)))
    heads = model.template_vertex_positions + np.tensordot(c, model.vertex_identity_basis.astype(np.float64), 1)
    truth = model.template_joint_positions + np.tensordot(c, model.joint_identity_basis.astype(np.float64), 1)
    error = 1e3 * np.linalg.norm(np.einsum("jv,nvc->njc", found, heads) - truth, axis=2)
    print(f"{name}: joints off by {error.mean():.3f} mm, {error.max():.3f} at most")
    assert error.max() < 0.5
