"""The mesh that a fit optimizes is the mesh of the saved parameters."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from registration.fit.variables import InitialGuess, Variables, initial_guess_from, skin_triangles, skin_vertices
from registration.geometry.large_steps import LargeSteps
from registration.model import regions
from registration.model.gnm import GNM
from registration.model.regions import exterior
from tests.fixtures.make_fixtures import tiny_model

RNG = np.random.default_rng(5)


def _fitted(plain: bool = False) -> tuple[Variables, GNM]:
    """Variables with non-zero values; unless `plain`, of a model with pose correctives, and with offsets everywhere."""
    data = tiny_model()
    correctives = RNG.normal(0, 0 if plain else 1e-3, data.pose_correctives_regressor.shape)
    data = replace(data, pose_correctives_regressor=correctives.astype(data.pose_correctives_regressor.dtype))
    model = GNM(data)
    initial = InitialGuess(
        rotation=Rotation.from_euler("xyz", (2.9, 0.4, -1.2)).as_matrix(),
        position=np.array([0.3, -1.1, 2.0]),
        scale=1.07,
        identity=RNG.normal(size=len(data.vertex_identity_basis)),
        expression=RNG.normal(size=len(data.expression_basis)),
        joints=RNG.normal(0, 0.2, (3, 3)),
        offsets=RNG.normal(0, 1e-3, data.template_vertex_positions.shape) if not plain else None,
    )
    variables = Variables(model, data, initial)
    variables["root"].copy_(torch.tensor([0.02, -0.05, 0.03]))
    variables["eyes"].copy_(torch.tensor(RNG.normal(0, 1e-3, (2, 4))))
    return variables, model


def test_saved_parameters_reproduce_the_mesh() -> None:
    variables, model = _fitted()
    parameters, offsets = variables.parameters()
    mesh = variables.vertices(variables.skin_offsets())
    torch.testing.assert_close(model(parameters, offsets), mesh, rtol=0, atol=2e-6)


def test_a_fit_starts_from_a_saved_registration() -> None:
    variables, model = _fitted()
    parameters, offsets = variables.parameters()
    again = Variables(model, tiny_model(), initial_guess_from(parameters, offsets.numpy(), model, tiny_model()))
    before, after = (u.vertices(u.skin_offsets()) for u in (variables, again))
    torch.testing.assert_close(after, before, rtol=0, atol=2e-6)


def test_freeing_offsets_keeps_the_mesh_and_only_free_variables_have_gradients() -> None:
    variables, model = _fitted()
    before = variables.vertices(variables.skin_offsets())
    triangles = skin_triangles(tiny_model().triangles, variables.skin, len(before))
    steps = LargeSteps(triangles, len(variables.skin), edge_length_m=5e-3, smoothing_m=2e-2, device=torch.device("cpu"))
    variables.set_free(["offsets", "eyes"], steps)
    mesh = variables.vertices(variables.skin_offsets())
    torch.testing.assert_close(mesh.detach(), before, rtol=0, atol=2e-6)
    mesh.square().sum().backward()
    got = {name for name, tensor in variables.tensors.items() if tensor.grad is not None}
    assert got == {"eyes"} and variables.latent.tensor.grad is not None
    variables.commit_latent()
    assert variables.latent is None
    torch.testing.assert_close(variables.vertices(variables.skin_offsets()).detach(), before, rtol=0, atol=2e-6)


def test_eyeballs_keep_their_shape() -> None:
    variables, _ = _fitted(plain=True)
    with torch.no_grad():
        variables["eyes"].zero_()
        rest = variables.vertices(variables.skin_offsets())
        variables["eyes"].copy_(torch.tensor([[1e-3, 0, 2e-3, 0.05], [0, 0, 0, 0]]))
        displaced = variables.vertices(variables.skin_offsets())
    left, right = variables._eyes
    assert torch.equal(rest[right], displaced[right])
    sizes = [torch.pdist(mesh[left][::7]) for mesh in (rest, displaced)]
    torch.testing.assert_close(sizes[1], sizes[0] * float(np.exp(0.05)), rtol=1e-3, atol=1e-6)


def test_contact_gradients_reach_only_offsets_and_tongue() -> None:
    variables, _ = _fitted()
    data = tiny_model()
    variables.set_free(list(variables.tensors))
    offsets = variables.skin_offsets().requires_grad_(True)
    mesh, same = (vertices(offsets) for vertices in (variables.vertices, variables.contact_vertices))
    torch.testing.assert_close(same, mesh, rtol=0, atol=0)
    same.square().sum().backward()
    got = {name for name, tensor in variables.tensors.items() if tensor.grad is not None and tensor.grad.any()}
    assert got == {"expression"} and offsets.grad.any()
    moves_skin = np.abs(data.expression_basis[:, exterior(data)]).max((1, 2)) > 0
    assert moves_skin.any() and not moves_skin.all()
    assert not variables["expression"].grad[torch.as_tensor(moves_skin)].any()


def test_own_parts_add_to_the_identity_that_is_saved() -> None:
    data = tiny_model()
    teeth = np.zeros((2, *data.template_vertex_positions.shape), np.float32)
    hidden = np.setdiff1d(np.arange(len(data.template_vertex_positions)), skin_vertices(data))
    teeth[:, hidden] = RNG.normal(0, 1e-3, (2, len(hidden), 3))
    joints = np.zeros((2, *data.template_joint_positions.shape), np.float32)
    data = replace(
        data,
        vertex_identity_basis=np.concatenate([data.vertex_identity_basis, teeth]),
        joint_identity_basis=np.concatenate([data.joint_identity_basis, joints]),
        identity_names=np.array([*data.identity_names, "teeth_000", "teeth_001"]),
    )
    model = GNM(data)
    identity = RNG.normal(size=len(data.vertex_identity_basis))
    initial = InitialGuess(rotation=np.eye(3), position=np.zeros(3), identity=identity)
    variables = Variables(model, data, initial)
    assert variables.has_parts and not _fitted()[0].has_parts
    variables.set_free(["parts"])
    with torch.no_grad():
        variables["parts"][:2].copy_(torch.tensor([0.5, -1.5]))
        variables["parts"][2:].copy_(torch.linspace(-1, 1, 12))  # placements of the arches
    mesh = variables.vertices(variables.skin_offsets())
    mesh.square().sum().backward()
    assert variables["parts"].grad is not None and variables["parts"].grad.abs().min() > 0
    parameters, offsets = variables.parameters()
    expected = torch.tensor(identity[-2:] + [0.5, -1.5], dtype=torch.float32)
    torch.testing.assert_close(parameters.identity[-2:], expected)
    assert offsets[torch.as_tensor(regions.teeth(data))].norm(dim=1).min() > 1e-4
    torch.testing.assert_close(model(parameters, offsets), mesh.detach(), rtol=0, atol=2e-6)
