import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.landmark_fit.landmark_model import LandmarkModel, turned
from registration.model.gnm_numpy import evaluate
from tests.registration.landmark_fit.scenes import rotated, scheme, tiny


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "correctives"])
def case(request):
    data = tiny(request.param)
    points = scheme(data)
    model = LandmarkModel(data, points.indices, points.weights)
    random = np.random.default_rng(1)
    identity = random.normal(size=len(data.vertex_identity_basis))
    expression = random.normal(size=len(data.expression_basis))
    joints = rotated(np.tile(np.eye(3), (len(data.joint_names), 1, 1)), 2)
    return data, points, model, identity, expression, joints


def test_equals_the_gnm_function(case):
    data, points, model, identity, expression, joints = case
    turn, shift = model.root(identity, joints)
    posed = model(identity, expression, joints).points @ turn.T + shift
    root = joints[0] @ turn.T
    first = model.joint_positions(identity)[0]
    world = (posed - first) @ root.T + first
    local = joints.copy()
    local[0] = root
    expected = evaluate(
        data,
        identity=identity,
        expression=expression,
        rotations=Rotation.from_matrix(local).as_rotvec(),
        translation=np.zeros(3),
    )
    np.testing.assert_allclose(world, points.points(expected), atol=1e-9)


def test_derivatives_are_those_of_finite_differences(case):
    _, _, model, identity, expression, joints = case
    posed = model(identity, expression, joints, by_identity=True, by_expression=True, by_joints=True)
    step = 1e-6

    def check(derivatives, points):
        np.testing.assert_allclose(derivatives, ((points - posed.points) / step).T, atol=2e-6)

    for k in range(len(identity)):
        check(posed.by_identity[:, :, k], model(identity + step * np.eye(len(identity))[k], expression, joints).points)
    for k in range(len(expression)):
        changed = expression + step * np.eye(len(expression))[k]
        check(posed.by_expression[:, :, k], model(identity, changed, joints).points)
    for k in range(3, 3 * len(joints)):
        steps = np.zeros((len(joints), 3))
        steps.flat[k] = step
        check(posed.by_joints[:, :, k], model(identity, expression, turned(joints, steps)).points)


def test_gradients_equal_the_product_with_the_derivatives(case):
    _, _, model, identity, expression, joints = case
    posed = model(identity, expression, joints, by_identity=True, by_expression=True, by_joints=True)
    forces = np.random.default_rng(3).normal(size=posed.points.shape)
    derivatives = (posed.by_identity, posed.by_expression, posed.by_joints)
    for gradient, matrix in zip(model.pulled_back(identity, expression, joints, forces), derivatives, strict=True):
        np.testing.assert_allclose(gradient, np.einsum("dlk,ld->k", matrix, forces), atol=1e-10)


def test_a_subset_has_the_points_of_the_whole(case):
    _, points, model, identity, expression, joints = case
    rows = np.arange(0, len(points.indices), 7)
    whole = model(identity, expression, joints, by_expression=True)
    for part in (
        model.subset(rows)(identity, expression, joints, by_expression=True),
        model(identity, expression, joints, rows=rows, by_expression=True),
    ):
        np.testing.assert_allclose(part.points, whole.points[rows], atol=1e-12)
        np.testing.assert_allclose(part.by_expression, whole.by_expression[:, rows], atol=1e-12)


def test_the_head_stays_when_it_turns_against_the_neck(case):
    data, points, model, identity, expression, joints = case
    if data.pose_correctives_regressor.any():
        pytest.skip("pose correctives bend the head when it turns")
    weights = np.einsum("lk,jlk->lj", points.weights, data.skinning_weights[:, points.indices])
    rigid = weights[:, model.anchor] > 1 - 1e-9
    assert rigid.sum() > 20
    steps = np.zeros((len(joints), 3))
    steps[model.anchor] = 0.2
    moved = model(identity, expression, turned(joints, steps)).points - model(identity, expression, joints).points
    assert np.abs(moved[rigid]).max() < 1e-12
    assert np.abs(moved).max() > 1e-4
