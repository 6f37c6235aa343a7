from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from registration.errors import InputError
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model


@pytest.fixture(scope="module")
def tiny() -> gnm_npz.GNMData:
    return tiny_model()


@pytest.fixture(scope="module")
def full() -> gnm_npz.GNMData:
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


def without(data: gnm_npz.GNMData, name: str) -> gnm_npz.GNMData:
    keep = data.vertex_group_names != name
    return replace(data, vertex_groups=data.vertex_groups[keep], vertex_group_names=data.vertex_group_names[keep])


def test_class_weights_are_fractions_of_the_groups(tiny):
    names, weights = regions.vertex_classes(tiny)
    assert names == ("skin", "left_eye", "right_eye", "upper_lip", "lower_lip", "ears", "mouth_interior")
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    for name in ("left_eye", "right_eye", "upper_lip", "lower_lip", "ears"):
        np.testing.assert_array_equal(weights[:, names.index(name)], regions.group(tiny, name))
    inside = np.max([regions.group(tiny, name) for name in ("mouth_sock", "teeth", "gums", "tongue")], axis=0)
    np.testing.assert_array_equal(weights[:, -1], inside)
    assert (regions.group(tiny, "skin")[weights[:, 0] > 0] == 1).all()


def test_fractional_memberships_stay_fractional(tiny):
    groups = tiny.vertex_groups.copy()
    names = tiny.vertex_group_names.tolist()
    vertex = int(regions.group(tiny, "upper_lip").argmax())
    groups[:, vertex] = 0
    groups[names.index("skin"), vertex] = 1
    groups[names.index("upper_lip"), vertex] = 0.25
    np.testing.assert_allclose(
        regions.vertex_classes(replace(tiny, vertex_groups=groups))[1][vertex, [0, 3]], [0.75, 0.25]
    )
    groups[names.index("upper_lip"), vertex] = groups[names.index("lower_lip"), vertex] = 1
    weights = regions.vertex_classes(replace(tiny, vertex_groups=groups))[1][vertex]
    np.testing.assert_allclose(weights[[0, 3, 4]], [0, 0.5, 0.5])


@pytest.mark.parametrize(
    "name", ["left_eye", "right_eye", "upper_lip", "lower_lip", "ears", "mouth_sock", "teeth", "gums", "tongue"]
)
def test_a_missing_source_group_is_named(tiny, name):
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        regions.vertex_classes(without(tiny, name))


@pytest.mark.parametrize(
    ("role", "name"),
    [(regions.neck_other, "hockey_mask"), (regions.exterior, "skin_exterior"), (regions.components, "tongue")],
)
def test_a_missing_group_of_a_role_is_named(tiny, role, name):
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        role(without(tiny, name))


def test_neck_is_below_the_face(tiny):
    neck = regions.neck_other(tiny)
    height = tiny.template_vertex_positions[:, 1]
    assert height[neck].max() < height[regions.group(tiny, "hockey_mask") > 0].min()
    assert (regions.group(tiny, "skin")[neck] == 1).all() and neck[height < 0.13].all()


def test_components_are_the_connected_parts(tiny):
    part = regions.components(tiny)
    assert (part[tiny.triangles] == part[tiny.triangles[:, :1]]).all()
    assert np.bincount(part).tolist() == [889, 98, 98, 26, 26, 26]


def test_vertices_of_no_component_are_refused(tiny):
    groups = tiny.vertex_groups.copy()
    groups[:, 11] = 0
    with pytest.raises(InputError, match="no mesh component") as caught:
        regions.components(replace(tiny, vertex_groups=groups))
    assert caught.value.got == "1 vertices in none, first 11"


@needs_shared
def test_full_head(full):
    names, weights = regions.vertex_classes(full)
    assert dict(zip(names, weights.sum(0).tolist(), strict=True)) == {
        "skin": 10716,
        "left_eye": 771,
        "right_eye": 771,
        "upper_lip": 145,
        "lower_lip": 145,
        "ears": 1054,
        "mouth_interior": 4219,
    }
    part = regions.components(full)
    assert np.bincount(part).tolist() == [12466, 771, 771, 1440, 1440, 933]
    assert (part[full.triangles] == part[full.triangles[:, :1]]).all()
    upper, lower = (full.template_vertex_positions[part == k, 1].mean() for k in (3, 4))
    assert upper > lower
    exterior = regions.exterior(full)
    assert exterior.sum() == 11460 and not exterior[regions.group(full, "mouth_sock") > 0].any()
    assert exterior[weights[:, 3] + weights[:, 4] > 0].all() and (part[exterior] == 0).all()
    neck = regions.neck_other(full)
    x, y, z = full.template_vertex_positions.T
    assert neck[(part == 0) & (y < 0.15)].all() and not neck[y > 0.19].any() and 2000 < neck.sum() < 2500


def test_lids_inner_lips_and_cheeks_are_weights_on_the_exterior(tiny):
    for role in (regions.lids, regions.inner_lips, regions.blush):
        weight = role(tiny)
        assert weight.dtype == np.float32 and 0 <= weight.min() and weight.max() <= 1
        assert regions.exterior(tiny)[weight > 0].all()
    # This head has no oral lining behind its lips, and lids of four vertices.
    assert not regions.inner_lips(tiny).any() and np.count_nonzero(regions.lids(tiny)) == 4


@pytest.mark.parametrize(
    ("role", "name"),
    [(regions.lids, "left_eye"), (regions.inner_lips, "mouth_sock"), (regions.blush, "right_zygomatic_region")],
)
def test_masks_of_unreliable_texture_need_their_groups(tiny, role, name):
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        role(without(tiny, name))


@needs_shared
def test_lids_inner_lips_and_cheeks_of_the_full_head(full):
    points, lids, lips = full.template_vertex_positions, regions.lids(full), regions.inner_lips(full)
    balls = points[regions.group(full, "eyes") > 0]
    exterior = regions.exterior(full)
    face = np.flatnonzero(exterior & (regions.group(full, "hockey_mask") > 0))
    near = cdist(points[face], balls).min(1)
    np.testing.assert_allclose(lids[face], np.interp(near, [3e-3, 9e-3], [1, 0]), atol=1e-5)
    assert not lids[~exterior].any() and 1100 < np.count_nonzero(lids) < 1300
    vermilion = regions.group(full, "upper_lip") + regions.group(full, "lower_lip")
    assert (vermilion[lips > 0] > 0).all() and 50 < (lips == 1).sum() < np.count_nonzero(lips) < vermilion.sum()
    assert points[lips == 1, 2].mean() < points[(vermilion > 0) & (lips < 0.5), 2].mean()  # further inside
    blush = regions.blush(full)
    mirrored = blush[full.mirror_indices]
    np.testing.assert_array_equal(blush, mirrored)
    assert blush.sum() == 816 and not blush[regions.group(full, "ears") > 0].any()


def test_solids_partition_the_triangles(tiny):
    solids = regions.solids(tiny)
    assert list(solids) == ["skin", "left eye", "right eye", "teeth", "tongue"]
    part = dict(zip(tiny.mesh_component_names.tolist(), range(6), strict=True))
    components = regions.components(tiny)
    for role, names in {"skin": ["skin"], "teeth": ["upper_teeth_and_gums", "lower_teeth_and_gums"]}.items():
        assert set(components[solids[role]].ravel()) == {part[name] for name in names}
    assert sorted(map(tuple, np.concatenate(list(solids.values())))) == sorted(map(tuple, tiny.triangles))
    with pytest.raises(InputError, match="no vertex group 'lower_teeth_and_gums'"):
        regions.solids(without(tiny, "lower_teeth_and_gums"))


PARTS_THAT_TOUCH = (regions.ears, regions.teeth, regions.tongue, regions.palate, regions.mouth_lining)


def test_parts_that_touch_are_the_groups(tiny):
    left, right = regions.eyeball_shells(tiny)
    shells = regions.group(tiny, "eye_exteriors") > 0
    assert left.sum() == right.sum() == 57 and not (left & right).any() and ((left | right) == shells).all()
    assert tiny.template_vertex_positions[left, 0].min() > 0 > tiny.template_vertex_positions[right, 0].max()
    upper, lower = regions.lips(tiny)
    for lip, name in ((upper, "upper_lip"), (lower, "lower_lip")):
        named = regions.group(tiny, name) + regions.group(tiny, f"{name}_region") > 0
        np.testing.assert_array_equal(lip, named)
    names = ("ears", "teeth", "tongue", None, "mouth_sock")
    for role, name in zip(PARTS_THAT_TOUCH, names, strict=True):
        if name is not None:
            np.testing.assert_array_equal(role(tiny), regions.group(tiny, name) > 0)
    gums = regions.group(tiny, "gums") * regions.group(tiny, "upper_teeth_and_gums") > 0
    np.testing.assert_array_equal(regions.palate(tiny), gums)


@pytest.mark.parametrize(
    ("role", "name"),
    [
        (regions.eyeball_shells, "eye_exteriors"),
        (regions.lips, "lower_lip_region"),
        (regions.ears, "ears"),
        (regions.teeth, "teeth"),
        (regions.tongue, "tongue"),
        (regions.palate, "upper_teeth_and_gums"),
        (regions.mouth_lining, "mouth_sock"),
    ],
)
def test_parts_that_touch_need_their_groups(tiny, role, name):
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        role(without(tiny, name))


@needs_shared
def test_parts_that_touch_of_the_full_head(full):
    exterior, mirror = regions.exterior(full), full.mirror_indices
    left, right = regions.eyeball_shells(full)
    assert left.sum() == right.sum() == 386 and (left[mirror] == right).all()
    upper, lower = regions.lips(full)
    assert exterior[upper | lower].all() and (upper & lower).sum() == 24 and (upper[mirror] == upper).all()
    assert full.template_vertex_positions[upper, 1].mean() > full.template_vertex_positions[lower, 1].mean()
    assert [role(full).sum() for role in PARTS_THAT_TOUCH] == [1054, 1868, 933, 702, 406]
    assert not exterior[regions.mouth_lining(full)].any()


def test_stabilization_regions_are_exterior_and_mirrored(tiny):
    masks = regions.stabilization_regions(tiny)
    assert list(masks) == ["left_periocular", "right_periocular", "nose", "mouth", "neck_back"]
    assert set(regions.REFERENCE_REGIONS) < set(masks)
    exterior, mirror = regions.exterior(tiny), tiny.mirror_indices
    for mask in masks.values():
        assert mask.any() and exterior[mask].all()
    np.testing.assert_array_equal(masks["left_periocular"][mirror], masks["right_periocular"])
    assert not masks["neck_back"][regions.group(tiny, "hockey_mask") > 0].any()
    skull = regions.skull_skin(tiny)
    assert skull.any() and exterior[skull].all() and not skull[regions.neck_other(tiny)].any()
    assert not skull[regions.lips(tiny)[0] | (regions.group(tiny, "chin_region") > 0)].any()


@pytest.mark.parametrize(
    "name", ["expression_basis_left_eye", "nose_region", "chin_region", "left_cheek_region", "forehead_region", "ears"]
)
def test_stabilization_regions_need_their_groups(tiny, name):
    with pytest.raises(InputError, match=f"no vertex group '{name}'"):
        regions.stabilization_regions(without(tiny, name))


def test_the_heads_skin_has_no_neck_and_its_regions_are_mirrored(tiny):
    skin, mirror = regions.head_skin(tiny), tiny.mirror_indices
    assert skin.any() and regions.exterior(tiny)[skin].all() and not skin[regions.neck_other(tiny)].any()
    masks = regions.head_regions(tiny)
    assert {"face", "nose", "mouth", "ears", "forehead", "chin", "back"} < set(masks)
    for name, mask in masks.items():
        assert mask.any() and skin[mask].all()
        twin = {"left_periocular": "right_periocular", "right_periocular": "left_periocular"}.get(name, name)
        np.testing.assert_array_equal(mask[mirror], masks[twin])


@needs_shared
def test_expression_regions_are_components_with_their_mask(full, tiny):
    masks = regions.expression_regions(full)
    assert {name: len(members) for name, (members, _) in masks.items()} == {
        "left_eye": 100,
        "right_eye": 100,
        "lower_face": 150,
    }
    np.testing.assert_array_equal(masks["left_eye"][1][full.mirror_indices], masks["right_eye"][1])
    inside = masks["left_eye"][1] > 0
    energy = (full.expression_basis[masks["left_eye"][0]].astype(np.float32) ** 2).sum((0, 2))
    assert energy[inside].sum() > 0.9 * energy.sum()
    names = np.array(["pupils" if n.startswith("left_eye") else n for n in tiny.expression_names.tolist()])
    assert set(regions.expression_regions(replace(tiny, expression_names=names))) == {"right_eye", "lower_face"}
