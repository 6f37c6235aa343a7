"""The torch model against GNM's own function, finite differences, and its own affine map."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from registration.errors import InputError
from registration.frames import axis_angle_to_matrix
from registration.linear_models.data import LinearModelData, check
from registration.linear_models.gnm import from_gnm
from registration.linear_models.model import LinearModel
from registration.model.gnm import GNM
from tests.registration.model.test_gnm import micro_model, random_parameters, with_correctives


@pytest.fixture(scope="module")
def data() -> LinearModelData:
    """A few vertices, all joints, and expressions that move the joints, as FLAME's do."""
    model = from_gnm(micro_model())
    moved = np.random.default_rng(5).normal(size=model.joints.expression_basis.shape).astype(np.float32) * 0.01
    return replace(model, triangles=np.array([[0, 1, 2]]), joints=replace(model.joints, expression_basis=moved))


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_gnm_file_is_the_function_of_gnm(batch):
    source = with_correctives(micro_model())
    gnm, model = GNM(source, torch.float64), LinearModel(from_gnm(source), torch.float64)
    parameters = random_parameters(gnm, *batch)
    assert torch.allclose(model(parameters), gnm(parameters), atol=1e-7)
    rest = model.neutral(*batch)
    assert torch.equal(model(rest)[(0,) * len(batch)], model.bind(rest.identity, rest.expression)[(0,) * len(batch)])


def test_the_affine_map_is_exact(data):
    model = LinearModel(data, torch.float64)
    p = random_parameters(model)
    p = replace(p, scale=torch.ones_like(p.scale), translation=torch.zeros_like(p.translation))
    assert torch.allclose(model.affine(p.rotations).vertices(p.identity, p.expression), model(p), atol=1e-12)
    batch = random_parameters(model, 4)
    turned = replace(
        batch,
        rotations=p.rotations.expand(4, -1, -1),
        scale=torch.ones(4).double(),
        translation=torch.zeros(4, 3).double(),
    )
    mapped = model.affine(p.rotations).vertices(batch.identity, batch.expression)
    assert torch.allclose(mapped, model(turned), atol=1e-12)


def test_derivatives_agree_with_finite_differences(data):
    model = LinearModel(data, torch.float64)
    p = random_parameters(model)
    exact = model.derivatives(p)
    assert torch.allclose(exact.vertices, model(p), atol=1e-12)
    for name in ("identity", "expression", "rotations", "scale"):
        value, derivative = getattr(p, name), getattr(exact, name)
        for index in np.ndindex(*value.shape):
            step = torch.zeros_like(value)
            step[index] = 1e-6
            ends = [model(replace(p, **{name: value + sign * step})) for sign in (1, -1)]
            assert torch.allclose((ends[0] - ends[1]) / 2e-6, derivative[index], atol=1e-6), (name, index)


def test_gradients_flow_to_all_parameters(data):
    model = LinearModel(data, torch.float64)
    parameters = random_parameters(model, 2)
    leaves = {f.name: getattr(parameters, f.name).requires_grad_() for f in fields(parameters)}
    model(replace(parameters, **leaves)).square().sum().backward()
    assert all(leaf.grad is not None and leaf.grad.abs().max() > 0 for leaf in leaves.values())


def test_a_dropped_joint_is_one_that_never_turns(data):
    name = data.joints.names[2]
    whole, reduced = LinearModel(data, torch.float64), LinearModel(data.without_joint(name), torch.float64)
    p = random_parameters(whole)
    still = p.rotations.clone()
    still[2] = 0
    kept = [j for j in range(len(data.joints.names)) if j != 2]
    assert reduced.joint_names == tuple(data.joints.names[j] for j in kept)
    assert torch.allclose(
        reduced(replace(p, rotations=p.rotations[kept])), whole(replace(p, rotations=still)), atol=1e-7
    )
    check(data.without_joint(name), "here")
    with pytest.raises(InputError, match="no such joint"):
        data.without_joint("jaw")
    with pytest.raises(InputError, match="no such joint"):
        data.without_joint(data.joints.names[0])


def test_the_first_components_are_kept(data):
    short = data.truncated(identity=2, expression=1)
    check(short, "here")
    whole, model = LinearModel(data, torch.float64), LinearModel(short, torch.float64)
    p = random_parameters(whole)
    p.identity[2:] = 0
    p.expression[1:] = 0
    assert torch.allclose(model(replace(p, identity=p.identity[:2], expression=p.expression[:1])), whole(p))


def test_joints_of_many_heads_turn_together(data):
    """Rotations of one sample apply to a batch of bind poses, as in `affine`."""
    model = LinearModel(data, torch.float64)
    p, batch = random_parameters(model), random_parameters(model, 3)
    bind, joints = model.bind(batch.identity, batch.expression), model.joints(batch.identity, batch.expression)
    rotations = axis_angle_to_matrix(p.rotations)
    together = model.pose(bind, joints, rotations)
    alone = torch.stack([model.pose(b, j, rotations) for b, j in zip(bind, joints, strict=True)])
    assert torch.allclose(together, alone, atol=1e-12)
