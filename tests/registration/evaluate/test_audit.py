import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from registration.errors import InputError
from registration.evaluate.audit import BEYOND_KEY, PartPair, PenetrationAudit, audit_penetration
from registration.geometry.topology import vertex_normals
from registration.geometry.winding import closed
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model
from tests.registration.geometry.sausage import RADIUS, end, sausage
from tests.registration.geometry.test_winding import by_ray

LIPS = {"upper lip in lower lip", "lower lip in upper lip"}


def pair(audit: PenetrationAudit, name: str) -> PartPair:
    return next(p for p in audit.pairs if p.name == name)


def flagged(audit: PenetrationAudit) -> set[str]:
    return {p.name for p in audit.pairs if len(p.beyond)}


def depths(audit: PenetrationAudit, name: str, count: int) -> np.ndarray:
    """Depth of every vertex, mm."""
    depth = np.zeros(count)
    depth[pair(audit, name).vertices] = pair(audit, name).depth_mm
    return depth


def distance_to_surface(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of each point to the nearest of all triangles (F, 3, 3): to its edges, or to its plane over it."""
    a = corners
    along = np.roll(a, -1, 1) - a
    normal = np.cross(along[:, 0], along[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distances = []
    for point in points:
        off = point - a
        t = np.clip((off * along).sum(2) / (along * along).sum(2), 0, 1)
        edges = np.linalg.norm(off - t[..., None] * along, axis=2).min(1)
        over = ((np.cross(along, off) * normal[:, None]).sum(2) > 0).all(1)
        distances.append(min(edges.min(), np.abs((off[:, 0] * normal).sum(1))[over].min(initial=np.inf)))
    return np.array(distances)


# --- balls, and a bent tube


def model_of_parts(parts: dict[str, tuple[np.ndarray, np.ndarray]], groups: dict[str, np.ndarray]) -> GNMData:
    """A model file with this geometry; the skin comes first, is all exterior, and has the groups given."""
    tiny, starts = tiny_model(), np.cumsum([0] + [len(v) for v, _ in parts.values()])
    count, names = starts[-1], tiny.vertex_group_names.tolist()
    table = np.zeros((len(names), count), np.float32)
    for (name, (vertices, _)), start in zip(parts.items(), starts, strict=False):
        table[names.index(name), start : start + len(vertices)] = 1
    for name, source in (("skin_exterior", "skin"), ("tongue", "tongue"), ("teeth", "lower_teeth_and_gums")):
        table[names.index(name)] = table[names.index(source)]
    for name, members in groups.items():
        table[names.index(name), : len(members)] = members
    faces = np.concatenate([f + start for (_, f), start in zip(parts.values(), starts, strict=False)])
    joints, weights = len(tiny.joint_names), np.zeros((len(tiny.joint_names), count), np.float32)
    weights[0] = 1
    return dataclasses.replace(
        tiny,
        template_vertex_positions=np.concatenate([v for v, _ in parts.values()]).astype(np.float32),
        triangles=faces,
        triangle_uvs=np.zeros((len(faces), 3, 2), np.float32),
        vertex_groups=table,
        vertex_identity_basis=np.zeros((len(tiny.identity_names), count, 3), np.float32),
        expression_basis=np.zeros((len(tiny.expression_names), count, 3), np.float32),
        skinning_weights=weights,
        joint_regressor=weights,
        pose_correctives_regressor=np.zeros((9 * joints, 3 * count), np.float32),
        mirror_indices=np.arange(count),
    )


def balls(skin: tuple[np.ndarray, np.ndarray] | None = None, **groups: np.ndarray) -> GNMData:
    """Balls of 10 mm in a row, 5 mm apart, as eyes, teeth and tongue; a ball in the left eye; a skin far away."""
    shape = trimesh.creation.icosphere(subdivisions=3, radius=0.010)

    def ball(x: float) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(shape.vertices) + [x, 0, 0], np.asarray(shape.faces)

    names = ("left_eye", "right_eye", "upper_teeth_and_gums", "lower_teeth_and_gums", "tongue")
    parts = {"skin": skin or ball(0.5)} | {n: ball(0.025 * k) for k, n in enumerate(names)}
    points, faces = parts["left_eye"]
    parts["left_eye"] = np.concatenate([points, 0.6 * points]), np.concatenate([faces, faces + len(points)])
    return model_of_parts(parts, groups)


@pytest.mark.parametrize("sunk_mm", [0.2, 1.0, 4.0])
def test_a_ball_sunk_in_a_ball_has_the_depth_of_the_lens(sunk_mm):
    data = balls()
    vertices = data.template_vertex_positions.astype(float)
    tongue, sunk = regions.tongue(data), sunk_mm * 1e-3
    vertices[tongue] -= [0.005 + sunk, 0, 0]
    audit = audit_penetration(vertices, data)
    depth = depths(audit, "tongue in teeth", len(vertices))
    expected = np.where(tongue, np.clip(10 - np.linalg.norm(vertices - [0.075, 0, 0], axis=1) * 1e3, 0, None), 0)
    np.testing.assert_allclose(depth, expected, atol=0.06)  # the facets' depth
    assert depth.max() == pytest.approx(sunk_mm, abs=0.06)
    assert flagged(audit) == ({"tongue in teeth"} if sunk_mm > 0.3 else set())
    clear = np.abs(expected - 0.3) > 0.06
    np.testing.assert_array_equal(np.isin(np.arange(len(depth)), audit.beyond)[clear], (expected > 0.3)[clear])


def test_in_an_eye_the_outermost_shell_counts():
    """The skin's ball is 8 mm in the eye's outer ball and 4 mm in its inner one."""
    data = balls()
    vertices = data.template_vertex_positions.astype(float)
    skin = regions.exterior(data)
    vertices[skin] += [-0.5 - 0.012, 0, 0]
    audit = audit_penetration(vertices, data)
    expected = np.where(skin, np.clip(10 - np.linalg.norm(vertices, axis=1) * 1e3, 0, None), 0)
    np.testing.assert_allclose(depths(audit, "lids in left eye", len(vertices)), expected, atol=0.06)
    assert flagged(audit) == {"lids in left eye"} and expected.max() == pytest.approx(8, abs=0.06)


def test_only_the_excess_over_the_depth_in_the_template_counts():
    """The template's tongue is 1 mm in the teeth already; sunk by another 0.25 mm it is still within the tolerance."""
    data = balls()
    template = data.template_vertex_positions.copy()
    template[regions.tongue(data)] -= np.float32([0.006, 0, 0])
    data = dataclasses.replace(data, template_vertex_positions=template)
    for more_mm, count in ((0.0, 0), (0.25, 0), (0.5, 1)):
        vertices = template.astype(float)
        vertices[regions.tongue(data)] -= [more_mm * 1e-3, 0, 0]
        row = audit_penetration(vertices, data).metrics["pairs"]["tongue in teeth"]
        assert row["template_max_mm"] == pytest.approx(1, abs=0.06) and row["template_vertices"] > 10
        assert row["max_excess_mm"] == pytest.approx(more_mm, abs=0.02) and min(row[BEYOND_KEY], 1) == count


def test_the_template_is_compared_at_the_size_of_the_mesh():
    data = balls()
    template = data.template_vertex_positions.copy()
    template[regions.tongue(data)] -= np.float32([0.009, 0, 0])
    data = dataclasses.replace(data, template_vertex_positions=template)
    larger = 1.1 * template.astype(float)
    assert flagged(audit_penetration(larger, data)) == {"tongue in teeth"}
    row = audit_penetration(larger, data, scale=1.1).metrics["pairs"]["tongue in teeth"]
    assert row["max_excess_mm"] < 1e-6 and row["template_max_mm"] == pytest.approx(4.4, abs=0.1)


def test_rotation_and_translation_change_nothing():
    data = balls()
    vertices = data.template_vertex_positions.astype(float)
    vertices[regions.tongue(data)] -= [0.007, 0, 0]
    rotation = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    original, transformed = (
        audit_penetration(v, data).metrics["pairs"]["tongue in teeth"]
        for v in (vertices, vertices @ rotation.T + [1, 2, 3])
    )
    assert original["max_excess_mm"] == pytest.approx(transformed["max_excess_mm"], abs=1e-6)
    assert original[BEYOND_KEY] == transformed[BEYOND_KEY]


@pytest.mark.parametrize("names", [{"ears": 1}, {"upper_lip": 1, "lower_lip": -1}])
def test_two_lobes_of_the_skin_in_one_another(names):
    """The ends of a bent tube, 12 mm inside one another: farther than the vertices are from their own surface."""
    open_, shut = np.pi - 0.8, np.pi - 0.1336
    rest, faces, share = sausage(open_)
    data = balls((rest, faces), **{name: share * side > 0.9 for name, side in names.items()})
    vertices = data.template_vertex_positions.astype(float)
    vertices[: len(rest)], _, _ = sausage(shut)
    sunk = 2 * RADIUS - np.linalg.norm(end(shut, 1) - end(shut, -1))
    assert sunk == pytest.approx(12e-3, abs=1e-4)
    expected = np.zeros(len(vertices))
    for side in (-1, 1):
        onwards = side * np.array([-np.sin(side * shut), np.cos(side * shut), 0])
        offset = vertices[: len(rest)] - end(shut, side)
        inside = (share * side < -0.9) & (np.linalg.norm(offset, axis=1) < RADIUS) & (offset @ onwards > 0)
        expected[: len(rest)][inside] = (RADIUS - np.linalg.norm(offset[inside], axis=1)) * 1e3
    audit = audit_penetration(vertices, data)
    lips = sum(depths(audit, name, len(vertices)) for name in LIPS)
    rows = {"skin in itself": depths(audit, "skin in itself", len(vertices)), "lips": lips}
    rows["ears in skin"] = depths(audit, "ears in skin", len(vertices))
    depth = rows.pop("lips" if "upper_lip" in names else "ears in skin" if "ears" in names else "skin in itself")
    in_cap = expected > 0
    assert in_cap.sum() > 100
    np.testing.assert_allclose(depth[in_cap], expected[in_cap], atol=0.12)  # the facets' depth
    assert all((row[in_cap] == 0).all() for row in rows.values())
    assert depth.max() > 8


def test_a_mesh_that_is_not_the_models_is_rejected():
    data = balls()
    with pytest.raises(InputError, match="cannot be audited") as caught:
        audit_penetration(data.template_vertex_positions[1:], data)
    assert "0 not finite" in caught.value.got
    broken = data.template_vertex_positions.copy()
    broken[3] = np.nan
    with pytest.raises(InputError, match="cannot be audited") as caught:
        audit_penetration(broken, data)
    assert "1 not finite" in caught.value.got


# --- the real model


@pytest.fixture(scope="module")
def head() -> GNMData:
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


def around(data: GNMData, point: np.ndarray, radius: float) -> np.ndarray:
    """A smooth bump over the vertices, 1 at the point, 0 from the radius on."""
    distance = np.linalg.norm(data.template_vertex_positions - point, axis=1) / radius
    return np.clip(1 - distance**2, 0, 1)[:, None] ** 2


@needs_shared
def test_the_template_has_no_excess_and_the_expected_overlaps(head):
    audit = audit_penetration(head.template_vertex_positions, head)
    assert audit.metrics[BEYOND_KEY] == 0 and not flagged(audit)
    rows = audit.metrics["pairs"]
    assert all(row["max_excess_mm"] == 0 for row in rows.values())
    overlaps = {name: (row["template_vertices"], row["template_max_mm"]) for name, row in rows.items()}
    expected = {name: (0, 0.0) for name in rows} | {
        "lids in left eye": (55, 0.603),
        "lids in right eye": (70, 0.661),
        "tongue in gums": (49, 4.442),
        "upper lip in lower lip": (37, 0.856),
        "lower lip in upper lip": (47, 0.819),
    }
    for name, (count, deepest) in expected.items():
        assert abs(overlaps[name][0] - count) <= 1, name
        assert overlaps[name][1] == pytest.approx(deepest, abs=2e-3), name


@needs_shared
@pytest.mark.parametrize("pushed_mm", [0.0, *(pytest.param(mm, marks=pytest.mark.slow) for mm in (3.0, 4.0)), 5.0])
def test_a_tongue_pushed_forward_into_the_lower_teeth(head, pushed_mm):
    """Its front half; the root stays where it is, in the gums. The tip has 3 mm to go before it meets the teeth."""
    vertices = head.template_vertex_positions.astype(float)
    tongue = np.flatnonzero(regions.tongue(head))
    front = np.clip((vertices[tongue, 2] - 0.100) / 0.010, 0, 1) * (vertices[tongue, 1] > 0.2235)
    vertices[tongue] += front[:, None] * [0, -0.4e-3 * pushed_mm, 1e-3 * pushed_mm]
    audit = audit_penetration(vertices, head)
    jaw = head.triangles[regions.group(head, "lower_teeth_and_gums")[head.triangles].all(1)]
    inside = tongue[by_ray(vertices[tongue], *closed(vertices, jaw)) > 0]
    expected = np.zeros(len(vertices))
    expected[inside] = distance_to_surface(vertices[inside], vertices[jaw]) * 1e3
    depth = sum(depths(audit, f"tongue in {part}", len(vertices)) for part in ("teeth", "gums"))
    np.testing.assert_allclose(depth, expected, atol=1e-6)
    assert pair(audit, "tongue in teeth").depth_mm.max(initial=0) >= 0.6 * (pushed_mm - 3)
    assert flagged(audit) - {"tongue in gums"} == ({"tongue in teeth"} if pushed_mm > 3 else set())


@needs_shared
@pytest.mark.parametrize("pushed_mm", [*(pytest.param(mm, marks=pytest.mark.slow) for mm in (0.2, 1.0)), 2.0])
def test_a_lower_lip_pushed_up_into_the_upper_lip(head, pushed_mm):
    rest = head.template_vertex_positions.astype(float)
    lips = [regions.group(head, name) > 0.5 for name in ("upper_lip", "lower_lip")]
    center = rest[lips[1] & (np.abs(rest[:, 0]) < 0.004)].mean(0)
    lower_jaw = ~lips[0] & ((rest[:, 1] < center[1]) | lips[1])  # the lining over the upper lip stays too
    vertices = rest + around(head, center, 0.025) * lower_jaw[:, None] * [0, pushed_mm * 1e-3, 0]
    audit = audit_penetration(vertices, head)
    assert flagged(audit) == (LIPS if pushed_mm > 0.5 else set())
    for name, lip, other in zip(sorted(LIPS, reverse=True), lips, lips[::-1], strict=True):
        row, surface = pair(audit, name), vertices[head.triangles[other[head.triangles].all(1)]]
        now = row.depth_mm > 0
        assert lip[row.vertices].all()
        expected = distance_to_surface(vertices[row.vertices[now]], surface) * 1e3
        np.testing.assert_allclose(row.depth_mm[now], expected, atol=1e-6)
        assert row.excess_mm.max() == pytest.approx(pushed_mm, abs=0.3)


@needs_shared
def test_a_lid_moved_into_the_eye(head):
    """1 mm towards the eyeball's centre, from the lower lid's rim outwards."""
    rest = head.template_vertex_positions.astype(float)
    eye = head.triangles[regions.eyeball_shells(head)[0][head.triangles].all(1)]
    centre = rest[eye].mean((0, 1))
    exterior = regions.exterior(head)
    below = exterior & (np.abs(rest[:, 0] - centre[0]) < 0.004) & (rest[:, 1] < centre[1])
    rim = np.flatnonzero(below)[np.argsort(np.linalg.norm(rest[below] - centre, axis=1))[:6]]
    towards = centre - rest[rim].mean(0)
    push = 1e-3 * towards / np.linalg.norm(towards)
    vertices = rest + around(head, rest[rim].mean(0), 0.008) * exterior[:, None] * push
    audit = audit_penetration(vertices, head)
    assert flagged(audit) == {"lids in left eye"}
    depth = depths(audit, "lids in left eye", len(vertices))
    near = np.flatnonzero(exterior & (np.linalg.norm(vertices - centre, axis=1) < 0.018))
    inside = near[by_ray(vertices[near], vertices, eye) > 0]
    np.testing.assert_allclose(depth[inside], distance_to_surface(vertices[inside], vertices[eye]) * 1e3, atol=1e-6)
    assert np.count_nonzero(depth) == len(inside)
    assert pair(audit, "lids in left eye").excess_mm.max() == pytest.approx(1, abs=0.1)


@needs_shared
def test_an_ear_pushed_into_the_head(head):
    """Its hind rim, inwards and backwards, until it is 3 mm deep in the scalp behind it."""
    rest = head.template_vertex_positions.astype(float)
    ear = regions.ears(head) & (rest[:, 0] > 0)
    hind = rest[ear][rest[ear][:, 2].argmin()]
    outer_half = np.clip((rest[:, 0] - 0.076) / 0.006, 0, 1) * ear
    pushed = around(head, hind, 0.020) * outer_half[:, None]
    vertices = rest + pushed * [-0.0192, 0, -0.0192]
    audit = audit_penetration(vertices, head)
    assert flagged(audit) == {"ears in skin"}
    row, skin = pair(audit, "ears in skin"), regions.solids(head)["skin"]
    scalp = skin[~regions.ears(head)[skin].any(1)]
    of_ear = ear[row.vertices]
    expected = distance_to_surface(vertices[row.vertices[of_ear]], vertices[scalp]) * 1e3
    np.testing.assert_allclose(row.depth_mm[of_ear], expected, atol=1e-6)
    assert row.depth_mm.max() == pytest.approx(3, abs=0.1) and of_ear.sum() > 8
    near = ear & (pushed[:, 0] > 0)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(head.triangles.astype(int))).numpy()
    rays = by_ray((vertices + 1e-5 * normals)[near], *closed(vertices, skin))
    np.testing.assert_array_equal(np.flatnonzero(near)[rays > 0], row.vertices[of_ear & near[row.vertices]])


@needs_shared
def test_an_upper_lid_pushed_through_the_lower_lid(head):
    """Without the eyeball, only the skin intersects itself, in either eyelid."""
    rest = head.template_vertex_positions.astype(float)
    exterior, centre = regions.exterior(head), rest[regions.eyeball_shells(head)[0]].mean(0)
    shut = np.clip(1 - ((rest[:, 0] - centre[0]) / 0.009) ** 2, 0, 1) * np.clip((rest[:, 1] - 0.3005) / 0.002, 0, 1)
    shut *= np.clip((0.312 - rest[:, 1]) / 0.003, 0, 1) * (np.abs(rest[:, 2] - 0.115) < 0.006) * exterior
    vertices = rest + shut[:, None] * [0, -0.0105, 0]
    vertices[regions.group(head, "left_eye") > 0] -= [0, 0, 0.05]
    audit = audit_penetration(vertices, head)
    assert flagged(audit) == {"skin in itself"}
    row, lids = pair(audit, "skin in itself"), regions.solids(head)["skin"]
    lids = lids[exterior[lids].all(1)]
    above = rest[:, 1] > 0.3005
    assert above[row.vertices].sum() > 5 and (~above[row.vertices]).sum() > 2
    for here, other in ((above, ~above), (~above, above)):
        members = here[row.vertices]
        expected = distance_to_surface(vertices[row.vertices[members]], vertices[lids[other[lids].all(1)]]) * 1e3
        np.testing.assert_allclose(row.depth_mm[members], expected, atol=1e-6)


@needs_shared
def test_a_crease_is_no_deeper_than_its_vertices_are_from_those_outside(head):
    """The chin turned down by 15 degrees towards the throat: faces of the nape used to be taken for the crease."""
    rest = head.template_vertex_positions.astype(float)
    share = np.clip((rest[:, 2] - 0.068) / 0.016 + 0.5, 0, 1) * (rest[:, 1] < 0.225)
    angle = np.radians(15) * share**2 * (3 - 2 * share)
    vertices, (y, z) = rest.copy(), (rest[:, 1:] - [0.26, 0.03]).T
    vertices[:, 1] = 0.26 + np.cos(angle) * y - np.sin(angle) * z
    vertices[:, 2] = 0.03 + np.sin(angle) * y + np.cos(angle) * z
    row = pair(audit_penetration(vertices, head), "skin in itself")
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(head.triangles.astype(int))).numpy()
    near = np.flatnonzero(
        regions.exterior(head) & (np.linalg.norm(vertices - vertices[row.vertices[0]], axis=1) < 0.04)
    )
    skin = closed(vertices, regions.solids(head)["skin"])
    outside = near[by_ray((vertices + 1e-5 * normals)[near], *skin) <= 0]
    bound = np.linalg.norm(vertices[row.vertices][:, None] - vertices[outside], axis=2).min(1) * 1e3
    assert len(row.vertices) > 10 and not np.isin(row.vertices, outside).any()
    assert (row.depth_mm <= bound + 1e-6).all() and row.depth_mm.max() > 0.3
