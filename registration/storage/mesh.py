"""Write meshes for other programs: binary PLY and Wavefront OBJ, vertices in the model's order."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from registration.frames import compact


def write_ply(
    file: Path,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F S"],
    normals: Float[np.ndarray, "V 3"] | None = None,
) -> None:
    """Write a binary little-endian PLY with exactly these vertices in this order, without uvs.

    Coordinates are float32, or float64 where float32 would lose micrometres; `normals`, if given, are of the vertices.
    """
    vertices = compact(vertices)
    kind, code = ("double", "<f8") if vertices.dtype == np.float64 else ("float", "<f4")
    names = ("x", "y", "z") if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    columns = vertices if normals is None else np.concatenate([vertices, normals], axis=1)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        + "".join(f"property {kind} {name}\n" for name in names)
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    corners = faces.shape[1]
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", corners)])
    rows["count"], rows["corners"] = corners, faces
    file.write_bytes(header.encode("ascii") + columns.astype(code).tobytes() + rows.tobytes())


def write_obj(
    file: Path,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F S"],
    corner_uvs: Float[np.ndarray, "F S 2"],
    texture: str | None,
    materials: Mapping[str, Int[np.ndarray, "_"]] | None = None,
) -> None:
    """Write an OBJ file and an MTL file of the same name.

    Args:
        file: the OBJ file.
        vertices: written as they are.
        faces: indices of vertices; all of one number of corners.
        corner_uvs: of the faces' corners; v = 0 at the bottom of the texture.
        texture: name of the texture's file, for the MTL file; None: no texture.
        materials: name -> indices of its faces, which are written as a group of that name; None: all, "head".
    """
    materials = {"head": np.arange(len(faces))} if materials is None else materials
    uvs, index = np.unique(corner_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    corners = np.stack([faces, index.reshape(faces.shape)], -1).reshape(len(faces), -1) + 1
    material = file.with_suffix(".mtl")
    lines = [f"mtllib {material.name}"]
    form = "v {:.7f} {:.7f} {:.7f}" if compact(vertices).dtype == np.float64 else "v {:.7g} {:.7g} {:.7g}"
    lines += [form.format(*row) for row in vertices.tolist()]
    lines += ["vt {:.7g} {:.7g}".format(*row) for row in uvs.tolist()]
    form = "f" + " {}/{}" * faces.shape[1]
    for name, members in materials.items():
        lines += [f"g {name}"] if len(materials) > 1 else []
        lines += [f"usemtl {name}", *(form.format(*row) for row in corners[members].tolist())]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    image = "" if texture is None else f"map_Kd {texture}\n"
    described = (f"newmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\n{image}" for name in materials)
    material.write_text("\n".join(described), encoding="utf-8")
