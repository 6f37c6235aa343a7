"""Write meshes for other programs: binary PLY and Wavefront OBJ, vertices in the model's order."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from registration.frames import compact


def write_ply(file: Path, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> None:
    """Write a binary little-endian PLY with exactly these vertices in this order, without uvs.

    Coordinates are float32, or float64 where float32 would lose micrometres.
    """
    vertices = compact(vertices)
    kind, code = ("double", "<f8") if vertices.dtype == np.float64 else ("float", "<f4")
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty {kind} x\nproperty {kind} y\nproperty {kind} z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    file.write_bytes(header.encode("ascii") + vertices.astype(code).tobytes() + faces.tobytes())


def write_obj(
    file: Path,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    corner_uvs: Float[np.ndarray, "F 3 2"],
    texture: str,
) -> None:
    """Write an OBJ file and an MTL file of the same name.

    Args:
        file: the OBJ file.
        vertices: written as they are.
        triangles: indices of vertices.
        corner_uvs: of the triangles' corners; v = 0 at the bottom of the texture.
        texture: name of the texture's file, for the MTL file.
    """
    uvs, index = np.unique(corner_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    corners = np.stack([triangles, index.reshape(-1, 3)], -1).reshape(-1, 6) + 1
    material = file.with_suffix(".mtl")
    lines = [f"mtllib {material.name}"]
    form = "v {:.7f} {:.7f} {:.7f}" if compact(vertices).dtype == np.float64 else "v {:.7g} {:.7g} {:.7g}"
    lines += [form.format(*row) for row in vertices.tolist()]
    lines += ["vt {:.7g} {:.7g}".format(*row) for row in uvs.tolist()]
    lines += ["usemtl head"]
    lines += ["f {}/{} {}/{} {}/{}".format(*row) for row in corners.tolist()]
    file.write_text("\n".join(lines) + "\n", encoding="ascii")
    material.write_text(f"newmtl head\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {texture}\n", encoding="ascii")
