from dataclasses import replace

import numpy as np
import pytest

from registration.anatomy.own_parts import (
    FIGURE,
    OwnParts,
    PartEstimate,
    found_alone,
    fuse,
    record,
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


def _estimate(coefficients, views, jaw=(0.0,) * 6):
    return PartEstimate(coefficients=coefficients, views=views, jaw=np.array(jaw))


def test_captures_count_by_what_they_saw(parts):
    count, size = len(parts.vertices), len(parts.basis)
    truth, nothing, wrong = np.linspace(-0.2, 0.2, size), np.zeros(count, np.int64), np.full(size, 9.0)
    everything = np.full(count, 100_000)

    def moved(coefficients):
        return np.tensordot(coefficients, parts.basis, 1)

    found = fuse(parts, [_estimate(wrong, nothing), _estimate(truth, everything), _estimate(wrong, nothing)])
    assert found.shape == (3, size) and np.abs(moved(found - truth)).max() < 1e-4
    assert not fuse(parts, [_estimate(wrong, nothing)]).any()
    twice = [_estimate(truth, 3 * everything), _estimate(-truth, everything)]
    still = slice(0, size - 6)
    assert np.allclose(fuse(parts, twice)[0, still], truth[still] / 2, atol=3e-3)


def test_the_neutral_is_at_rest_whatever_its_expression(parts):
    """Closed lips hide that its expression has moved the jaw, and so has that of every other capture."""
    jaw, size, hidden = np.array([-1.0, 0.0, 0.0, 0.1, 0.8, -0.8]), len(parts.basis), np.zeros(len(parts.vertices), int)
    closed = fuse(parts, [_estimate(np.zeros(size), hidden, jaw), _estimate(np.zeros(size), hidden, jaw)])
    assert np.allclose(closed[:, -6:], -jaw) and not closed[:, :-6].any()
    # An open mouth shows where its lower arch stands; the neutral's follows that as far as the motion is known.
    opened, seen = jaw + np.array([14.0, 0.0, 0.0, 0.0, -11.0, -7.0]), np.full(len(parts.vertices), 500)
    found = fuse(parts, [_estimate(np.zeros(size), hidden, jaw), _estimate(np.zeros(size), seen, opened)])
    assert np.abs(np.tensordot(found[1], parts.basis, 1)).max() < 1e-4
    left = np.linalg.norm(found[0, -6:])
    assert 0.1 * np.linalg.norm(jaw) < left < 0.9 * np.linalg.norm(jaw)


def test_motion_of_the_jaw_by_an_expression(data, parts):
    wanted = np.array([0.3, -1.0, 0.5, 2.0, -0.5, 0.1])
    basis = np.zeros_like(data.expression_basis)
    basis[1, parts.vertices] = np.tensordot(wanted, parts.placements[6:], 1)
    changed = replace(data, expression_basis=basis)
    found = parts.jaw_motion(changed, 2.0 * np.eye(len(basis))[1])
    assert np.allclose(found, 2 * wanted, atol=2e-3)


def test_arches_are_placed_rigidly(data, parts):
    upper, lower = (regions.group(data, f"{name}_teeth_and_gums") > 0.5 for name in ("upper", "lower"))
    template = data.template_vertex_positions.astype(np.float64)
    moved = np.zeros((len(parts.placements), *template.shape))
    moved[:, parts.vertices] = parts.placements
    assert len(parts.placements) == 12 and not moved[:, ~(upper | lower)].any()
    assert not moved[6:, upper].any() and (moved[6:, lower] != 0).any((1, 2)).all()
    for row in moved[:6] + moved[6:]:  # of the lower arch: distances change by the second order alone
        points = template[lower]
        pairs = np.linalg.norm(points[1:] - points[:-1], axis=1)
        placed = points + 1e-3 * row[lower]
        assert np.abs(np.linalg.norm(placed[1:] - placed[:-1], axis=1) - pairs).max() < 1e-9


def test_a_part_of_an_arch_places_all_of_it(data, parts):
    """A shift that no component has, seen at a third of the vertices, moves those too that no camera sees."""
    wanted = np.zeros(len(parts.basis))
    wanted[len(parts.components) + 4] = 1.0
    views = np.where(np.arange(len(parts.vertices)) % 3 == 0, 500, 0)
    found = fuse(parts, [_estimate(wanted, views)])[0]
    difference = np.tensordot(found - wanted, parts.basis, 1)
    assert np.abs(np.tensordot(wanted, parts.basis, 1)).max() > 1e-3 and np.abs(difference).max() < 2e-5


def test_models_whose_arches_no_component_moves_have_no_placements(data):
    skin = regions.skin(data)
    basis = data.vertex_identity_basis.copy()
    basis[-3:, ~(skin | regions.eyeballs(data)[0])] = 0
    parts = OwnParts.of(replace(data, vertex_identity_basis=basis))
    assert not len(parts.placements) and len(parts.basis) == len(parts.components) == 3
    eyes = np.array([0.5, -1.0, 2.0])
    found = parts.coefficients(_registration(data, [0.3] * 6 + eyes.tolist()))
    jaw = parts.jaw_motion(data, np.ones(len(data.expression_basis)))
    assert np.allclose(found, eyes) and not len(jaw)
    seen = np.full(len(parts.vertices), 100_000)
    assert np.allclose(fuse(parts, 2 * [_estimate(found, seen, jaw)]), eyes, atol=1e-2)


def test_only_the_own_parts_change(data, parts):
    before = _registration(data, [0.3] * 6 + [0.0, 0.0, 0.0])
    wanted = np.zeros(len(parts.basis))
    wanted[:3] = [1.0, -1.0, 2.0]
    after = with_parts(before, data, parts, wanted, {})
    expected = _registration(data, [0.3] * 6 + wanted[:3].tolist())
    assert np.abs(after.vertices - expected.vertices).max() < 1e-6
    others = np.setdiff1d(np.arange(len(after.vertices)), parts.vertices)
    assert np.array_equal(after.vertices[others], before.vertices[others])
    assert np.abs(after.vertices - before.vertices)[parts.vertices].max() > 1e-3
    for placed in ({"placed": [0.0] * 12}, {}):  # and from before there were any
        shared = replace(after, figures={FIGURE: {"alone": [0.0, 0.0, 0.0], **placed}})
        assert np.abs(found_alone(shared, data, parts, {}).vertices - before.vertices).max() < 1e-6


def test_offsets_hold_the_placements(data, parts):
    before = _registration(data, [0.3] * 6 + [0.5, 0.0, -0.5])
    eyes = regions.eyeballs(data)[0]
    before.offsets[eyes] = 3e-4  # of the capture: they stay
    before = with_parts(before, data, parts, parts.coefficients(before), {})
    wanted = np.concatenate([[1.0, -1.0, 2.0], np.linspace(-1, 1, 12)])
    after = with_parts(before, data, parts, wanted, {})
    assert np.allclose(parts.coefficients(after), wanted, atol=1e-4)
    assert np.array_equal(after.offsets[eyes], before.offsets[eyes])
    parameters = ("identity", "expression", "rotations", "translation", "offsets")
    posed = gnm_numpy.evaluate(
        data, scale=float(after.scale), **{name: getattr(after, name).astype(np.float64) for name in parameters}
    )
    assert np.abs(posed - after.vertices)[parts.vertices].max() < 1e-6
    placed = record(parts, parts.coefficients(after))["placed"]
    assert np.allclose(np.degrees(placed[0]), -1.0, atol=1e-3) and np.allclose(placed[4], -6e-3 / 11, atol=1e-6)
    shared = replace(after, figures={FIGURE: record(parts, parts.coefficients(before))})
    assert np.abs(found_alone(shared, data, parts, {}).vertices - before.vertices).max() < 1e-5
    again = replace(before, figures={FIGURE: record(parts, wanted)})
    assert np.abs(found_alone(again, data, parts, {}).vertices - after.vertices).max() < 1e-5


def test_views_that_see_a_point():
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 1.0]])
    intrinsics = np.array([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]])
    front, back = np.eye(4), np.diag([-1.0, 1, -1, 1])
    front[2, 3] = back[2, 3] = 5
    cameras = [Camera(width_px=100, height_px=100, intrinsics=intrinsics, T_cam_world=pose) for pose in (front, back)]
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    assert views_that_see(square, triangles, cameras, np.array([4, 0])).tolist() == [1, 2]
