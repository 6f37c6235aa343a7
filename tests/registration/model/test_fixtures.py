"""The committed fixtures equal the output of their script, and the tiny head can be rendered and registered."""

import numpy as np
import pytest

from registration.model import gnm_npz
from registration.model.regions import components
from tests.fixtures.make_fixtures import EYE_CENTRES, EYE_RADIUS, HERE, landmark_rows, tiny_model

DATA = tiny_model()
VERTICES = DATA.template_vertex_positions.astype(np.float64)


def test_file_and_script_agree():
    stored = gnm_npz.read(HERE / "tiny_gnm.npz")
    for name in gnm_npz.AXES:
        computed, saved = getattr(DATA, name), getattr(stored, name)
        assert computed.dtype == saved.dtype
        if computed.dtype.kind == "f":  # the last bit may differ between machines
            np.testing.assert_allclose(computed, saved, rtol=2e-3 if computed.dtype == np.float16 else 1e-5, atol=1e-7)
        else:
            np.testing.assert_array_equal(computed, saved)
    assert gnm_npz.topology_hash(stored.triangles) == gnm_npz.topology_hash(DATA.triangles)
    rows = (HERE / "head_sparse_68.txt").read_text().splitlines()
    computed = np.array([row.split() for row in landmark_rows(DATA)], float)
    np.testing.assert_allclose(computed, np.array([row.split() for row in rows], float), atol=2e-4)
    assert (HERE / "tiny_gnm.npz").stat().st_size < 300_000


def test_parts_are_closed_or_open_as_specified_and_face_outwards():
    part = components(DATA)
    for k, name in enumerate(DATA.mesh_component_names.tolist()):
        triangles = DATA.triangles[part[DATA.triangles[:, 0]] == k]
        edges = np.stack([triangles, np.roll(triangles, -1, 1)], -1).reshape(-1, 2)
        directed = {tuple(e) for e in edges.tolist()}
        assert len(directed) == len(edges)
        assert sum((b, a) not in directed for a, b in directed) == (48 if name == "skin" else 0)
        a, b, c = (VERTICES[triangles[:, i]] - VERTICES[part == k].mean(0) for i in range(3))
        assert np.einsum("fc,fc->", a, np.cross(b, c)) > 0


def test_the_eyes_do_not_touch_the_skin():
    corners = VERTICES[DATA.triangles[components(DATA)[DATA.triangles[:, 0]] == 0]]
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 300)
    samples = np.concatenate([np.einsum("kb,fbc->fkc", weights, corners).reshape(-1, 3), corners.reshape(-1, 3)])
    for centre in EYE_CENTRES:
        assert np.linalg.norm(samples - centre, axis=1).min() > EYE_RADIUS


def test_the_mirror_is_exact():
    mirror = DATA.mirror_indices
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    np.testing.assert_allclose(VERTICES[mirror] * (-1, 1, 1), VERTICES, atol=1e-6)


def test_modes_are_smooth_and_independent():
    for basis in (DATA.vertex_identity_basis, DATA.expression_basis):
        flat = basis.reshape(len(basis), -1).astype(np.float64)
        norms = np.linalg.norm(flat, axis=1)
        assert (np.linalg.norm(basis.astype(np.float64), axis=2).max(1) < 0.01).all() and norms.min() > 1e-3
        assert np.linalg.svd(flat / norms[:, None], compute_uv=False).min() > 0.05


def test_joints_follow_from_the_regressor():
    np.testing.assert_allclose(DATA.joint_regressor @ VERTICES, DATA.template_joint_positions, atol=1e-6)
    np.testing.assert_allclose(DATA.skinning_weights.sum(0), 1, atol=1e-6)


def test_uvs_have_one_seam_down_the_back():
    corner_uvs = {}
    for triangle, uvs in zip(DATA.triangles, DATA.triangle_uvs, strict=True):
        for vertex, uv in zip(triangle.tolist(), uvs.tolist(), strict=True):
            corner_uvs.setdefault(vertex, set()).add(tuple(np.round(uv, 5)))
    split = [v for v in range(889) if len(corner_uvs[v]) > 1]
    seam = VERTICES[split]
    assert len(split) >= 14 and np.abs(seam[:, 0]).max() < 1e-6
    crown = int(VERTICES[:889, 1].argmax())
    assert all(VERTICES[v, 2] < 0.03 or v == crown for v in split)


@pytest.mark.parametrize("name", ["quads", "quad_uvs"])
def test_triangles_are_halves_of_the_quads(name):
    quads = getattr(DATA, name)
    halves = quads[:, [[0, 1, 2], [2, 3, 0]]].reshape(-1, *quads.shape[2:])
    expected = DATA.triangles if name == "quads" else DATA.triangle_uvs
    np.testing.assert_array_equal(halves.reshape(expected.shape), expected)
