import numpy as np
import pytest

from coregister.anatomy.dental_rig import ArchPose, RiggedArch, ToothPose
from coregister.anatomy.dental_samples import Spreads
from coregister.anatomy.teeth import TeethSettings, teeth_basis
from coregister.anatomy.tooth_overlap import ToothOverlap
from registration.anatomy.tooth_structure import find_teeth
from registration.errors import InputError
from registration.geometry.closest_point import closest_points
from registration.geometry.winding import Winding, closed


@pytest.fixture(scope="module")
def template(model):
    return model.template_vertex_positions.astype(np.float64)


@pytest.fixture(scope="module")
def lower(model, template):
    return RiggedArch(arch=find_teeth(model)[1], template=template)


@pytest.fixture(scope="module")
def basis(model):
    return teeth_basis(model, TeethSettings(samples=120, seed=3))


def _pose(rig, count=1, **changes):
    count_teeth = len(rig.teeth)
    values = {
        "width": np.ones(count),
        "length": np.ones(count),
        "shift": np.zeros((count, 3)),
        "gaps": np.zeros((count, count_teeth)),
        "teeth": [_tooth_pose(count) for _ in range(count_teeth)],
    }
    return ArchPose(**{**values, **changes})


def _tooth_pose(count=1, **changes):
    values = {
        "turn": np.zeros((count, 3)),
        "shift": np.zeros((count, 3)),
        "scale": np.ones((count, 3)),
        "wear": np.zeros(count),
        "kept": np.ones((count, 3)),
    }
    return ToothPose(**{**values, **changes})


def test_the_pose_of_the_template_is_the_template(lower, template):
    teeth, gum = lower.vertices(_pose(lower))
    for points, tooth in zip(teeth, lower.arch.teeth, strict=True):
        assert np.abs(points[0] - template[tooth.vertices]).max() < 1.5e-4  # the table of the curve has steps of 0.1 mm
    assert np.abs(gum[0] - template[lower.arch.gum]).max() < 1.5e-4


def test_a_moved_arch_carries_its_gum(lower):
    shift = np.array([[1e-3, -2e-3, 0.5e-3]])
    at_rest, moved = lower.vertices(_pose(lower)), lower.vertices(_pose(lower, shift=shift))
    expected = shift[0] @ lower.arch.curve.plane
    for before, after in zip((*at_rest[0], at_rest[1]), (*moved[0], moved[1]), strict=True):
        assert np.allclose(after - before, expected, atol=1e-6)


def test_neighbours_make_room_for_a_wider_tooth_and_stay_in_contact(lower):
    teeth = [_tooth_pose() for _ in lower.teeth]
    rig_of = {rig.tooth.fdi: k for k, rig in enumerate(lower.teeth)}
    teeth[rig_of[34]] = _tooth_pose(scale=np.array([[1.3, 1.0, 1.0]]))
    before, after = lower.vertices(_pose(lower))[0], lower.vertices(_pose(lower, teeth=teeth))[0]
    crowns = {fdi: lower.teeth[k].tooth.crown for fdi, k in rig_of.items()}
    moved = {fdi: np.linalg.norm((after[k] - before[k])[0, crowns[fdi]].mean(0)) for fdi, k in rig_of.items()}
    assert moved[33] < 1e-6 and moved[44] < 1e-6
    assert 1.5e-3 < moved[35] < 3e-3 and 1.5e-3 < moved[37] < 3e-3


def test_depth_of_teeth_in_one_another(model, template):
    arch = find_teeth(model)[1]
    overlap = ToothOverlap(list(arch.teeth), template)
    rest = [template[tooth.vertices][None] for tooth in arch.teeth]
    assert overlap.depth(rest).max() == 0
    k = next(k for k, tooth in enumerate(arch.teeth) if tooth.fdi == 36)
    towards = arch.teeth[k + 1].origin - arch.teeth[k].origin
    into = list(rest)
    into[k] = rest[k] + 1e-3 * towards / np.linalg.norm(towards)
    found = overlap.depth(into)[0]
    pair = overlap.pairs.index((k, k + 1))
    assert 0.6e-3 < found[pair] < 1.0e-3  # they are 0.2 mm apart
    assert np.delete(found, pair).max() == 0


def test_components_span_the_teeth_and_nothing_else(basis, model):
    arches = find_teeth(model)
    assert np.array_equal(basis.vertices, np.sort(np.concatenate([arch.vertices for arch in arches])))
    assert basis.names[0] == "teeth_000" and len(basis.names) == len(basis.components)
    assert basis.record["samples"] == 120 and basis.record["variance_kept"] >= 0.99
    flat = basis.components.reshape(len(basis.names), -1).astype(np.float64)
    product = flat @ flat.T
    assert np.abs(product - np.diag(np.diag(product))).max() < 1e-4 * product.max()
    assert (np.diff(np.diag(product)) <= 1e-6 * product.max()).all()


@pytest.mark.slow
def test_equal_seeds_make_equal_teeth(basis, model):
    again = teeth_basis(model, TeethSettings(samples=120, seed=3))
    assert np.array_equal(again.components, basis.components) and again.record == basis.record


def test_what_is_in_the_gum_stays_in_it(basis, model, template):
    vertices = template.copy()
    drawn = np.random.default_rng(0).standard_normal(len(basis.names))
    vertices[basis.vertices] = basis.template + np.tensordot(drawn, basis.components, 1)
    for arch in find_teeth(model):
        buried = np.concatenate([tooth.vertices[~tooth.crown] for tooth in arch.teeth])
        gum = Winding(*closed(vertices, arch.gum_triangles))
        assert (gum.numbers(vertices[buried]) > 0.5).all()
        line = np.concatenate([tooth.neck_line(vertices) for tooth in arch.teeth])
        assert closest_points(line, vertices, arch.gum_triangles)[0].mean() < 3e-4


@pytest.mark.slow
def test_spreads_that_make_teeth_collide_are_refused(model):
    with pytest.raises(InputError, match="run into each other"):
        teeth_basis(model, TeethSettings(samples=5000, spreads=Spreads(shift_mm=6.0, shared=0.0)))


def test_one_sample_is_refused(model):
    with pytest.raises(InputError, match="Too few"):
        teeth_basis(model, TeethSettings(samples=1))
