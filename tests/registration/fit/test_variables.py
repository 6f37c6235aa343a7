"""The mesh that a fit optimises is the mesh that the saved parameters give."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from registration.fit.variables import Start, Unknowns, skin_topology, start_of
from registration.geometry.large_steps import LargeSteps
from registration.model.gnm import GNM
from registration.model.regions import exterior
from tests.fixtures.make_fixtures import tiny_model

RNG = np.random.default_rng(5)


def _fitted(plain: bool = False) -> tuple[Unknowns, GNM]:
    """Unknowns away from rest; unless `plain`, of a model with pose correctives, and with offsets everywhere."""
    data = tiny_model()
    correctives = RNG.normal(0, 0 if plain else 1e-3, data.pose_correctives_regressor.shape)
    data = replace(data, pose_correctives_regressor=correctives.astype(data.pose_correctives_regressor.dtype))
    model = GNM(data)
    start = Start(
        rotation=Rotation.from_euler("xyz", (2.9, 0.4, -1.2)).as_matrix(),
        position=np.array([0.3, -1.1, 2.0]),
        scale=1.07,
        identity=RNG.normal(size=len(data.vertex_identity_basis)),
        expression=RNG.normal(size=len(data.expression_basis)),
        joints=RNG.normal(0, 0.2, (3, 3)),
        offsets=RNG.normal(0, 1e-3, data.template_vertex_positions.shape) if not plain else None,
    )
    unknowns = Unknowns(model, data, start)
    unknowns["root"].copy_(torch.tensor([0.02, -0.05, 0.03]))
    unknowns["eyes"].copy_(torch.tensor(RNG.normal(0, 1e-3, (2, 4))))
    return unknowns, model


def test_saved_parameters_give_the_same_mesh() -> None:
    unknowns, model = _fitted()
    parameters, offsets = unknowns.parameters()
    mesh = unknowns.vertices(unknowns.skin_offsets())
    torch.testing.assert_close(model(parameters, offsets), mesh, rtol=0, atol=2e-6)


def test_a_fit_begins_where_a_registration_ended() -> None:
    unknowns, model = _fitted()
    parameters, offsets = unknowns.parameters()
    again = Unknowns(model, tiny_model(), start_of(parameters, offsets.numpy(), model, tiny_model()))
    before, after = (u.vertices(u.skin_offsets()) for u in (unknowns, again))
    torch.testing.assert_close(after, before, rtol=0, atol=2e-6)


def test_freeing_offsets_keeps_the_mesh_and_gradients_reach_exactly_the_free() -> None:
    unknowns, model = _fitted()
    before = unknowns.vertices(unknowns.skin_offsets())
    triangles, _ = skin_topology(tiny_model().triangles, unknowns.skin, len(before))
    steps = LargeSteps(triangles, len(unknowns.skin), edge_length_m=5e-3, smoothing_m=2e-2, device=torch.device("cpu"))
    unknowns.free(["offsets", "eyes"], steps)
    mesh = unknowns.vertices(unknowns.skin_offsets())
    torch.testing.assert_close(mesh.detach(), before, rtol=0, atol=2e-6)
    mesh.square().sum().backward()
    got = {name for name, tensor in unknowns.tensors.items() if tensor.grad is not None}
    assert got == {"offsets", "eyes"}
    unknowns.settle()
    torch.testing.assert_close(unknowns.vertices(unknowns.skin_offsets()).detach(), before, rtol=0, atol=2e-6)


def test_eyeballs_keep_their_shape() -> None:
    unknowns, _ = _fitted(plain=True)
    with torch.no_grad():
        unknowns["eyes"].zero_()
        rest = unknowns.vertices(unknowns.skin_offsets())
        unknowns["eyes"].copy_(torch.tensor([[1e-3, 0, 2e-3, 0.05], [0, 0, 0, 0]]))
        moved = unknowns.vertices(unknowns.skin_offsets())
    left, right = unknowns._eyes
    assert torch.equal(rest[right], moved[right])
    sizes = [torch.pdist(mesh[left][::7]) for mesh in (rest, moved)]
    torch.testing.assert_close(sizes[1], sizes[0] * float(np.exp(0.05)), rtol=1e-3, atol=1e-6)


def test_where_parts_touch_offsets_and_tongue_yield_and_nothing_else() -> None:
    unknowns, _ = _fitted()
    data = tiny_model()
    unknowns.free(list(set(unknowns.tensors) - {"offsets"}), None)
    unknowns["offsets"].requires_grad_(True)
    mesh, same = (draw(unknowns.skin_offsets()) for draw in (unknowns.vertices, unknowns.yielding))
    torch.testing.assert_close(same, mesh, rtol=0, atol=0)
    same.square().sum().backward()
    got = {name for name, tensor in unknowns.tensors.items() if tensor.grad is not None and tensor.grad.any()}
    assert got == {"offsets", "expression"}
    moves_skin = np.abs(data.expression_basis[:, exterior(data)]).max((1, 2)) > 0
    assert moves_skin.any() and not moves_skin.all()
    assert not unknowns["expression"].grad[torch.as_tensor(moves_skin)].any()
