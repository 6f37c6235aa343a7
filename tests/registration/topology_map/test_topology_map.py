"""What a map carries, its inverse, its file and its picture."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from registration.errors import InputError
from registration.topology_map import file, picture
from tests.registration.topology_map.small_map import pair, small_map


def test_linear_fields_are_carried_exactly():
    known, mapped = pair(), small_map()
    field = known.source.vertices @ np.array([[1.0, 2, 3], [0, 1, 0], [2, 0, 1]])
    points = mapped.carry(known.source.vertices)
    np.testing.assert_allclose(mapped.carry(field), points @ np.array([[1.0, 2, 3], [0, 1, 0], [2, 0, 1]]))
    basis = np.stack([field, -field]).astype(np.float32)
    assert mapped.carry(basis).shape == (2, len(points), 3) and mapped.carry(basis).dtype == np.float32
    np.testing.assert_allclose(mapped.carry(field.T).T, mapped.carry(field))


def test_masks_stay_masks():
    known, mapped = pair(), small_map()
    left = known.source.vertices[:, 0] > 0
    carried = mapped.carry(left)
    clear = np.abs(known.truth[:, 0]) > 0.01
    assert carried.dtype == bool
    np.testing.assert_array_equal(carried[clear & mapped.mask], (known.truth[:, 0] > 0)[clear & mapped.mask])


def test_axes_that_are_not_clear_are_errors():
    mapped = small_map()
    count = len(mapped.back.triangle)
    for values, axis in ((np.zeros((3, 4)), None), (np.zeros((count, count)), None), (np.zeros((count, 3)), 1)):
        with pytest.raises(ValueError, match="do not have one axis"):
            mapped.carry(values, axis)
    assert mapped.carry(np.zeros((count, count)), 1).shape == (count, len(mapped.mask))


def test_a_placed_mesh_lies_on_the_head():
    known, mapped = pair(), small_map()
    placed = mapped.place(known.source.vertices)
    distance = np.linalg.norm(placed - mapped.carry(known.source.vertices), axis=1)
    np.testing.assert_allclose(distance, mapped.points.distance_m, atol=1e-12)
    heads = known.source.vertices + np.arange(3)[:, None, None] * 0.01
    np.testing.assert_allclose(mapped.place(heads)[2], placed + 0.02)


def test_landmarks_are_carried():
    known, mapped = pair(), small_map()
    scheme = mapped.carry_landmarks(known.source.schemes["68"], known.source.vertices)
    truth = known.target.schemes["68"].points(known.target.vertices)
    error = np.linalg.norm(scheme.points(known.target.vertices) - truth, axis=1)
    assert np.median(error) < 1e-3
    np.testing.assert_allclose(scheme.weights.sum(1), 1)


def test_the_inverse_maps_back():
    known, mapped = pair(), small_map()
    inverse = mapped.inverse()
    assert (inverse.source_topology, inverse.target_topology) == (mapped.target_topology, mapped.source_topology)
    back = inverse.carry(mapped.carry(known.source.vertices))[inverse.mask]
    assert np.linalg.norm(back - known.source.vertices[inverse.mask], axis=1).mean() < 2e-3
    point = known.target.vertices[:5]
    there = mapped.scale * point @ mapped.rotation.T + mapped.translation
    np.testing.assert_allclose(inverse.scale * there @ inverse.rotation.T + inverse.translation, point)
    again = inverse.inverse()
    np.testing.assert_allclose(again.points.offset, mapped.points.offset, atol=1e-12)
    placed = inverse.place(known.target.vertices)
    aligned = (known.source.vertices - mapped.translation) @ mapped.rotation / mapped.scale
    assert np.linalg.norm(placed - aligned, axis=1)[inverse.mask].mean() < 0.01


def test_a_map_of_other_meshes_is_refused():
    known, mapped = pair(), small_map()
    mapped.check(known.source.triangles, known.target.triangles, "map.npz")
    mapped.check(known.source.triangles.astype(np.int32), known.target.triangles, "map.npz")
    with pytest.raises(InputError, match="of other meshes") as caught:
        mapped.check(known.target.triangles, known.source.triangles, "map.npz")
    assert "the other way round" in caught.value.got
    with pytest.raises(InputError, match="of other meshes") as caught:
        mapped.check(known.source.triangles[::-1], known.target.triangles, "map.npz")
    assert "the other way round" not in caught.value.got


def test_the_file_holds_the_map(tmp_path):
    mapped = replace(small_map(), status="refused", reasons=("2 faces are flipped", "other"))
    file.write(mapped, tmp_path / "map.npz")
    read = file.read(tmp_path / "map.npz")
    assert (read.status, read.reasons, read.figures) == (mapped.status, mapped.reasons, dict(mapped.figures))
    assert (read.source_topology, read.target_topology) == (mapped.source_topology, mapped.target_topology)
    for side, other in ((read.points, mapped.points), (read.back, mapped.back)):
        np.testing.assert_array_equal(side.triangle, other.triangle)
        np.testing.assert_array_equal(side.mask, other.mask)
        np.testing.assert_allclose(side.barycentric, other.barycentric, atol=1e-6)
        np.testing.assert_allclose(side.offset, other.offset, atol=1e-6)
    file.write(small_map(), tmp_path / "accepted.npz")
    assert file.read(tmp_path / "accepted.npz").reasons == ()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("kind", np.array("gnm-topology-map 99"), "another kind or version"),
        ("status", np.array("fine"), "unknown status"),
        ("scale", np.array(-1.0), "no similarity"),
        ("rotation", np.eye(3) * 2, "no similarity"),
        ("triangle", None, "missing"),
        ("back_triangle", "beyond", "wrong index"),
        ("source_triangles", "beyond", "wrong index"),
        ("barycentric", "beyond", "wrong values"),
        ("offset", "nan", "wrong value"),
        ("mask", "short", "wrong shape"),
    ],
)
def test_damaged_files_are_refused(field, value, message, tmp_path):
    file.write(small_map(), tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as archive:
        arrays = dict(archive)
    changes = {"beyond": lambda a: a + 10**6, "nan": lambda a: a * np.nan, "short": lambda a: a[:-1]}
    changed = changes[value](arrays[field]) if isinstance(value, str) else value
    arrays = {name: changed if name == field else array for name, array in arrays.items()}
    np.savez(tmp_path / "map.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=message):
        file.read(tmp_path / "map.npz")


def test_the_picture_shows_the_verdict(tmp_path):
    known = pair()
    mapped = replace(small_map(), status="refused", reasons=("2 faces are flipped", "another reason"))
    picture.draw(mapped, known.source, known.target, tmp_path / "refused.png")
    with Image.open(tmp_path / "refused.png") as image:
        assert len(image.getcolors(10**6)) > 100
