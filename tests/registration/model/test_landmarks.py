from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from registration.errors import InputError
from registration.model import jaw_order, landmarks
from registration.model.gnm_npz import topology_hash
from registration.storage.hashing import hash_fields
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import HERE, tiny_model

TINY = HERE / "head_sparse_68.txt"


def test_points_are_weighted_means(tmp_path):
    path = tmp_path / "head_sparse_two.txt"
    path.write_text("0 0.25 1 0.75 2 0\n\n3 1 3 0 3 0\n")
    scheme = landmarks.read_scheme(path, np.zeros((4, 3)))
    vertices = np.random.default_rng(0).normal(size=(2, 4, 3))
    expected = np.stack([0.25 * vertices[:, 0] + 0.75 * vertices[:, 1], vertices[:, 3]], 1)
    assert scheme.name == "two"
    np.testing.assert_allclose(scheme.points(vertices), expected)
    tensor = torch.from_numpy(vertices).requires_grad_(True)
    points = scheme.points(tensor)
    np.testing.assert_allclose(points.detach().numpy(), expected)
    points[0, 0, 2].backward()
    np.testing.assert_allclose(tensor.grad[0, :, 2].numpy(), [0.25, 0.75, 0, 0])
    assert scheme.points(vertices.astype(np.float32)).dtype == np.float32


def test_rounded_weights_are_normalized_to_sum_to_one(tmp_path):
    path = tmp_path / "head_sparse_a.txt"
    path.write_text("0 0.333 1 0.333 2 0.333\n")
    np.testing.assert_allclose(landmarks.read_scheme(path, np.zeros((3, 3))).weights.sum(1), 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("0 1 1 0\n", "row 0"),
        ("0 0.5 1 0.5 2 0\n0 nan 1 0.5 2 0\n", "row 1"),
        ("0 0.5 1 0.5 9 0\n", "wrong vertex index"),
        ("-1 0.5 1 0.5 2 0\n", "wrong vertex index"),
        ("0.5 0.5 1 0.5 2 0\n", "wrong vertex index"),
        ("0 0.5 1 0.7 2 0\n", "wrong weights"),
        ("zero 1 1 0 2 0\n", "cannot be read"),
        ("\xe9", "cannot be read"),
        ("0 1 1 0 2 0 0.001\n0 1 1 0 2 0\n", "spreads in some rows only"),
        ("0 1 1 0 2 0 0\n", "wrong spread"),
        ("0 1 1 0 2 0 5\n", "wrong spread"),
        ("0 1 1 0 2 0 0.1 1\n", "row 0"),
        ("# a comment\n", "is empty"),
        ("# kind: landmark map\n# version: 2\n0 1 1 0 2 0\n", "version that this project does not know"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    path = tmp_path / "head_sparse_x.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        landmarks.read_scheme(path, np.zeros((9, 3)))
    assert message in str(caught.value) and str(path) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        landmarks.read_scheme(tmp_path / "head_sparse_x.txt", np.zeros((9, 3)))


def test_schemes_in_the_folder_of_a_model(tmp_path):
    assert landmarks.schemes_beside(tmp_path / "model.npz", np.zeros((10, 3))) == {}
    for name in ("5", "68"):
        (tmp_path / f"head_sparse_{name}.txt").write_text("0 1 1 0 2 0\n")
    assert list(landmarks.schemes_beside(tmp_path / "model.npz", np.zeros((10, 3)))) == ["5", "68"]
    assert landmarks.read_scheme(tmp_path / "head_sparse_5.txt", np.zeros((10, 3)), name="mine").name == "mine"


def test_spread_and_header_survive_a_round_trip(tmp_path):
    data = tiny_model()
    scheme = landmarks.LandmarkScheme(
        name="two",
        indices=np.array([[0, 1, 2], [3, 4, 5]]),
        weights=np.array([[0.2, 0.3, 0.5], [1.0, 0, 0]]),
        spread_m=np.array([2e-3, 0.0105]),
        header={"kind": landmarks.KIND, "version": "1", "provider": "detector a1b2: the first"},
    )
    path = landmarks.write_scheme(scheme, tmp_path / "model.npz")
    read = landmarks.read_scheme(path, data.template_vertex_positions)
    np.testing.assert_array_equal(read.indices, scheme.indices)
    np.testing.assert_allclose(read.weights, scheme.weights)
    np.testing.assert_allclose(read.spread_m, scheme.spread_m)
    assert read.header == scheme.header and not read.shipped
    landmarks.check_topology(read, data, path)  # states none
    other = replace(scheme, header={"topology": "0" * 64})
    with pytest.raises(InputError, match="another topology"):
        landmarks.check_topology(other, data, path)


def test_shipped_maps_are_found_by_topology(tmp_path, monkeypatch):
    data = tiny_model()
    monkeypatch.setattr(landmarks, "SHIPPED", tmp_path)
    assert landmarks.shipped_schemes(data) == {}
    scheme = landmarks.LandmarkScheme(name="face478", indices=np.array([[0, 1, 2]]), weights=np.array([[1.0, 0, 0]]))
    landmarks.write_scheme_file(scheme, landmarks.shipped_file("face478", topology_hash(data.triangles)))
    found = landmarks.shipped_schemes(data)
    assert list(found) == ["face478"] and found["face478"].shipped
    assert landmarks.shipped_schemes(replace(data, triangles=data.triangles[:, ::-1])) == {}


def check_68(points: np.ndarray) -> None:
    """The order of the 68-point scheme: the subject's right first, and the expected anatomy."""
    x, y, z = points.T
    assert x[0] < 0 < x[16] and x[36] < x[39] < x[42] < x[45]
    assert y[8] < y[57] < y[33] < y[27] < y[24] and z[30] > z[27]
    assert 0.05 < np.linalg.norm(points[36] - points[45]) < 0.15


def test_tiny_head():
    data = tiny_model()
    points = landmarks.read_scheme(TINY, data.template_vertex_positions).points(data.template_vertex_positions)
    check_68(points)
    np.testing.assert_allclose(points[16::-1] * (-1, 1, 1), points[:17], atol=2e-3)


def reverse_rows(source: Path, target: Path) -> None:
    """Write a scheme of 68 points with rows 2 to 6 in the reverse order, as Google's first file has them."""
    rows = source.read_text().splitlines()
    target.write_text("\n".join([*rows[:2], *rows[6:1:-1], *rows[7:]]) + "\n")


def test_both_orders_of_the_right_jaw_are_read_as_one(tmp_path):
    data = tiny_model()
    corrected = landmarks.read_scheme(TINY, data.template_vertex_positions)
    assert not corrected.reversed_in_file
    reverse_rows(TINY, tmp_path / TINY.name)
    scheme = landmarks.schemes_beside(tmp_path / "model.npz", data.template_vertex_positions)["68"]
    assert scheme.reversed_in_file
    np.testing.assert_array_equal(scheme.indices, corrected.indices)
    np.testing.assert_array_equal(scheme.weights, corrected.weights)
    assert hash_fields(scheme) == hash_fields(corrected)
    (tmp_path / "new").mkdir()
    landmarks.write_scheme(scheme, tmp_path / "new" / "model.npz")  # in the corrected order
    assert not landmarks.read_scheme(tmp_path / "new" / TINY.name, data.template_vertex_positions).reversed_in_file
    assert not landmarks.read_scheme(tmp_path / TINY.name, data.template_vertex_positions, "other").reversed_in_file


@needs_shared
def test_the_full_head_is_read_in_the_corrected_order():
    folder = SHARED / "data" / "gnm"
    with np.load(folder / "gnm_head_reconstructed.npz") as archive:
        vertices = archive["template_vertex_positions"]
    scheme = landmarks.schemes_beside(folder / "gnm_head_reconstructed.npz", vertices)["68"]
    points = scheme.points(vertices)
    check_68(points)
    assert scheme.reversed_in_file
    assert (np.diff(points[:9, 1]) < 0).all() and (np.diff(points[9:16, 1]) > 0).all()
    assert np.linalg.norm(np.diff(points[:17], axis=0), axis=1).max() < 0.025
    raw = np.loadtxt(folder / "head_sparse_68.txt")
    np.testing.assert_array_equal(scheme.indices[jaw_order.TURNED], raw[:, ::2])
