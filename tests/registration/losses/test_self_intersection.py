from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bench.support.crossed_parts import (
    displaced,
    pressed_lid,
    raised_lower_lip,
    teeth_of,
    tooth_depths_mm,
    translated_part,
    winding,
)
from registration.errors import InputError
from registration.geometry.topology import vertex_normals
from registration.losses.self_intersection import SelfIntersectionPenalty
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model

CPU = torch.device("cpu")
PAIRS = (
    "lids-eyeballs",
    "lips-teeth",
    "upper-lower lip",
    "tongue-teeth",
    "tongue-lips",
    "tongue-palate",
    "tongue-gums",
    "ears-head",
)
MARGIN_MM = 0.05


@pytest.fixture(scope="module")
def full() -> GNMData:
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


@pytest.fixture(scope="module")
def penalty(full) -> SelfIntersectionPenalty:
    return SelfIntersectionPenalty(full, CPU)


def template(data: GNMData) -> torch.Tensor:
    return torch.as_tensor(data.template_vertex_positions)


def posed(vertices: torch.Tensor, scale: float) -> torch.Tensor:
    rotation = torch.as_tensor(Rotation.from_rotvec([0.5, -0.8, 0.3]).as_matrix(), dtype=vertices.dtype)
    return scale * vertices @ rotation.T + torch.tensor([0.7, -0.3, 1.1], dtype=vertices.dtype)


def squeezed(data: GNMData) -> torch.Tensor:
    """Both ears pressed against the head."""
    inwards = np.zeros((len(data.template_vertex_positions), 3))
    inwards[:, 0] = -0.022 * np.sign(data.template_vertex_positions[:, 0])
    lateral = np.abs(data.template_vertex_positions[:, 0])
    return displaced(data, regions.ears(data) & (lateral > 0.083), inwards)


CROSSED: dict[str, Callable[[GNMData], torch.Tensor]] = {
    "lids-eyeballs": lambda data: pressed_lid(data, 1.0),
    "lips-teeth": lambda data: translated_part(data, regions.lips(data)[0], (0.0, 0.0, -6.0)),
    "upper-lower lip": lambda data: raised_lower_lip(data, 2.0),
    "tongue-teeth": lambda data: translated_part(data, regions.tongue(data), (4.0, 0.0, 0.0)),
    "tongue-lips": lambda data: translated_part(data, regions.tongue(data), (0.0, 2.0, 15.0)),
    "tongue-palate": lambda data: translated_part(data, regions.tongue(data), (0.0, 14.0, 0.0)),
    "tongue-gums": lambda data: translated_part(data, regions.tongue(data), (0.0, -4.0, 6.0)),
    "ears-head": squeezed,
}


@pytest.mark.parametrize("model", ["tiny", pytest.param("full", marks=needs_shared)])
def test_a_template_costs_nothing_in_any_pose(model, request):
    data = tiny_model() if model == "tiny" else request.getfixturevalue("full")
    penalty = SelfIntersectionPenalty(data, CPU)
    for vertices in (template(data), posed(template(data), 1.0), posed(template(data), 1.3)):
        vertices = vertices.clone().requires_grad_(True)
        penalty.update_candidates(vertices)
        costs = penalty(vertices)
        assert tuple(costs) == PAIRS and all(cost.shape == () and cost.item() == 0 for cost in costs.values())
        torch.stack(list(costs.values())).sum().backward()
        assert not vertices.grad.any()


@pytest.mark.parametrize("name", ["eye_exteriors", "upper_lip", "lower_lip_region", "ears", "teeth", "tongue", "gums"])
def test_a_missing_part_is_named(name):
    data = tiny_model()
    keep = data.vertex_group_names != name
    lacking = replace(data, vertex_groups=data.vertex_groups[keep], vertex_group_names=data.vertex_group_names[keep])
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        SelfIntersectionPenalty(lacking, CPU)


@pytest.mark.parametrize("name", ["teeth", "tongue", "ears", "gums", "lower_lip", "upper_lip"])
def test_a_part_without_vertices_has_no_contacts(name):
    data = tiny_model()
    groups = data.vertex_groups.copy()
    groups[[k for k, group in enumerate(data.vertex_group_names) if group in (name, f"{name}_region")]] = 0
    penalty = SelfIntersectionPenalty(replace(data, vertex_groups=groups), CPU)
    assert not any(penalty(template(data)).values())


def test_a_tooth_in_the_tongue_displaces_both():
    data = tiny_model()
    penalty = SelfIntersectionPenalty(data, CPU)
    vertices = translated_part(data, regions.tongue(data), (0.0, -8.0, 0.0)).requires_grad_(True)
    penalty.update_candidates(vertices)
    penalty(vertices)["tongue-teeth"].backward()
    up, tongue, teeth = vertices.grad[:, 1], regions.tongue(data), regions.teeth(data)
    assert up[tongue].sum() < 0 < up[teeth].sum() and not up[~(tongue | teeth)].any()  # the gradient looks uphill
    assert up.sum().abs() < 1e-4 * up[teeth].sum()


@needs_shared
@pytest.mark.parametrize("pair", PAIRS)
def test_gradients_of_every_pair(full, penalty, pair):
    vertices = CROSSED[pair](full).double()
    penalty.update_candidates(vertices)
    at = vertices.clone().requires_grad_(True)
    cost = penalty(at)[pair]
    cost.backward()
    assert cost.item() > 1
    generator = torch.Generator().manual_seed(0)
    along = 0.3 * torch.randn(at.shape, dtype=at.dtype, generator=generator) + at.grad / at.grad.abs().max()
    high, low = (penalty(vertices + sign * 1e-8 * along)[pair] for sign in (1, -1))
    assert float((at.grad * along).sum()) == pytest.approx(float(high - low) / 2e-8, rel=0.01)
    # A common translation changes nothing: the gradients of both sides cancel.
    assert at.grad.sum(0).abs().max() < 1e-6 * at.grad.abs().sum()


@needs_shared
def test_excess_depths_are_in_millimetres_of_the_scaled_head(full, penalty):
    vertices = CROSSED["tongue-teeth"](full)
    penalty.update_candidates(vertices)
    excess, cost = penalty.excess_mm(vertices)["tongue-teeth"], penalty(vertices)["tongue-teeth"]
    assert excess.max() > 1 and excess.square().sum() <= cost * (1 + 1e-5)
    for scale in (0.5, 1.2):
        elsewhere = posed(vertices, scale)
        penalty.update_candidates(elsewhere)
        torch.testing.assert_close(
            penalty.excess_mm(elsewhere)["tongue-teeth"], scale * excess, atol=1e-3, rtol=0, check_dtype=False
        )
        assert float(penalty(elsewhere)["tongue-teeth"]) == pytest.approx(scale**2 * float(cost), rel=2e-3)


def test_accepted_rest_depths_cost_nothing_in_their_pairs_alone():
    data = tiny_model()
    penalty = SelfIntersectionPenalty(data, CPU)
    crossed = translated_part(data, regions.tongue(data), (0.0, -8.0, 0.0))

    def cost(pair: str) -> float:
        penalty.update_candidates(crossed)
        return penalty(crossed)[pair].item()

    before = cost("tongue-teeth")
    penalty.set_rest_depths(posed(crossed, 1.2), ["lips-teeth"])
    assert cost("tongue-teeth") == before > 0
    penalty.set_rest_depths(posed(crossed, 1.2), ["tongue-teeth"])
    assert cost("tongue-teeth") < 1e-6 * before  # rounding by the rotation
    penalty.set_rest_depths(template(data))  # previously accepted depths are discarded
    assert cost("tongue-teeth") == before


def outside(data: GNMData, vertices: torch.Tensor, excess: torch.Tensor) -> np.ndarray:
    """Whether each vertex with an excess depth nevertheless lies outside the skin."""
    skin = data.triangles[(regions.components(data) == 0)[data.triangles].all(1)].astype(np.int64)
    deep = excess.nonzero()[:, 0]
    points = vertices[deep] + 5e-5 * vertex_normals(vertices, torch.as_tensor(skin))[deep]
    return winding(points.double().numpy(), vertices.double().numpy()[skin]) < 0.5


@needs_shared
def test_skin_at_the_mouth_corners_is_not_inside_the_other_lip(full, penalty):
    """Pursed lips: behind the skin next to them, through the interior, lies the oral lining of the other lip."""
    vertices, random = template(full).numpy().astype(np.float64), np.random.default_rng(5)
    for basis, scale in ((full.expression_basis[200:350], 0.5), (full.expression_basis[350:382], 0.3)):
        vertices = vertices + np.einsum("e,evc->vc", random.normal(size=len(basis)) * scale, basis)
    basis = full.vertex_identity_basis
    head = torch.as_tensor(vertices + np.einsum("e,evc->vc", random.normal(size=len(basis)), basis)).float()
    penalty.update_candidates(head)
    excess = penalty.excess_mm(head)["upper-lower lip"]
    # By the closest surface alone, 16 vertices of the skin next to the mouth would be up to 7 mm too deep.
    assert 0 < excess.count_nonzero() < 10 and not outside(full, head, excess).any()


@needs_shared
def test_intersections_of_the_official_samples(full, penalty):
    """Every lip vertex that is too deep is indeed inside the head; a wide open mouth costs nothing."""
    samples = np.load(SHARED / "data" / "gnm" / "gnm_real_samples.npz")
    names = [*samples["identity_names"].tolist(), *samples["expression_names"].tolist()]
    deepest = {}
    for name, delta in zip(names, [*samples["identity_deltas"], *samples["expression_deltas"]], strict=True):
        vertices = template(full) + torch.as_tensor(delta)
        penalty.update_candidates(vertices)
        excess_by_pair = penalty.excess_mm(vertices)
        deepest[name] = {pair: float(excess.max()) for pair, excess in excess_by_pair.items()}
        assert not outside(full, vertices, excess_by_pair["upper-lower lip"]).any(), name
    assert 0 < deepest["surprise"].pop("tongue-gums") < 0.1 and not any(deepest["surprise"].values())
    assert 0.4 < deepest["identity_a"]["upper-lower lip"] < 0.8  # lip regions without the oral lining would give 1.7
    assert 0.8 < deepest["pucker"]["upper-lower lip"] < 1.4 and 2.5 < deepest["pucker"]["tongue-palate"] < 3.5
    assert max(depths["lips-teeth"] + depths["ears-head"] for depths in deepest.values()) == 0


@needs_shared
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-0.7, 0.3, 0.7)])
def test_a_tongue_pushed_into_the_teeth(full, penalty, direction):
    tongue = regions.tongue(full)
    teeth = teeth_of(full)
    assert len(teeth) == 32
    deepest = []
    for push in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        vertices = translated_part(full, tongue, tuple(push * axis for axis in direction))
        penalty.update_candidates(vertices)
        excess = penalty.excess_mm(vertices)["tongue-teeth"].numpy()[tongue]
        points = vertices.numpy().astype(np.float64)
        truth = tooth_depths_mm(points[tongue], points, teeth)
        np.testing.assert_allclose(excess, np.maximum(truth - MARGIN_MM, 0), atol=0.01)
        deepest.append(truth.max())
    assert deepest[0] == 0 and deepest[-1] > 2 and np.all(np.diff(deepest) >= 0)
