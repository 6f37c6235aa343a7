"""Files of all formats, the faces and materials in them, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.errors import InputError
from registration.export.head_mesh import Topology
from registration.export.options import ExportOptions
from registration.export.registrations import head_of_registration
from registration.export.write import FORMATS, check_out, left_out, write
from registration.geometry.quads import corner_triangles, triangles_of
from registration.model.atlas import texture_atlas
from tests.registration.export.heads import DATA, SHIFT, TURN, a_registration

HEAD = head_of_registration(a_registration(), DATA, name="anna")


def read_obj(file: Path) -> tuple[np.ndarray, np.ndarray, dict[str, list[tuple[list[int], list[int]]]]]:
    """Vertices, uvs, and the faces of each material as indices of both."""
    vertices, uvs, faces, material = [], [], {}, ""
    for line in file.read_text().splitlines():
        kind, *words = line.split()
        if kind == "v":
            vertices.append([float(word) for word in words])
        elif kind == "vt":
            uvs.append([float(word) for word in words])
        elif kind == "usemtl":
            material = words[0]
        elif kind == "f":
            pairs = [[int(number) - 1 for number in word.split("/")] for word in words]
            faces.setdefault(material, []).append(tuple(map(list, zip(*pairs, strict=True))))
    return np.array(vertices), np.array(uvs), faces


def test_obj_keeps_quads_uvs_and_materials(tmp_path: Path) -> None:
    files = write(HEAD, tmp_path / "head.obj")
    assert [path.name for path in files] == ["head.obj", "head.png", "head.mtl"] and all(f.is_file() for f in files)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["head.mtl", "head.obj", "head.png"]
    vertices, uvs, faces = read_obj(tmp_path / "head.obj")
    np.testing.assert_allclose(vertices, HEAD.vertices, atol=1e-7)
    assert list(faces) == ["skin", "eyes", "teeth", "tongue"]
    for number, members in enumerate(faces.values()):
        chosen = HEAD.topology.face_material == number
        np.testing.assert_array_equal([vertex for vertex, _ in members], DATA.quads[chosen])
        np.testing.assert_allclose(uvs[[uv for _, uv in members]], HEAD.topology.face_uvs[chosen], atol=1e-6)
    text = (tmp_path / "head.mtl").read_text()
    assert "mtllib head.mtl" in (tmp_path / "head.obj").read_text() and text.count("map_Kd head.png") == 4
    image = trimesh.load(tmp_path / "head.obj", process=False)  # it finds material and texture by these names
    assert image is not None


def test_ply_keeps_quads(tmp_path: Path) -> None:
    write(HEAD, tmp_path / "head.ply")
    mesh = trimesh.load(tmp_path / "head.ply", process=False)  # it cuts quads
    np.testing.assert_allclose(mesh.vertices, HEAD.vertices, atol=1e-7)
    assert len(mesh.faces) == 2 * len(DATA.quads)
    assert b"element face %d\n" % len(DATA.quads) in (tmp_path / "head.ply").read_bytes()[:300]
    assert left_out(HEAD, tmp_path / "head.ply") == ["the texture and the uvs", "the materials of the parts"]


def test_quads_get_the_uvs_of_the_triangles_whatever_order_these_have() -> None:
    rng = np.random.default_rng(0)
    order = rng.permutation(len(DATA.triangles))
    turned = np.stack([np.roll(row, rng.integers(3)) for row in DATA.triangles[order]])
    shuffled = replace(DATA, triangles=turned)
    uvs = texture_atlas(DATA)
    turned_uvs = np.stack(
        [uvs[o][[list(DATA.triangles[o]).index(v) for v in row]] for o, row in zip(order, turned, strict=True)]
    )
    topology = Topology.from_model(shuffled, turned_uvs)
    np.testing.assert_array_equal(topology.face_uvs, HEAD.topology.face_uvs)
    np.testing.assert_array_equal(corner_triangles(HEAD.topology.face_uvs), uvs)  # this model's are in order
    np.testing.assert_array_equal(triangles_of(topology.faces), DATA.triangles)


def test_quads_of_another_surface_are_refused() -> None:
    with pytest.raises(InputError, match="another surface"):
        Topology.from_model(replace(DATA, quads=DATA.quads[:, [0, 2, 1, 3]]))
    with pytest.raises(InputError, match="another surface"):
        Topology.from_model(replace(DATA, quads=DATA.quads[1:], quad_uvs=DATA.quad_uvs[1:]))


def test_a_head_is_upright_or_as_captured() -> None:
    registration = a_registration()
    bind = TURN.inv().apply(registration.vertices - SHIFT)
    assert np.abs(HEAD.vertices - bind).max() < 5e-3  # but for what the skull's skin differs from the template
    world = head_of_registration(registration, DATA, name="anna", options=ExportOptions(frame="world"))
    np.testing.assert_allclose(world.vertices, registration.vertices)
    edges = [np.linalg.norm(mesh.vertices[1:] - mesh.vertices[:-1], axis=1) for mesh in (world, HEAD)]
    np.testing.assert_allclose(*edges, atol=1e-7)


def test_bad_files_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        check_out(tmp_path / "head.fbx", replace=True)
    assert all(suffix in error.value.expected for suffix in FORMATS) and error.value.got == ".fbx"
    (tmp_path / "head.obj").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        check_out(tmp_path / "head.obj", replace=True)
    (tmp_path / "other.png").write_bytes(b"a picture")
    with pytest.raises(InputError, match="exists"):
        check_out(tmp_path / "other.obj", replace=False)
    check_out(tmp_path / "other.obj", replace=True)
    check_out(tmp_path / "other.glb", replace=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["head.obj", "other.png"]


def test_a_format_without_shapes_refuses_them(tmp_path: Path) -> None:
    shaped = replace(HEAD, shapes={"smile": np.zeros_like(HEAD.vertices)})
    with pytest.raises(InputError, match="cannot hold expressions"):
        write(shaped, tmp_path / "head.obj")
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    shape = np.zeros_like(HEAD.vertices)
    shape[3, 1] = np.nan
    with pytest.raises(InputError, match="not finite") as error:
        write(replace(HEAD, shapes={"smile": shape}), tmp_path / "head.glb")
    assert "smile" in error.value.where and list(tmp_path.iterdir()) == []


def test_a_failed_registration_is_refused_unless_accepted() -> None:
    failed = a_registration(status="failed", reason="the mesh moved")
    with pytest.raises(InputError, match="failed") as error:
        head_of_registration(failed, DATA, name="anna")
    assert "--failed export" in error.value.fix and error.value.got == "the mesh moved"
    accept = ExportOptions(failed="export")
    assert head_of_registration(failed, DATA, name="anna", options=accept).origin["status"] == "failed"
    broken = failed.vertices.copy()
    broken[3] = np.nan
    with pytest.raises(InputError, match="failed"):
        head_of_registration(replace(failed, vertices=broken), DATA, name="anna", options=accept)


def test_another_topology_is_refused() -> None:
    with pytest.raises(InputError, match="another topology"):
        head_of_registration(a_registration(triangles=DATA.triangles[::-1].astype(np.int32)), DATA, name="anna")


def test_a_missing_package_is_named_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("registration.export.write.find_spec", lambda name: None)
    for suffix, package in ((".usdz", "usd-core"), (".abc", "alembic3d")):
        with pytest.raises(InputError, match=package) as error:
            check_out(tmp_path / f"head{suffix}", replace=False)
        assert ".usda" in error.value.fix and ".usdz" not in error.value.fix
