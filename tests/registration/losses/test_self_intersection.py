from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bench.support.crossed_parts import part_depths_mm, teeth_of, translated_part, winding
from registration.errors import InputError
from registration.geometry.topology import vertex_areas, vertex_normals
from registration.losses.self_intersection import OF_THE_TONGUE, SelfIntersectionPenalty
from registration.model import regions
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model
from tests.registration.losses.crossings import (
    CROSSINGS,
    DEPTH_MM,
    Crossed,
    Crossing,
    push_until,
    pushed,
    template,
    tongue_moved,
)

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


class Heads:
    """A model, its penalty, and its heads with crossed parts, each made once."""

    def __init__(self, data: GNMData):
        self.data, self.penalty = data, SelfIntersectionPenalty(data, CPU)
        self._crossed: dict[str, Crossed] = {}

    def crossed(self, pair: str) -> Crossed:
        if pair not in self._crossed:
            self._crossed[pair] = push_until(self.data, CROSSINGS[pair], DEPTH_MM)
        return self._crossed[pair]

    def weight(self, pair: str) -> float:
        return float(self.penalty.weights[self.penalty.pairs.index(pair)])


@pytest.fixture(scope="module")
def heads(any_model: GNMData) -> Heads:
    return Heads(any_model)


@pytest.fixture(scope="module")
def gnm_penalty(gnm_model: GNMData) -> SelfIntersectionPenalty:
    return SelfIntersectionPenalty(gnm_model, CPU)


def posed(vertices: torch.Tensor, scale: float) -> torch.Tensor:
    rotation = torch.as_tensor(Rotation.from_rotvec([0.5, -0.8, 0.3]).as_matrix(), dtype=vertices.dtype)
    return scale * vertices @ rotation.T + torch.tensor([0.7, -0.3, 1.1], dtype=vertices.dtype)


@pytest.mark.parametrize("model", ["tiny", "first_model", pytest.param("gnm_model", marks=needs_shared)])
def test_a_template_costs_nothing_in_any_pose(model, request):
    data = tiny_model() if model == "tiny" else request.getfixturevalue(model)
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


@pytest.mark.parametrize("pair", PAIRS)
def test_gradients_of_every_pair(heads, pair):
    penalty, vertices = heads.penalty, heads.crossed(pair).vertices.double()
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


def assert_as_measured(pair: str, excess: torch.Tensor, crossed: Crossed, rest_mm: np.ndarray) -> None:
    """Nine in ten vertices that are too deep are so by what is measured; the others lie at openings of a part."""
    got, measured = excess.numpy(), np.maximum(crossed.depth_mm - rest_mm - MARGIN_MM, 0)
    deep = crossed.points & ((got > 0) | (measured > 0))
    facets = 0.07 if pair == "lids-eyeballs" else 0.0  # between the eyeball's mesh and its spheres
    assert deep.sum() > 3 and np.quantile(np.abs(got - measured)[deep], 0.9) < 0.01 + facets


@pytest.mark.parametrize("pair", PAIRS)
def test_depths_in_every_pair_are_those_measured(heads, pair):
    crossed = heads.crossed(pair)
    heads.penalty.update_candidates(crossed.vertices)
    excess, costs = heads.penalty.excess_mm(crossed.vertices), heads.penalty(crossed.vertices)
    assert_as_measured(pair, excess[pair], crossed, crossed.rest_mm)
    # A vertex in two teeth counts twice.
    assert 1 - 1e-5 < costs[pair] / excess[pair].square().sum() / heads.weight(pair) < 1.5
    assert pair in OF_THE_TONGUE or not any(cost for other, cost in costs.items() if other != pair)


def test_pairs_count_by_the_area_of_their_vertices(heads):
    """Else the lids' many small vertices roll the lids off the eyeballs."""
    areas = vertex_areas(heads.data.template_vertex_positions.astype(np.float64), heads.data.triangles)
    upper, lower = regions.lips(heads.data)
    members = {"lips-teeth": upper | lower, "tongue-gums": regions.tongue(heads.data)}
    members |= {
        "tongue-palate": regions.palate(heads.data),
        "lids-eyeballs": regions.offset_regions(heads.data)["lids"],
    }
    weights = np.array([heads.weight(pair) for pair in members])
    means = np.array([areas[vertices].mean() for vertices in members.values()])
    # The penalty's lids are all skin near an eyeball.
    np.testing.assert_allclose(weights[:3] / weights[0], means[:3] / means[0], rtol=1e-4)
    assert weights[3] < 0.5 * weights[0] and 0.5 < weights[3] / weights[0] / (means[3] / means[0]) < 2


@pytest.mark.parametrize("pair", ["lids-eyeballs", "lips-teeth", "tongue-teeth"])
def test_depths_in_the_template_are_subtracted(heads, pair):
    """A model whose template has the parts crossed already, by a part of the depth."""
    rest = push_until(heads.data, CROSSINGS[pair], 0.5 * DEPTH_MM)
    penalty = SelfIntersectionPenalty(replace(heads.data, template_vertex_positions=rest.vertices.numpy()), CPU)
    penalty.update_candidates(rest.vertices)
    assert penalty(rest.vertices)[pair] == 0
    crossed = heads.crossed(pair)
    penalty.update_candidates(crossed.vertices)
    assert_as_measured(pair, penalty.excess_mm(crossed.vertices)[pair], crossed, rest.depth_mm)


def test_excess_depths_are_in_millimetres_of_the_scaled_head(heads):
    penalty, vertices = heads.penalty, heads.crossed("tongue-teeth").vertices
    penalty.update_candidates(vertices)
    excess, cost = penalty.excess_mm(vertices)["tongue-teeth"], penalty(vertices)["tongue-teeth"]
    assert excess.max() > 1
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
def test_skin_at_the_mouth_corners_is_not_inside_the_other_lip(gnm_model, gnm_penalty):
    """Pursed lips: behind the skin next to them, through the interior, lies the oral lining of the other lip."""
    vertices, random = template(gnm_model).numpy().astype(np.float64), np.random.default_rng(5)
    for basis, scale in ((gnm_model.expression_basis[200:350], 0.5), (gnm_model.expression_basis[350:382], 0.3)):
        vertices = vertices + np.einsum("e,evc->vc", random.normal(size=len(basis)) * scale, basis)
    basis = gnm_model.vertex_identity_basis
    head = torch.as_tensor(vertices + np.einsum("e,evc->vc", random.normal(size=len(basis)), basis)).float()
    gnm_penalty.update_candidates(head)
    excess = gnm_penalty.excess_mm(head)["upper-lower lip"]
    # By the closest surface alone, 16 vertices of the skin next to the mouth would be up to 7 mm too deep.
    assert 0 < excess.count_nonzero() < 10 and not outside(gnm_model, head, excess).any()


@needs_shared
def test_intersections_of_the_official_samples(gnm_model, gnm_penalty):
    """Every lip vertex that is too deep is indeed inside the head; a wide open mouth costs nothing."""
    samples = np.load(SHARED / "data" / "gnm" / "gnm_real_samples.npz")
    names = [*samples["identity_names"].tolist(), *samples["expression_names"].tolist()]
    deepest = {}
    for name, delta in zip(names, [*samples["identity_deltas"], *samples["expression_deltas"]], strict=True):
        vertices = template(gnm_model) + torch.as_tensor(delta)
        gnm_penalty.update_candidates(vertices)
        excess_by_pair = gnm_penalty.excess_mm(vertices)
        deepest[name] = {pair: float(excess.max()) for pair, excess in excess_by_pair.items()}
        assert not outside(gnm_model, vertices, excess_by_pair["upper-lower lip"]).any(), name
    assert 0 < deepest["surprise"].pop("tongue-gums") < 0.1 and not any(deepest["surprise"].values())
    assert 0.4 < deepest["identity_a"]["upper-lower lip"] < 0.8  # lip regions without the oral lining would give 1.7
    assert 0.8 < deepest["pucker"]["upper-lower lip"] < 1.4 and 2.5 < deepest["pucker"]["tongue-palate"] < 3.5
    assert max(depths["lips-teeth"] + depths["ears-head"] for depths in deepest.values()) == 0


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-0.7, 0.3, 0.7)])
def test_a_tongue_pushed_into_the_teeth(heads, direction):
    data, penalty, tongue, teeth = heads.data, heads.penalty, regions.tongue(heads.data), teeth_of(heads.data)
    assert len(teeth) in (28, 32)

    def depths_mm(data: GNMData, vertices: torch.Tensor) -> np.ndarray:
        points, depth = vertices.numpy().astype(np.float64), np.zeros(len(vertices))
        depth[tongue] = part_depths_mm(points[tongue], points, teeth)
        return depth

    crossing = Crossing(tongue_moved(*direction), depths_mm, regions.tongue)
    deepest = []
    for push in np.linspace(0, push_until(data, crossing, 2.5).push_mm, 6).tolist():
        vertices = pushed(data, crossing, push)
        penalty.update_candidates(vertices)
        excess, truth = penalty.excess_mm(vertices)["tongue-teeth"].numpy()[tongue], depths_mm(data, vertices)
        np.testing.assert_allclose(excess, np.maximum(truth[tongue] - MARGIN_MM, 0), atol=0.01)
        deepest.append(truth.max())
    assert deepest[0] == 0 and deepest[-1] > 2 and np.all(np.diff(deepest) >= 0)
