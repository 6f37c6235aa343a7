"""Maps of a head to itself with other triangles, bent; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from registration.errors import InputError
from registration.geometry.nonrigid_icp import IcpSettings
from registration.model import regions
from registration.topology_map.landmarked import of_mesh
from registration.topology_map.make import MapSettings, map_topologies
from tests.registration.cranium.smooth_heads import tiny
from tests.registration.topology_map.small_map import QUICK, pair, small_map


def test_a_bent_and_remeshed_head_finds_its_points():
    known, mapped = pair(), small_map()
    assert mapped.accepted and mapped.reasons == ()
    found = np.einsum(
        "vk,vkc->vc", mapped.points.barycentric, known.source.vertices[known.source.triangles[mapped.points.triangle]]
    )
    error = np.linalg.norm(found - known.truth, axis=1)
    face = (regions.group(tiny(), "hockey_mask") > 0.5)[known.source.triangles[mapped.points.triangle]].all(1)
    assert np.linalg.norm(known.target.vertices - known.truth, axis=1).max() == pytest.approx(0.005)
    assert error[mapped.mask & face].mean() < 1e-3  # triangles are up to 2 cm large; the benchmark has a real model
    assert mapped.figures["mean_mm"] < 0.02 and mapped.figures["cycle_mean_mm"] < QUICK.cycle_mm
    assert mapped.figures["flipped_faces"] == 0 and mapped.figures["covered"] > 0.7


def test_the_targets_frame_and_unit_do_not_matter():
    known = pair()
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = replace(known.target, vertices=1000 * known.target.vertices @ turn.T + 70)
    mapped = map_topologies(known.source, turned, QUICK)
    assert mapped.scale == pytest.approx(1e-3, rel=0.05)
    np.testing.assert_allclose(mapped.points.barycentric, small_map().points.barycentric, atol=1e-3)


def test_the_mask_of_the_groups_travels_to_a_mesh_without_groups():
    known, mapped = pair(), small_map()
    left_out = ~known.source.members[known.source.triangles].all(1)
    assert not mapped.mask[left_out[mapped.points.triangle]].any()
    assert (left_out[mapped.points.triangle] & known.target.skin).any()


def test_a_bad_map_is_refused_with_reasons():
    known = pair()
    stiff = MapSettings(icp=IcpSettings(splines=(), ladder=QUICK.icp.ladder[:1], rounds=0), least_covered=1.0)
    mapped = map_topologies(known.source, known.target, stiff)
    assert not mapped.accepted
    assert any("mm from the surface" in reason for reason in mapped.reasons)
    assert any("outer surface has a counterpart" in reason for reason in mapped.reasons)


@pytest.mark.parametrize(
    ("change", "message", "got"),
    [
        (lambda s: replace(s, schemes={}), "too few landmarks", "none"),
        (lambda s: replace(s, members=np.zeros(len(s.vertices), bool)), "too few landmarks", "0 points"),
        (lambda s: replace(s, vertices=1000 * s.vertices), "not in metres", ""),
    ],
)
def test_landmarks_that_do_not_suffice_are_refused(change, message, got):
    known = pair()
    with pytest.raises(InputError, match=message) as caught:
        map_topologies(change(known.source), known.target, QUICK)
    assert got in caught.value.got


def test_a_scheme_of_another_length_is_refused():
    known = pair()
    scheme = known.target.schemes["68"]
    shorter = replace(scheme, indices=scheme.indices[:60], weights=scheme.weights[:60])
    with pytest.raises(InputError, match="too few landmarks") as caught:
        map_topologies(known.source, replace(known.target, schemes={"68": shorter}), QUICK)
    assert "68 and 60 points" in caught.value.got


@pytest.mark.parametrize(("width_m", "mapped"), [(0.016, False), (0.026, True)])
def test_nostrils_of_a_mesh_without_groups_are_left_out(width_m, mapped):
    """The walls of a hollow ball face each other; those of nostrils are up to 2 cm apart along their normals."""
    ball = trimesh.creation.icosphere(2, width_m / 2)
    hollow = of_mesh(1000 * np.array(ball.vertices), np.array(ball.faces)[:, ::-1], {}, "hollow", unit_m=1e-3)
    assert (hollow.members == mapped).all()
