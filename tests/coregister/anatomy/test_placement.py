from dataclasses import replace

import numpy as np
import pytest

from coregister.anatomy.placement import manifest, place
from registration.errors import InputError
from registration.geometry.rigid import motion_fields
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import HERE


@pytest.fixture(scope="module")
def tiny():
    return with_lips_inside(gnm_npz.read(HERE / "tiny_gnm.npz"))


def with_lips_inside(data):
    """The small model, of which a part of the skin at the lips counts as the mouth's lining."""
    names = data.vertex_group_names.tolist()
    groups = data.vertex_groups.copy()
    lips = np.maximum(groups[names.index("upper_lip")], groups[names.index("lower_lip")]) > 0.5
    groups[names.index("mouth_sock")] = lips
    return replace(data, vertex_groups=groups)


def rigid(data, twist):
    return np.tensordot(twist, motion_fields(data.template_vertex_positions.astype(np.float64)), 1)


def with_bases(data, identity=None, expression=None):
    identity = data.vertex_identity_basis[:1] * 0 if identity is None else identity
    expression = data.expression_basis[:1] * 0 if expression is None else expression
    K, E = len(identity), len(expression)
    return replace(
        data,
        vertex_identity_basis=identity.astype(np.float32),
        joint_identity_basis=np.zeros((K, *data.joint_identity_basis.shape[1:]), np.float32),
        identity_names=np.array([f"head_{k:03d}" for k in range(K)]),
        expression_basis=expression.astype(np.float32),
        expression_names=np.array([f"lower_face_region_{k:03d}" for k in range(E)]),
    )


def test_a_rigid_motion_of_the_jaw_is_given_to_lower_teeth_and_tongue(tiny):
    skin = regions.skin(tiny)
    motion = rigid(tiny, np.array([0.3, 0.02, -0.01, 0.0, -0.004, 0.002]))
    model = with_bases(tiny, expression=np.where(skin[:, None], motion, 0)[None])
    placed = place(model)
    parts = regions.jaw_parts(tiny)
    assert np.abs(placed.data.expression_basis[0, parts] - motion[parts]).max() < 1e-7
    assert np.array_equal(placed.data.expression_basis[0, ~parts], model.expression_basis[0, ~parts])
    assert placed.record["not_rigid_mm"] < 1e-3 and placed.record["components"] == {"identity": 0, "expression": 1}


def test_identity_translates_teeth_and_tongue_with_the_mean_of_both_lips(tiny):
    skin = regions.skin(tiny)
    upper, lower = regions.inner_lip_vertices(tiny)
    basis = np.zeros((2, len(skin), 3))
    basis[0, upper], basis[0, lower] = (0, 1e-3, 0), (0, -3e-3, 2e-3)
    eye = regions.eyeballs(tiny)[0]
    basis[1, eye] = 1e-3  # moves no skin: the eyes' own component
    basis[1, regions.tongue(tiny)] = 7e-3
    placed = place(with_bases(tiny, identity=basis)).data.vertex_identity_basis
    gums = np.logical_or(*regions.gums(tiny))
    for part in (regions.teeth(tiny) | gums, regions.tongue(tiny)):
        assert placed[0, part] == pytest.approx(np.tile([0, -1e-3, 1e-3], (part.sum(), 1)), abs=1e-9)
    assert np.array_equal(placed[1], basis[1].astype(np.float32))


def test_placement_is_idempotent_and_its_manifest_names_both_models(tiny):
    once = place(tiny)
    twice = place(once.data)
    assert gnm_npz.content_hash(twice.data) == gnm_npz.content_hash(once.data)
    assert twice.record["moved_mm"] == pytest.approx({"identity": 0, "expression": 0}, abs=1e-5)
    written = manifest(once, tiny)
    assert written["inputs"]["previous"] == gnm_npz.content_hash(tiny) != written["content_id"]


def test_a_model_without_inner_lips_is_refused():
    with pytest.raises(InputError, match="cannot be placed") as error:
        place(gnm_npz.read(HERE / "tiny_gnm.npz"))
    assert error.value.expected == "at least 3 vertices of the inner upper lip" and error.value.got == "0"


@needs_shared
def test_the_open_jaw_of_a_real_basis_is_near_that_of_its_teeth():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    rows = [k for k, name in enumerate(data.expression_names.tolist()) if name.startswith("lower_face")][:4]
    model = with_bases(data, expression=data.expression_basis[rows].astype(np.float32))
    teeth = regions.lower_teeth(data)
    before, after = model.expression_basis[:, teeth], place(model).data.expression_basis[:, teeth]
    assert (before * after).sum() > 0.8 * np.linalg.norm(before) * np.linalg.norm(after)
