"""GLB: a head with texture, normals, one primitive per material, and its shapes as morph targets.

glTF has one uv per vertex, so vertices on uv seams are written once per uv. The attribute `_VERTEX` holds each one's
index in the model, as a float because glTF forbids whole numbers of 32 bits there.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from registration.export.gltf import ELEMENTS, VERTICES, GlbFile
from registration.export.head_mesh import HeadMesh, unit_normals

MAX_VERTICES = 2**24  # whole numbers that float32 holds
ROUGHNESS = {"skin": 0.6, "eyes": 0.15, "teeth": 0.3, "tongue": 0.4}  # for a viewer's lights
_STILL = 1e-3  # changes of unit normals below this are left out
_DENSE_SHARE = 0.5  # of the rows; fewer that move are stored sparsely


def glb_bytes(mesh: HeadMesh) -> bytes:
    """Return a head as a GLB file: metres, +Y up, triangles.

    Args:
        mesh: its frames are not written.

    Raises:
        ValueError: more vertices than `MAX_VERTICES`.
    """
    topology, file = mesh.topology, GlbFile()
    if topology.vertex_count > MAX_VERTICES:
        raise ValueError(f"{topology.vertex_count} vertices")
    moved = {name: mesh.vertices + shape for name, shape in mesh.shapes.items()}
    normal_changes = {
        name: unit_normals(vertices, topology.triangles) - mesh.normals for name, vertices in moved.items()
    }
    primitives: list[dict[str, Any]] = []
    materials: list[dict[str, Any]] = []
    for number, material in enumerate(topology.materials):
        chosen = topology.triangle_material == number
        if not chosen.any():
            continue
        vertex, uvs, triangles = split_at_seams(topology.triangles[chosen], topology.triangle_uvs[chosen])
        attributes = {
            "POSITION": file.array(_floats(mesh.vertices[vertex]), target=VERTICES, bounds=True),
            "NORMAL": file.array(_floats(mesh.normals[vertex]), target=VERTICES),
            "TEXCOORD_0": file.array(_floats(uvs * (1, -1) + (0, 1)), target=VERTICES),  # v = 0 at the top
            "_VERTEX": file.array(_floats(vertex), target=VERTICES),
        }
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": file.array(np.ascontiguousarray(triangles, "<u4").reshape(-1), target=ELEMENTS),
            "material": len(materials),
        }
        if mesh.shapes:
            primitive["targets"] = [
                _target(file, shape[vertex], normal_changes[name][vertex]) for name, shape in mesh.shapes.items()
            ]
        primitives.append(primitive)
        materials.append(_material(material, textured=mesh.texture is not None))
    scene: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": mesh.name}],
        "meshes": [{"name": mesh.name, "primitives": primitives, "extras": _extras(mesh)}],
        "materials": materials,
    }
    if mesh.shapes:
        scene["meshes"][0]["weights"] = [0] * len(mesh.shapes)
    if mesh.texture is not None:
        scene["images"] = [
            {"name": "texture", "mimeType": "image/png", "bufferView": file.view(png_bytes(mesh.texture))}
        ]
        scene["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]  # linear, clamped
        scene["textures"] = [{"source": 0, "sampler": 0}]
    return file.content(scene)


def split_at_seams(
    triangles: Int[np.ndarray, "F 3"], uvs: Float[np.ndarray, "F 3 2"]
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P 2"], Int[np.ndarray, "F 3"]]:
    """Give every pair of vertex and uv an index of its own.

    Args:
        triangles: vertex indices.
        uvs: of the triangles' corners.

    Returns:
        The vertex of each pair, in ascending order, its uv, and the triangles of pairs.
    """
    _, uv = np.unique(uvs.reshape(-1, 2), axis=0, return_inverse=True)
    pair = triangles.reshape(-1).astype(np.int64) * (int(uv.max(initial=0)) + 1) + uv.reshape(-1)
    _, first, index = np.unique(pair, return_index=True, return_inverse=True)
    return triangles.reshape(-1)[first], uvs.reshape(-1, 2)[first], index.reshape(triangles.shape)


def png_bytes(image: UInt8[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W"]) -> bytes:
    """Return an RGB or grey image as a PNG file."""
    done, content = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not done:
        raise OSError("the image cannot be encoded")
    return content.tobytes()


def _target(file: GlbFile, positions: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]) -> Mapping[str, int]:
    numbers = {}
    for name, values, least in (("POSITION", positions, 0.0), ("NORMAL", normals, _STILL)):
        rows = np.flatnonzero(np.abs(values).max(1) > least)
        if len(rows) > _DENSE_SHARE * len(values):
            numbers[name] = file.array(_floats(values), target=VERTICES, bounds=name == "POSITION")
        else:
            numbers[name] = file.sparse_array(_floats(_only(values, rows)), rows, bounds=name == "POSITION")
    return numbers


def _only(values: Float[np.ndarray, "P 3"], rows: Int[np.ndarray, "R"]) -> Float[np.ndarray, "P 3"]:
    kept = np.zeros_like(values)
    kept[rows] = values[rows]
    return kept


def _material(name: str, *, textured: bool) -> dict[str, Any]:
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": ROUGHNESS.get(name, 0.6)}
    if textured:
        surface["baseColorTexture"] = {"index": 0}
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": name == "skin"}


def _extras(mesh: HeadMesh) -> dict[str, object]:
    names: dict[str, object] = {"targetNames": list(mesh.shapes)} if mesh.shapes else {}  # where readers look for them
    if mesh.shape_figures:
        names["shapeFigures"] = mesh.shape_figures
    return {**names, "vertexCount": mesh.topology.vertex_count, **mesh.origin}


def _floats(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, "<f4")
