"""GLB files of heads: read by trimesh, an independent reader, and field by field from the format's description."""

import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from registration.export.glb import glb_bytes, split_at_seams
from registration.export.registrations import head_of_registration, srgb_bytes
from tests.registration.export.heads import DATA, Glb, a_registration

COUNT = len(DATA.template_vertex_positions)


@pytest.fixture(scope="module")
def head():
    mesh = head_of_registration(a_registration(), DATA, name="anna")
    shapes = {f"shape {k}": DATA.expression_basis[k].astype(np.float64) for k in (0, 3)}
    return replace(mesh, shapes=shapes | {"still": np.zeros((COUNT, 3))})


def test_trimesh_reads_what_was_exported(head):
    content = glb_bytes(head)
    scene = trimesh.load(io.BytesIO(content), file_type="glb", process=False)
    topology = head.topology
    names = {mesh.visual.material.name for mesh in scene.geometry.values()}
    assert names == set(topology.materials) == {"skin", "eyes", "teeth", "tongue"}
    for mesh in scene.geometry.values():
        chosen = topology.triangle_material == topology.materials.index(mesh.visual.material.name)
        vertex = np.asarray(mesh.vertex_attributes["_VERTEX"]).astype(int).ravel()
        np.testing.assert_array_equal(vertex[mesh.faces], topology.triangles[chosen])
        np.testing.assert_allclose(mesh.vertices, head.vertices[vertex], atol=1e-7)
        np.testing.assert_allclose(mesh.vertex_normals, head.normals[vertex], atol=1e-6)
        np.testing.assert_allclose(mesh.visual.uv[mesh.faces], topology.triangle_uvs[chosen], atol=1e-6)
        np.testing.assert_array_equal(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), head.texture)


def test_shapes_are_morph_targets_in_the_models_order(head):
    file = Glb(glb_bytes(head))
    [mesh] = file.json["meshes"]
    assert mesh["extras"]["targetNames"] == ["shape 0", "shape 3", "still"] and mesh["weights"] == [0, 0, 0]
    np.testing.assert_allclose(file.whole("POSITION", COUNT), head.vertices, atol=1e-7)
    assert mesh["extras"]["vertexCount"] == COUNT
    for number, shape in enumerate(head.shapes.values()):
        np.testing.assert_allclose(file.whole("POSITION", COUNT, number), shape, atol=1e-8)
    moved = replace(head, vertices=head.vertices + head.shapes["shape 3"])
    normals = file.whole("NORMAL", COUNT) + file.whole("NORMAL", COUNT, 1)
    np.testing.assert_allclose(normals, moved.normals, atol=2e-3)


def test_the_texture_is_srgb_with_the_first_row_at_the_top(head):
    file = Glb(glb_bytes(head))
    image = cv2.imdecode(np.frombuffer(file.view(file.json["images"][0]["bufferView"]), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image[..., ::-1], srgb_bytes(a_registration().texture))


def test_vertices_are_split_at_seams_only():
    triangles = np.array([[0, 1, 2], [2, 1, 3]])
    uvs = np.array([[[0, 0], [1, 0], [0, 1]], [[0, 1], [0.5, 0], [1, 1]]])
    vertex, split, pairs = split_at_seams(triangles, uvs)
    np.testing.assert_array_equal(vertex, [0, 1, 1, 2, 3])
    np.testing.assert_array_equal(vertex[pairs], triangles)
    np.testing.assert_array_equal(split[pairs], uvs)


def test_a_head_without_a_texture_has_no_image(head):
    file = Glb(glb_bytes(replace(head, texture=None)))
    assert "images" not in file.json and "baseColorTexture" not in str(file.json["materials"])
