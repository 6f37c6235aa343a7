"""Read a folder of whole heads in a model's topology: mesh files, or registrations."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.cranium.registered import NEUTRAL, hidden_share
from registration.errors import InputError
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData, topology_hash
from registration.storage.mesh_files import SUFFIXES, read_mesh
from registration.storage.registration_folder import is_registration, load_registration

_MAX_OPEN = 0.02  # of the cranium's area, without triangles or observed by no camera
_HEIGHT_M = (0.15, 0.40)  # of the head without the neck, from a small child's to an adult's


def read_heads(folder: Path, data: GNMData) -> Float[np.ndarray, "N V 3"]:
    """Read all heads in a folder, in the order of their names.

    Args:
        folder: mesh files (.obj, .ply, .glb, .gltf; metres, vertices in the model's order) and folders of
            registrations of neutrals.
        data: the head model of the topology.

    Returns:
        The heads, metres.

    Raises:
        InputError: a mesh cannot be read, has another topology, another unit, or an open scalp; no head is there.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise _error("The folder of heads cannot be read", folder, "a folder of meshes", "no such folder")
    entries = sorted(folder.iterdir())
    heads = [
        _registered(path, data) if path.is_dir() else _mesh(path, data)
        for path in entries
        if (path.is_dir() and is_registration(path)) or path.suffix.lower() in SUFFIXES
    ]
    if not heads:
        names = ", ".join(path.name for path in entries[:5]) or "an empty folder"
        raise _error(
            "There is no head in the folder",
            folder,
            f"meshes ({', '.join(SUFFIXES)}) or registrations",
            names,
            fix="name the folder that contains them",
        )
    return np.stack(heads)


def _mesh(path: Path, data: GNMData) -> Float[np.ndarray, "V 3"]:
    try:
        mesh = read_mesh(path)
    except (ValueError, OSError) as error:
        raise _error("A head cannot be read", path, "an undamaged mesh file", error) from None
    count = len(data.template_vertex_positions)
    if len(mesh.vertices) != count:
        got = f"{len(mesh.vertices)} vertices"
        raise _error("A head has another topology than the model", path, f"{count} vertices in the model's order", got)
    here = np.isfinite(mesh.vertices).all(1)
    missing = _missing_edges(mesh.triangles, data)
    _check_scalp(path, data, here & ~missing, "has no triangles")
    if share := float(missing.mean()):
        got = f"{100 * share:.1f} % of the vertices lack edges of the model"
        raise _error("A head has another topology than the model", path, "the edges of the model's quads", got)
    return _checked(mesh.vertices, path, data)


def _missing_edges(triangles: Int[np.ndarray, "F 3"], data: GNMData) -> Bool[np.ndarray, "V"]:
    """Which vertices lack an edge of the model's quads: triangulations of one quad mesh may differ in the diagonals."""
    count = len(data.template_vertex_positions)

    def pairs(corners: Int[np.ndarray, "F S"]) -> Int[np.ndarray, "_"]:
        a, b = corners.astype(np.int64), np.roll(corners, -1, 1).astype(np.int64)
        return np.unique(np.minimum(a, b) * count + np.maximum(a, b))

    lost = np.setdiff1d(pairs(data.quads), pairs(triangles))
    missing = np.zeros(count, bool)
    missing[lost // count] = missing[lost % count] = True
    return missing


def _registered(path: Path, data: GNMData) -> Float[np.ndarray, "V 3"]:
    registration = load_registration(path)
    if topology_hash(registration.triangles) != topology_hash(data.triangles):
        raise _error("A head has another topology than the model", path, "the model's triangles", "other triangles")
    if (expression := registration.figures.get("expression", NEUTRAL)) != NEUTRAL:
        raise _error("A head is no neutral", path, f"a registration of the expression {NEUTRAL}", expression)
    share = hidden_share(data, registration.confidence)
    _check_share(path, share, "was observed by no camera")
    return _checked(registration.vertices, path, data)


def _check_scalp(path: Path, data: GNMData, whole: Bool[np.ndarray, "V"], what: str) -> None:
    area = vertex_areas(data.template_vertex_positions.astype(np.float64), data.triangles) * regions.cranium(data)
    _check_share(path, float(area @ ~whole / area.sum()), what)


def _check_share(path: Path, share: float, what: str) -> None:
    if share > _MAX_OPEN:
        got = f"{100 * share:.1f} % of the cranium's area {what}"
        raise _error("A head has an open scalp", path, f"a whole head: at most {100 * _MAX_OPEN:g} % open", got)


def _checked(vertices: Float[np.ndarray, "V 3"], path: Path, data: GNMData) -> Float[np.ndarray, "V 3"]:
    low, high = _HEIGHT_M
    height = float(np.ptp(vertices[regions.head_skin(data)], axis=0).max())
    if not low < height < high:
        raise _error("A head has no head's size", path, f"{low} to {high} m without the neck", f"{height:.4g} m")
    return vertices.astype(np.float64)


def _error(
    what: str, where: object, expected: object, got: object, fix: str = "replace or remove this head"
) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)
