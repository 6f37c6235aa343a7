"""GLB files, read back by trimesh, an independent reader; it knows no morph targets."""

import io
import json

import numpy as np
import trimesh

from registration.report.glb import animated_glb, colour_bytes, static_glb

SPHERE = trimesh.creation.icosphere(subdivisions=2)
POINTS, FACES = np.array(SPHERE.vertices), np.array(SPHERE.faces)
COLOURS = 255.0 * (POINTS > 0)


def read_back(blob: bytes) -> trimesh.Trimesh:
    assert len(blob) % 4 == 0 and int.from_bytes(blob[8:12], "little") == len(blob)
    (mesh,) = trimesh.load(io.BytesIO(blob), file_type="glb", process=False).geometry.values()
    np.testing.assert_allclose(mesh.vertices, POINTS, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, FACES)
    return mesh


def test_an_animated_head_is_a_glb() -> None:
    read_back(animated_glb(POINTS, np.random.default_rng(0).normal(size=POINTS.shape), FACES, COLOURS))


def test_a_static_head_ends_with_its_colours() -> None:
    blob = static_glb(POINTS, FACES, COLOURS)
    read_back(blob)
    length = int.from_bytes(blob[12:16], "little")
    scene = json.loads(blob[20 : 20 + length])
    [primitive] = scene["meshes"][0]["primitives"]
    accessor = scene["accessors"][primitive["attributes"]["COLOR_0"]]
    view = scene["bufferViews"][accessor["bufferView"]]
    assert accessor["type"] == "VEC4" and accessor["componentType"] == 5123 and accessor["normalized"]
    assert view["byteOffset"] + view["byteLength"] == scene["buffers"][0]["byteLength"]
    assert blob.endswith(colour_bytes(COLOURS)) and len(colour_bytes(COLOURS)) == view["byteLength"]
    values = np.frombuffer(blob[-view["byteLength"] :], "<u2").reshape(-1, 4)
    np.testing.assert_array_equal(values, np.c_[65535 * (POINTS > 0), np.full(len(POINTS), 65535)])
