"""Read the meshes of a capture: its raw scan and the ground truth of synthetic ones, metres, capture world."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.storage.mesh_files import MeshFile, read_mesh
from registration.storage.npz import NpzSchema
from registration.storage.reading import open_file

SCANS = ("scan.ply", "scan.obj", "scan.glb")  # names of a capture's scan, of which it has one
SCAN = " or ".join(SCANS)
_FAR_M, _COARSE_M, _MANY_VERTICES = 1e3, 2e-3, 2000
MAX_COORDINATE_M = 1e9  # beyond it, distances between vertices lose their meaning even in float64
_MESH_SUFFIXES = frozenset(".ply .obj .stl .off .glb .gltf .fbx .dae .3ds .x3d .wrl .xyz .pts .pcd .las .e57".split())
_FOLDERS = ("scan", "scans", "mesh", "meshes")
_PACKED_SUFFIXES = frozenset(".gz .bz2 .xz .zst .zip .7z".split())
_TRUTH = NpzSchema(
    title="ground truth",
    fix="np.savez(path, vertices=...) with float (N, 3) vertices in metres, capture world",
    fields={"vertices": ("float", "N 3")},
    never_empty="N",
    max_bytes=2**30,  # 40 million vertices
)


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A raw scan; a point cloud has no triangles."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]
    unused_vertices: int = 0  # of the file, left out here: no face has them
    unused_faces: int = 0  # of the file, left out here: with fewer than three different corners, or repeated
    unread: Mapping[str, int] = field(default_factory=dict)  # elements of the file that are not read -> their number


def read_scan(path: Path) -> Scan:
    """Read a PLY, OBJ or GLB file, vertices in the file's order, larger faces split into triangles.

    Vertices that no face uses are left out: mesh programs leave them behind, off the surface. So are faces without an
    area and repeated faces. A file whose faces are all unusable is a point cloud.

    Raises:
        InputError: the file cannot be read, has fewer than three vertices, non-finite vertices or wrong indices, or
            too few digits for a world so far from its origin.
    """
    mesh = read_scan_file(path)
    vertices, triangles = mesh.vertices, mesh.triangles
    distinct = triangles[distinct_triangles(triangles)]
    used = np.ones(len(vertices), bool)
    if len(distinct):
        used = np.zeros(len(vertices), bool)
        used[distinct] = True
    require_finite(path, vertices, used)
    if (step := _coarse_step_m(vertices[used])) is not None:
        raise _too_few_digits("scan", path, step, "PLY with double coordinates")
    return Scan(
        vertices=vertices[used],
        triangles=(np.cumsum(used) - 1)[distinct],
        unused_vertices=int((~used).sum()),
        unused_faces=len(triangles) - len(distinct),
        unread=mesh.unread,
    )


def read_scan_file(path: Path) -> MeshFile:
    """Read all that a scan's file holds, colours too; vertices that no face uses may not be finite.

    Raises:
        InputError: the file cannot be read, has fewer than three vertices, or wrong indices.
    """
    open_file(path, partial(_input_error, path)).close()  # it is a regular file
    try:
        mesh = read_mesh(path)
    except (OSError, ValueError, MemoryError) as error:
        kind = path.suffix.removeprefix(".").upper() or "PLY"
        raise _input_error(path, f"{kind} with vertices and faces", str(error) or type(error).__name__) from None
    vertices, triangles = mesh.vertices, mesh.triangles
    if len(vertices) < 3:
        raise _input_error(path, "at least three vertices", f"{len(vertices)} vertices")
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise _input_error(path, f"face indices below {len(vertices)}", f"{triangles.min()} to {triangles.max()}")
    return mesh


def require_finite(path: Path, vertices: Float[np.ndarray, "V 3"], used: Bool[np.ndarray, "V"]) -> None:
    """Raise InputError if a vertex that is used is not finite, or so far away that distances mean nothing."""
    broken = used & ~(np.abs(vertices) < MAX_COORDINATE_M).all(-1)
    if broken.any():
        got = f"vertex {int(np.flatnonzero(broken)[0])} is not, and {int(broken.sum()) - 1} more"
        raise _input_error(path, "finite vertices", got)


def _coarse_step_m(vertices: Float[np.ndarray, "V 3"]) -> float | None:
    """The step (m) to which coordinates of many vertices in a far world are rounded, if it is coarse; else None."""
    if len(vertices) < _MANY_VERTICES or np.abs(vertices).max() < _FAR_M:
        return None
    steps = [float(np.ptp(axis)) / max(len(np.unique(axis)) - 1, 1) for axis in vertices.T]
    return max(steps) if max(steps) > _COARSE_M else None


def _too_few_digits(what: str, path: Path, step_m: float, form: str) -> InputError:
    return InputError(
        f"The {what} has too few digits for a world so far from its origin",
        where=path,
        expected=f"coordinates with steps below {_COARSE_M:g} m",
        got=f"steps of about {step_m:.2g} m",
        fix=f"export {form}, or move the world's origin near the subject, cameras included",
    )


def distinct_triangles(triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "D"]:
    """Return the triangles with three different corners, the first of those with the same three, in order."""
    if not len(triangles):
        return np.zeros(0, np.int64)
    corners = np.sort(triangles, 1)
    valid = np.flatnonzero((corners[:, 0] < corners[:, 1]) & (corners[:, 1] < corners[:, 2]))
    corners = corners[valid]
    order = np.lexsort(corners.T)  # stable: of equal triangles the first in the file comes first
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(corners[order], axis=0) != 0).any(1)
    return np.sort(valid[order[new]])


def find_scan(root: Path) -> Path | None:
    """Return the path of a capture's scan, or None. It may be something else than a file.

    Raises:
        InputError: the folder has several.
    """
    found = [name for name in SCANS if os.path.lexists(root / name)]
    if len(found) > 1:
        raise InputError(
            "The capture has several scans",
            where=root,
            expected=f"one of {', '.join(SCANS)}",
            got=" and ".join(found),
            fix="keep the one that is right, and remove or rename the others",
        )
    return root / found[0] if found else None


def unread_scans(root: Path) -> list[str]:
    """Return the paths, within a capture folder, of what looks like a scan but is not read: only `SCANS` are."""
    names = []
    read = {root / name for name in SCANS}
    inside = [path for name in _FOLDERS if (root / name).is_dir() for path in (root / name).iterdir()]
    for path in sorted([*root.iterdir(), *inside]) if root.is_dir() else []:
        name = path.name.lower()
        packed = Path(name).suffix in _PACKED_SUFFIXES
        suffix = Path(Path(name).stem).suffix if packed else Path(name).suffix
        if path not in read and suffix in _MESH_SUFFIXES and path.is_file():
            names.append(path.relative_to(root).as_posix())
    return names


def read_truth(path: Path) -> Float[np.ndarray, "N 3"]:
    """Read the vertices (m, capture world) of a `ground_truth.npz`. Other fields are ignored.

    Raises:
        InputError: the file cannot be read, has no finite float (N, 3) field `vertices`, or too few digits for a world
            so far from its origin.
    """
    vertices = _TRUTH.read(path)["vertices"]
    if (step := _coarse_step_m(vertices)) is not None:
        raise _too_few_digits("ground truth", path, step, "float64 vertices")
    return vertices


def _input_error(path: Path, expected: object, got: object) -> InputError:
    return InputError(
        "The scan cannot be used",
        where=path,
        expected=expected,
        got=got,
        fix="export it again as PLY, OBJ or GLB, in metres",
    )
