from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from registration.frames import axis_angle_to_matrix
from registration.model import gnm_npz, gnm_numpy
from registration.model.gnm import GNM
from registration.types import Parameters
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model


@pytest.fixture(autouse=True)
def _same_numbers_every_time():
    torch.manual_seed(0)


def random_parameters(model: GNM, *batch: int, seed: int = 0) -> Parameters:
    generator = torch.Generator().manual_seed(seed)
    rest = model.neutral(*batch)
    noise = {
        f.name: torch.randn(getattr(rest, f.name).shape, generator=generator, dtype=torch.float64) for f in fields(rest)
    }
    noise["rotations"] = 0.6 * noise["rotations"]
    noise["scale"] = 1 + 0.1 * noise["scale"]
    return Parameters(**{name: value.to(model.template) for name, value in noise.items()})


def with_correctives(data: gnm_npz.GNMData) -> gnm_npz.GNMData:
    regressor = np.random.default_rng(1).normal(size=data.pose_correctives_regressor.shape) * 1e-3
    return replace(data, pose_correctives_regressor=regressor.astype(np.float32))


def micro_model() -> gnm_npz.GNMData:
    """The tiny head cut down to a handful of vertices, so that every derivative can be checked by differences."""
    data = tiny_model()
    keep = np.r_[0:6, 860:864, 900:904, 1000:1003]
    basis = {name: getattr(data, name)[:, keep] for name in ("vertex_identity_basis", "expression_basis")}
    basis["vertex_identity_basis"] = basis["vertex_identity_basis"][:3]
    basis["expression_basis"] = basis["expression_basis"][:2] + np.float16(0.01)
    blend = np.random.default_rng(2).dirichlet(np.ones(4), len(keep)).T
    correctives = np.random.default_rng(3).normal(size=(36, 3 * len(keep))) * 0.01
    return replace(
        data,
        template_vertex_positions=data.template_vertex_positions[keep],
        joint_identity_basis=data.joint_identity_basis[:3],
        skinning_weights=blend.astype(np.float32),
        pose_correctives_regressor=correctives.astype(np.float32),
        mirror_indices=data.mirror_indices[: len(keep)],
        joint_regressor=data.joint_regressor[:, keep],
        vertex_groups=data.vertex_groups[:, keep],
        identity_names=data.identity_names[:3],
        expression_names=data.expression_names[:2],
        **basis,
    )


@pytest.mark.parametrize("correctives", [False, True])
def test_the_model_agrees_with_the_numpy_reference(correctives):
    data = with_correctives(tiny_model()) if correctives else tiny_model()
    model = GNM(data, torch.float64)
    offsets = 1e-3 * torch.randn(*data.template_vertex_positions.shape, dtype=torch.float64)
    for seed in range(3):
        p = random_parameters(model, seed=seed)
        numbers = {f.name: getattr(p, f.name).numpy() for f in fields(p)}
        numbers["scale"] = float(numbers["scale"])
        expected = gnm_numpy.evaluate(data, **numbers, offsets=offsets.numpy())
        size = np.ptp(expected, axis=0).max()
        assert np.abs(model(p, offsets).numpy() - expected).max() < 1e-6 * size
        single = GNM(data, torch.float32)(random_parameters(GNM(data), seed=seed), offsets.float())
        assert np.abs(single.numpy() - expected).max() < 3e-6 * size


def test_skinning_weights_are_normalized():
    """The paper's inverse homogeneous map: a vertex' weights count relative to their sum."""
    data = tiny_model()
    doubled = replace(data, skinning_weights=data.skinning_weights * np.float32(2))
    p = random_parameters(GNM(data, torch.float64))
    torch.testing.assert_close(GNM(doubled, torch.float64)(p), GNM(data, torch.float64)(p))


def test_the_rest_pose_is_the_template():
    data = tiny_model()
    model = GNM(data)
    expected = torch.from_numpy(data.template_vertex_positions)
    torch.testing.assert_close(model(model.neutral()), expected, rtol=0, atol=1e-6)


def test_the_root_rotates_about_the_neck_and_scale_precedes_translation():
    data = tiny_model()
    model = GNM(data, torch.float64)
    rotations = torch.zeros(4, 3, dtype=torch.float64)
    rotations[0, 1] = np.pi / 2
    shift = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    transformed = model(
        replace(model.neutral(), rotations=rotations, translation=shift, scale=torch.tensor(2.0).double())
    )
    neck = data.template_joint_positions[0].astype(np.float64)
    x, y, z = (data.template_vertex_positions.astype(np.float64) - neck).T
    expected = 2 * (np.stack([z, y, -x], 1) + neck) + shift.numpy()
    np.testing.assert_allclose(transformed.numpy(), expected, atol=1e-6)


def test_eyes_follow_the_head():
    """Rotating the head by a and the eyes by -a about parallel axes keeps an eye's orientation."""
    data = tiny_model()
    model = GNM(data, torch.float64)
    rotations = torch.zeros(4, 3, dtype=torch.float64)
    rotations[1, 1], rotations[2:, 1] = 0.4, -0.4
    eye = data.vertex_groups[data.vertex_group_names.tolist().index("left_eye")] > 0
    before = model(model.neutral())[eye]
    after = model(replace(model.neutral(), rotations=rotations))[eye]
    torch.testing.assert_close(after - after.mean(0), before - before.mean(0), rtol=0, atol=1e-6)
    assert (after.mean(0) - before.mean(0)).norm() > 0.02


def test_batch_equals_one_by_one():
    model = GNM(with_correctives(tiny_model()), torch.float64)
    p = random_parameters(model, 2, 3)
    offsets = 1e-3 * torch.randn(len(model.weights), 3, dtype=torch.float64)
    batched = model(p, offsets)
    assert batched.shape == (2, 3, len(model.weights), 3)
    single = Parameters(**{f.name: getattr(p, f.name)[1, 2] for f in fields(p)})
    torch.testing.assert_close(batched[1, 2], model(single, offsets))
    each = torch.randn(2, 3, len(model.weights), 3, dtype=torch.float64)
    torch.testing.assert_close(model(p, each)[1, 2], model(single, each[1, 2]))


def test_derivatives_agree_with_finite_differences():
    model = GNM(micro_model(), torch.float64)
    p = random_parameters(model, 2)
    values = [getattr(p, f.name).requires_grad_(True) for f in fields(p)]
    names = [f.name for f in fields(p)]
    offsets = torch.zeros(len(model.weights), 3, dtype=torch.float64, requires_grad=True)

    def call(offsets: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        return model(Parameters(**dict(zip(names, values, strict=True))), offsets)

    assert torch.autograd.gradcheck(call, (offsets, *values))


def test_derivatives_at_rest_are_finite_and_correct():
    model = GNM(micro_model(), torch.float64)
    rotations = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: model(replace(model.neutral(), rotations=r)), (rotations,))


def test_zero_pose_correctives_are_omitted():
    assert GNM(tiny_model()).corrective_basis is None
    model = GNM(tiny_model())
    assert not model.correctives(axis_angle_to_matrix(random_parameters(model, 2).rotations)).any()


def test_parameters_of_a_sample_are_recovered():
    """Sample, evaluate, fit by Gauss-Newton from rest: the parameters are recovered."""
    model = GNM(tiny_model(), torch.float64)
    truth = random_parameters(model, seed=5)
    truth = replace(truth, rotations=0.5 * truth.rotations, scale=torch.ones((), dtype=torch.float64))
    names = ("identity", "expression", "rotations", "translation")
    sizes = [getattr(truth, name).numel() for name in names]
    target = model(truth)

    def residual(packed: torch.Tensor) -> torch.Tensor:
        parts = dict(zip(names, packed.split(sizes), strict=True))
        parts["rotations"] = parts["rotations"].unflatten(0, (-1, 3))
        return (model(Parameters(**parts, scale=truth.scale)) - target).flatten()

    packed = torch.zeros(sum(sizes), dtype=torch.float64)
    for _ in range(15):
        jacobian = torch.func.jacfwd(residual)(packed)
        packed = packed - torch.linalg.lstsq(jacobian, residual(packed)[:, None]).solution[:, 0]
    expected = torch.cat([getattr(truth, name).flatten() for name in names])
    torch.testing.assert_close(packed, expected, rtol=0, atol=1e-8)


@needs_shared
def test_the_real_posed_example_is_reproduced():
    """A head rotated by 0.32 rad and eyes by -0.16 rad, from the original model: within 0.001 mm."""
    folder = SHARED / "data" / "gnm"
    data, real = gnm_npz.read(folder / "gnm_head_reconstructed.npz"), np.load(folder / "gnm_real_samples.npz")
    who = int(real["posed_identity_index"])
    smile = np.einsum("e,evc->vc", real["posed_expression_weights"], real["expression_deltas"])
    bind = torch.from_numpy(data.template_vertex_positions + real["identity_deltas"][who] + smile).double()
    model = GNM(data, torch.float64)
    joints = torch.from_numpy(real["bind_joints"]).double()
    posed = model.skin(bind, joints, axis_angle_to_matrix(torch.from_numpy(real["posed_rotations"]).double()))
    assert (posed - bind - torch.from_numpy(real["posed_vertex_delta"])).norm(dim=-1).max() < 1e-6
    computed = model.joints(torch.from_numpy(real["reconstructed_identity_coefficients"][who]).double())
    torch.testing.assert_close(computed, joints, rtol=0, atol=1e-6)
