"""OBJ and GLB files as programs write them, and damaged ones."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.storage.mesh import write_ply
from registration.storage.mesh_files import read_mesh
from tests.registration.capture.small import make

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
POINTS, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces)
UVS = np.stack([np.arctan2(POINTS[:, 0], POINTS[:, 2]) / 6.3 + 0.5, POINTS[:, 1] * 5 + 0.5], 1)
PICTURE = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)


def _textured() -> trimesh.Trimesh:
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(PICTURE))
    visual = trimesh.visual.TextureVisuals(uv=UVS, material=material)
    return trimesh.Trimesh(POINTS, FACES, visual=visual, process=False)


def test_an_obj_has_polygons_negative_indices_groups_and_colours(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(
        b"# a comment\r\nmtllib absent.mtl\r\no head\r\n"
        b"v 0 0 0 1 0 0\r\nv 1 0 0 0 1 0\r\nv 1 1 0 0 0 1\r\nv 0 1 0 1 1 1\r\n"
        b"vt 0 0\r\nvt 1 0\r\nvt 1 1\r\nvt 0 1\r\nvn 0 0 1\r\n"
        b"g one\r\nusemtl skin\r\nf 1/1/1 2/2/1 3/3/1 4/4/1\r\n"
        b"g two\r\ns off\r\nf -4//1 -2//1 \\\r\n-1//1\r\nf 1 2 3 # end\r\nl 1 2\r\n"
    )
    mesh = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 2, 3], [0, 1, 2]])
    np.testing.assert_array_equal(mesh.vertices[2], [1, 1, 0])
    assert mesh.colours is not None and mesh.colours[1].tolist() == [0, 1, 0]
    assert mesh.corner_uvs is not None and mesh.corner_uvs[1].tolist() == [[0, 0], [1, 1], [0, 1]]
    assert np.isnan(mesh.corner_uvs[2:]).all()
    assert mesh.unread == {"l": 1} and "absent.mtl" in mesh.notes[0]


def test_an_obj_names_its_texture_beside_itself_and_nothing_outside(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    Image.fromarray(PICTURE).save(folder / "skin 1.png")
    (tmp_path / "secret.png").write_bytes(b"")
    (folder / "a.mtl").write_text(
        "newmtl a\nmap_Kd -s 1 1 1 C:\\Users\\me\\skin 1.png\nnewmtl b\nmap_Kd ../secret.png\nnewmtl c\nKd 1 0 0\n"
    )
    (folder / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
        "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 2/2 3/3\nusemtl c\nf 1/1 2/2 3/3\n"
    )
    mesh = read_mesh(folder / "a.obj")
    assert mesh.textures == (folder / "skin 1.png",)
    assert mesh.face_textures is not None and mesh.face_textures.tolist() == [0, -1, -1]
    assert "secret.png" in mesh.notes[0]


@pytest.mark.parametrize(
    ("body", "got"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertex 4 of 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "vertex 0 of 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 1 2\n", "beyond the first of 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/5 2/5 3/5\n", "texture coordinate 5 of 0"),
        ("v 0 0 0\nv 1 x 0\nv 0 1 0\nf 1 2 3\n", "'x' in the 2. line v"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 three\n", "no corner"),
        ("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "2 coordinates"),
        ("v 0 0 0 0.5\nv 1 0 0 1\nv 0 1 0 1\nf 1 2 3\n", "weight"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0 is not"),
        ("nothing\n", "no vertices"),
        ("\0\0\0", "binary"),
    ],
)
def test_a_damaged_obj_is_refused_with_what_is_wrong(tmp_path: Path, body: str, got: str) -> None:
    (tmp_path / "scan.obj").write_text(body)
    with pytest.raises(InputError) as error:
        read_scan(tmp_path / "scan.obj")
    assert got in error.value.got


def test_a_glb_has_its_places_textures_and_uvs(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(_textured(), transform=trimesh.transformations.translation_matrix([1, 2, 3]))
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    mesh = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.vertices, POINTS + [1, 2, 3], atol=1e-6)
    np.testing.assert_array_equal(mesh.triangles, FACES)
    assert mesh.corner_uvs is not None
    np.testing.assert_allclose(mesh.corner_uvs, UVS[FACES], atol=1e-6)
    assert isinstance(mesh.textures[0], np.ndarray)
    np.testing.assert_array_equal(mesh.textures[0], PICTURE)


def test_a_gltf_reads_the_files_in_its_folder_only(tmp_path: Path) -> None:
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(_textured())).items():
        (tmp_path / name).write_bytes(content)
    mesh = read_mesh(tmp_path / "model.gltf")
    np.testing.assert_allclose(mesh.vertices, POINTS, atol=1e-6)
    header = json.loads((tmp_path / "model.gltf").read_text())
    header["buffers"][0]["uri"] = "../outside.bin"
    (tmp_path.parent / "outside.bin").write_bytes(b"")
    (tmp_path / "model.gltf").write_text(json.dumps(header))
    with pytest.raises(ValueError, match="no file in its folder"):
        read_mesh(tmp_path / "model.gltf")


@pytest.mark.parametrize("colours", [np.uint8, np.float32])
def test_vertex_colours_of_glb_and_ply(tmp_path: Path, colours: type) -> None:
    values = np.random.default_rng(1).integers(0, 255, (len(POINTS), 4)).astype(np.uint8)
    values[:, 3] = 255
    coloured = trimesh.Trimesh(POINTS, FACES, vertex_colors=values, process=False)
    for name in ("a.glb", "a.ply", "a.obj"):
        coloured.export(tmp_path / name)
        mesh = read_mesh(tmp_path / name)
        assert mesh.colours is not None
        np.testing.assert_allclose(mesh.colours, values[:, :3] / 255, atol=3e-3)


def _with_header(header: object) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize(
    ("content", "got"),
    [
        (b"glTF", "cut short"),
        (struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0x4E4F534A), "version 1"),
        (_with_header({"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}), "draco"),
        (_with_header({"asset": {"version": "2.0"}, "accessors": [{"count": 10**12}]}), "accessor 0"),
        (_with_header({"asset": {"version": "2.0"}, "meshes": []}), ""),
        (_with_header([]), "version 2"),
        (_with_header({"asset": {"version": "2.0"}, "buffers": [{"uri": "file:///etc/passwd"}]}), "no file"),
    ],
)
def test_a_damaged_glb_is_refused(tmp_path: Path, content: bytes, got: str) -> None:
    (tmp_path / "scan.glb").write_bytes(content)
    with pytest.raises(InputError) as error:
        read_scan(tmp_path / "scan.glb")
    assert got in error.value.got


def test_every_prefix_of_a_glb_is_read_or_refused(tmp_path: Path) -> None:
    content = trimesh.Scene(_textured()).export(file_type="glb")
    for size in np.linspace(0, len(content) - 1, 25).astype(int):
        (tmp_path / "scan.glb").write_bytes(content[:size])
        with pytest.raises(InputError):
            read_scan(tmp_path / "scan.glb")


def test_a_capture_reads_its_scan_in_any_format_and_only_one(tmp_path: Path) -> None:
    root = make(tmp_path / "capture")
    scan = read_scan(root / "scan.ply")
    mesh = trimesh.Trimesh(scan.vertices, scan.triangles, process=False)
    (root / "scan.ply").unlink()
    for name in ("scan.obj", "scan.glb"):
        mesh.export(root / name)
        capture = read_capture(root)
        assert capture.scan == root / name
        np.testing.assert_allclose(read_scan(root / name).vertices, scan.vertices, atol=1e-6)
        (root / name).unlink()
    mesh.export(root / "scan.obj")
    write_ply(root / "scan.ply", scan.vertices, scan.triangles)
    with pytest.raises(InputError) as error:
        read_capture(root)
    assert error.value.got == "scan.ply and scan.obj"
