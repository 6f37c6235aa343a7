"""The meshes of a capture: its raw scan and, in tests, the true vertices. Both in metres, capture world."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.storage.npz import check_unpacked_size

MAX_TRUTH_BYTES = 2**30  # 40 million vertices


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A raw scan; a point cloud has no triangles."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]


def read_scan(path: Path) -> Scan:
    """Read a PLY file, vertices in the file's order, larger faces cut into triangles.

    Raises InputError if it cannot be read, is empty, or holds numbers that are not finite.
    """
    try:
        mesh = trimesh.load(path, file_type="ply", process=False, maintain_order=True)
        vertices = np.array(getattr(mesh, "vertices", ()), np.float64)
        triangles = np.array(getattr(mesh, "faces", np.zeros((0, 3))), np.int64)
    except Exception as error:  # trimesh's parsers raise whatever a damaged file makes them trip over
        raise _refuse(path, "a PLY file with vertices and faces", f"{type(error).__name__}: {error}") from None
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) < 3:
        raise _refuse(path, "at least three vertices", f"vertices of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise _refuse(path, "finite vertices", f"vertex {np.argwhere(~np.isfinite(vertices))[0, 0]} is not")
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise _refuse(path, f"face indices below {len(vertices)}", f"{triangles.min()} to {triangles.max()}")
    return Scan(vertices=vertices, triangles=triangles)


def read_truth(path: Path) -> Float[np.ndarray, "N 3"]:
    """The vertices (m, capture world) of a `ground_truth.npz`. Raises InputError; never unpickles."""

    def refuse(expected: str, got: object) -> InputError:
        return InputError(
            "The ground truth cannot be used",
            where=path,
            expected=expected,
            got=got,
            fix="np.savez(path, vertices=...) with float (N, 3) vertices in metres, capture world",
        )

    try:
        check_unpacked_size(path, MAX_TRUTH_BYTES)
        with np.load(path, allow_pickle=False) as content:
            if "vertices" not in content.files:
                raise refuse('a field "vertices"', f"fields {', '.join(content.files)}")
            fields = {name: content[name] for name in content.files}  # an object array in any field raises ValueError
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise refuse("an NPZ file of plain arrays", error) from None
    vertices = fields["vertices"]
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind != "f":
        raise refuse('floats of shape (N, 3) in field "vertices"', f"{vertices.dtype} of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise refuse('finite numbers in field "vertices"', f"row {np.argwhere(~np.isfinite(vertices))[0, 0]} is not")
    return vertices


def _refuse(path: Path, expected: str, got: str) -> InputError:
    return InputError(
        "The scan cannot be used", where=path, expected=expected, got=got, fix="export it again as PLY, in metres"
    )
