"""Read meshes from the files that scanners and mesh programs write: PLY, OBJ and GLB or glTF, as one type."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

MAX_FILE_BYTES = 2**31  # of one file
MAX_ELEMENTS = 50_000_000  # vertices, corners or uvs: ten times the largest scans of heads
SUFFIXES = (".ply", ".obj", ".glb", ".gltf")


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """The contents of a mesh file, in its own unit and axes."""

    vertices: Float[np.ndarray, "V 3"]  # in the file's order; may hold NaN
    triangles: Int[np.ndarray, "F 3"]  # polygons are split into fans
    colours: Float[np.ndarray, "V 3"] | None = None  # of the vertices, sRGB in [0, 1]
    corner_uvs: Float[np.ndarray, "F 3 2"] | None = None  # v = 0 at the bottom of the texture; NaN: none
    face_textures: Int[np.ndarray, "F"] | None = None  # index into `textures`, -1: none
    textures: tuple[Path | UInt8[np.ndarray, "H W 3"], ...] = ()  # image files that exist, or sRGB pixels
    unread: Mapping[str, int] = field(default_factory=dict)  # elements that are not read -> their number
    notes: tuple[str, ...] = ()  # what is missing beside the file, such as its materials


def read_mesh(path: Path) -> MeshFile:
    """Read a mesh file by its suffix, in any case.

    Args:
        path: a regular file; the caller has opened it.

    Raises:
        ValueError: it is damaged, too large, or of another format; the message says what was wrong.
        OSError: the file cannot be read.
    """
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise ValueError(f"{size} bytes; at most {MAX_FILE_BYTES} are read")
    match path.suffix.lower():
        case ".obj":
            from registration.storage.obj import read_obj

            return read_obj(path)
        case ".glb" | ".gltf":
            from registration.storage.gltf import read_gltf

            return read_gltf(path)
        case ".ply":
            from registration.storage.ply import read_ply

            mesh = read_ply(path)
            return MeshFile(
                vertices=mesh.vertices, triangles=mesh.triangles, colours=mesh.colours, unread=dict(mesh.unread)
            )
    raise ValueError(f"a file that ends in {path.suffix or 'nothing'}; expected {', '.join(SUFFIXES)}")


def fans(counts: Int[np.ndarray, "P"]) -> Int[np.ndarray, "F 3"]:
    """Split polygons into triangles around their first corner.

    Args:
        counts: corners of each polygon, whose corners follow one another in one list.

    Returns:
        For each triangle the positions of its corners in that list; polygons of fewer than three corners give none.
    """
    starts = np.cumsum(counts) - counts
    number = np.maximum(counts - 2, 0)
    first = np.repeat(starts, number)
    step = np.arange(len(first)) - np.repeat(np.cumsum(number) - number, number)
    return np.stack([first, first + step + 1, first + step + 2], 1)


def inside_folder(folder: Path, name: str) -> Path | None:
    """Return the file that a mesh file names beside itself, or None: it is absent, or leaves the folder.

    Programs write paths of their own computer; then a file of the same name beside the mesh is meant.

    Args:
        folder: of the mesh file.
        name: as written there, with slashes of either kind.
    """
    plain = name.strip().strip('"').replace("\\", "/")
    for candidate in (plain, plain.rpartition("/")[2]):
        if not candidate or "\0" in candidate:
            continue
        try:
            path = (folder / candidate).resolve()
            if path.is_relative_to(folder.resolve()) and path.is_file():
                return path
        except OSError:
            continue
    return None
