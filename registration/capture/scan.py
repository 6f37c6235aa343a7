"""Read the meshes of a capture: its raw scan and the ground truth of synthetic ones, metres, capture world."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.storage.npz import NpzSchema

_TRUTH = NpzSchema(
    title="ground truth",
    fix="np.savez(path, vertices=...) with float (N, 3) vertices in metres, capture world",
    fields={"vertices": ("float", "N 3")},
    max_bytes=2**30,  # 40 million vertices
)


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A raw scan; a point cloud has no triangles."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]


def read_scan(path: Path) -> Scan:
    """Read a PLY file, vertices in the file's order, larger faces split into triangles.

    Raises:
        InputError: the file cannot be read, has fewer than three vertices, non-finite vertices or wrong indices.
    """
    try:
        mesh = trimesh.load(path, file_type="ply", process=False, maintain_order=True)
        vertices = np.array(getattr(mesh, "vertices", ()), np.float64)
        triangles = np.array(getattr(mesh, "faces", np.zeros((0, 3))), np.int64)
    except Exception as error:  # a damaged file makes trimesh's parsers raise nearly anything
        raise _input_error(path, "a PLY file with vertices and faces", f"{type(error).__name__}: {error}") from None
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) < 3:
        raise _input_error(path, "at least three vertices", f"vertices of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise _input_error(path, "finite vertices", f"vertex {np.argwhere(~np.isfinite(vertices))[0, 0]} is not")
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise _input_error(path, f"face indices below {len(vertices)}", f"{triangles.min()} to {triangles.max()}")
    return Scan(vertices=vertices, triangles=triangles)


def read_truth(path: Path) -> Float[np.ndarray, "N 3"]:
    """Read the vertices (m, capture world) of a `ground_truth.npz`. Other fields are ignored.

    Raises:
        InputError: the file cannot be read, or has no finite float (N, 3) field `vertices`.
    """
    return _TRUTH.read(path)["vertices"]


def _input_error(path: Path, expected: str, got: str) -> InputError:
    return InputError(
        "The scan cannot be used", where=path, expected=expected, got=got, fix="export it again as PLY, in metres"
    )
