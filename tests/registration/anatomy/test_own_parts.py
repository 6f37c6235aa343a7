from dataclasses import replace

import numpy as np
import pytest

from registration.anatomy.own_parts import (
    FIGURE,
    OwnParts,
    PartEstimate,
    found_alone,
    fuse,
    still_components,
    views_that_see,
    with_parts,
)
from registration.model import gnm_npz, gnm_numpy, regions
from registration.types import Camera
from tests.conftest import FIXTURES
from tests.registration.storage.test_registration_folder import a_registration


@pytest.fixture(scope="module")
def data():
    """The tiny head with three components that move teeth alone, and one that moves skin."""
    tiny = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
    teeth = np.flatnonzero(~regions.skin(tiny))
    rng = np.random.default_rng(0)
    rows = np.zeros((3, *tiny.template_vertex_positions.shape), np.float32)
    rows[:, teeth] = 2e-3 * rng.standard_normal((3, len(teeth), 3))
    return replace(
        tiny,
        vertex_identity_basis=np.concatenate([tiny.vertex_identity_basis, rows]),
        joint_identity_basis=np.concatenate(
            [tiny.joint_identity_basis, np.zeros((3, *tiny.template_joint_positions.shape), np.float32)]
        ),
        identity_names=np.array([*tiny.identity_names, "teeth_000", "teeth_001", "teeth_002"]),
    )


@pytest.fixture(scope="module")
def parts(data):
    return OwnParts.of(data)


def _parameters(data, identity):
    joints = len(data.joint_names)
    rng = np.random.default_rng(1)
    return {
        "identity": np.asarray(identity, np.float32),
        "expression": np.full(len(data.expression_basis), 0.2, np.float32),
        "rotations": (0.1 * rng.standard_normal((joints, 3))).astype(np.float32),
        "translation": np.array([0.1, 0.2, 0.3], np.float32),
        "scale": np.float32(1.1),
        "offsets": np.zeros_like(data.template_vertex_positions),
    }


def _registration(data, identity):
    parameters = _parameters(data, identity)
    vertices = gnm_numpy.evaluate(
        data, **{k: float(v) if k == "scale" else v.astype(np.float64) for k, v in parameters.items()}
    )
    triangles = data.triangles.astype(np.int32)
    return a_registration(
        **{**parameters, "scale": np.array(parameters["scale"])},
        vertices=vertices.astype(np.float32),
        triangles=triangles,
        confidence=np.ones(len(vertices), np.float32),
        corner_uvs=np.zeros((len(triangles), 3, 2), np.float32),
    )


def test_components_that_move_no_skin(data, parts):
    assert data.identity_names[still_components(data)].tolist() == ["teeth_000", "teeth_001", "teeth_002"]
    assert not regions.skin(data)[parts.vertices].any() and len(parts.vertices)
    moves_a_joint = data.joint_identity_basis.copy()
    moves_a_joint[-1, 0] = 1e-3
    assert len(still_components(replace(data, joint_identity_basis=moves_a_joint))) == 2


def test_captures_count_by_what_they_saw(parts):
    count = len(parts.vertices)
    truth, nothing, wrong = np.array([1.0, -2.0, 0.5]), np.zeros(count, np.int64), np.array([9.0, 9.0, 9.0])
    everything = np.full(count, 1000)
    found = fuse(
        parts, [PartEstimate(coefficients=truth, views=everything), PartEstimate(coefficients=wrong, views=nothing)]
    )
    assert np.allclose(found, truth, rtol=1e-3)
    assert not fuse(parts, [PartEstimate(coefficients=wrong, views=nothing)]).any()
    twice = [
        PartEstimate(coefficients=truth, views=3 * everything),
        PartEstimate(coefficients=-truth, views=everything),
    ]
    assert np.allclose(fuse(parts, twice), truth / 2, rtol=1e-3)


def test_only_the_own_parts_change(data, parts):
    before = _registration(data, [0.3] * 6 + [0.0, 0.0, 0.0])
    wanted = np.array([1.0, -1.0, 2.0], np.float32)
    after = with_parts(before, data, parts, wanted, {})
    expected = _registration(data, [0.3] * 6 + wanted.tolist())
    assert np.abs(after.vertices - expected.vertices).max() < 1e-6
    others = np.setdiff1d(np.arange(len(after.vertices)), parts.vertices)
    assert np.array_equal(after.vertices[others], before.vertices[others])
    assert np.abs(after.vertices - before.vertices)[parts.vertices].max() > 1e-3
    shared = replace(after, figures={FIGURE: {"alone": [0.0, 0.0, 0.0]}})
    assert np.abs(found_alone(shared, data, parts, {}).vertices - before.vertices).max() < 1e-6


def test_views_that_see_a_point():
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1.0]])
    intrinsics = np.array([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]])
    front, back = np.eye(4), np.diag([-1.0, 1, -1, 1])
    front[2, 3] = back[2, 3] = 5
    cameras = [Camera(width_px=100, height_px=100, intrinsics=intrinsics, T_cam_world=pose) for pose in (front, back)]
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    assert views_that_see(square, triangles, cameras, np.array([4, 0])).tolist() == [1, 2]
