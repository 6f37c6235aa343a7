"""Read and write GNM model files: 23 named arrays in one NPZ file, each field checked."""

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer, Shaped

from registration.storage.files import atomic_file
from registration.storage.npz import Defect, Kind, NpzSchema


@dataclass(frozen=True, kw_only=True, eq=False)
class GNMData:
    """A GNM model under the field names of the official file; dtypes are those of the file.

    V vertices, F triangles, Q quads, I identity, E expression, J joints, P mesh components, G vertex groups.
    Metres, +Y up, +Z out of the face, +X the subject's left. Names are NumPy string arrays.
    """

    version: Shaped[np.ndarray, ""]
    variant: Shaped[np.ndarray, ""]
    template_vertex_positions: Float[np.ndarray, "V 3"]
    template_joint_positions: Float[np.ndarray, "J 3"]
    vertex_identity_basis: Float[np.ndarray, "I V 3"]
    joint_identity_basis: Float[np.ndarray, "I J 3"]
    expression_basis: Float[np.ndarray, "E V 3"]
    identity_names: Shaped[np.ndarray, "I"]
    joint_names: Shaped[np.ndarray, "J"]
    expression_names: Shaped[np.ndarray, "E"]
    joint_parent_indices: Integer[np.ndarray, "J"]  # parents precede their children; the root's is negative
    skinning_weights: Float[np.ndarray, "J V"]
    quads: Integer[np.ndarray, "Q 4"]
    triangles: Integer[np.ndarray, "F 3"]
    quad_uvs: Float[np.ndarray, "Q 4 2"]  # one [0, 1]^2 map per mesh component
    triangle_uvs: Float[np.ndarray, "F 3 2"]  # the same maps
    mesh_component_names: Shaped[np.ndarray, "P"]  # each is also the name of a vertex group
    mirror_indices: Integer[np.ndarray, "V"]  # the vertex on the other side
    joint_regressor: Float[np.ndarray, "J V"]
    pose_correctives_regressor: Float[np.ndarray, "9*J 3*V"]
    bone_aligned_template_joint_orientations: Float[np.ndarray, "J 3 3"]
    vertex_groups: Float[np.ndarray, "G V"]
    vertex_group_names: Shaped[np.ndarray, "G"]
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)  # fields of the file outside the schema


# The annotations above vanish when shape checks are disabled, so the reader keeps its own table; a test compares both.
AXES: dict[str, tuple[Kind, str]] = {
    "version": ("text", ""),
    "variant": ("text", ""),
    "template_vertex_positions": ("float", "V 3"),
    "template_joint_positions": ("float", "J 3"),
    "vertex_identity_basis": ("float", "I V 3"),
    "joint_identity_basis": ("float", "I J 3"),
    "expression_basis": ("float", "E V 3"),
    "identity_names": ("text", "I"),
    "joint_names": ("text", "J"),
    "expression_names": ("text", "E"),
    "joint_parent_indices": ("integer", "J"),
    "skinning_weights": ("float", "J V"),
    "quads": ("integer", "Q 4"),
    "triangles": ("integer", "F 3"),
    "quad_uvs": ("float", "Q 4 2"),
    "triangle_uvs": ("float", "F 3 2"),
    "mesh_component_names": ("text", "P"),
    "mirror_indices": ("integer", "V"),
    "joint_regressor": ("float", "J V"),
    "pose_correctives_regressor": ("float", "9*J 3*V"),
    "bone_aligned_template_joint_orientations": ("float", "J 3 3"),
    "vertex_groups": ("float", "G V"),
    "vertex_group_names": ("text", "G"),
}
MAX_BYTES = 8 * 2**30  # of a model's arrays: ten times the official one
SCHEMA = NpzSchema(
    title="head model",
    fix="use the official gnm_head.npz (`gnmreg model fetch`) or a file that this project wrote",
    fields=AXES,
    indices={"triangles": "V", "quads": "V", "mirror_indices": "V"},
    never_empty="VJQFPG",  # without identities or expressions it is still a model
    max_bytes=MAX_BYTES,
)


def read(path: Path) -> GNMData:
    """Read the model in an NPZ file. Nothing is unpickled.

    Args:
        path: a file of the official schema.

    Raises:
        InputError: the file cannot be read, or a field is missing, has a wrong type or shape, holds values that are not
            finite, or indices out of range. The message names the field.
    """
    arrays = SCHEMA.read(path)
    _validate(arrays, path)
    return GNMData(**{name: arrays.pop(name) for name in AXES}, extra=arrays)


def write(data: GNMData, path: Path) -> None:
    """Write all fields and extras, names and dtypes kept, in one rename. Equal models make equal files.

    Raises:
        InputError: `read` would refuse the data.
    """
    path = Path(path)
    arrays = _arrays(data)
    if (defect := SCHEMA.find_defect(arrays)) is not None:
        raise SCHEMA.error(defect, path)
    _validate(arrays, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))  # a fixed date, for equal files
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def content_hash(data: GNMData) -> str:
    """Return the sha256 over every field's name, type, shape and bytes; independent of the file's compression."""
    digest = hashlib.sha256()
    for name, array in sorted(_arrays(data).items()):
        array = np.ascontiguousarray(array).reshape(array.shape)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def topology_hash(triangles: Integer[np.ndarray, "F 3"]) -> str:
    """Return the sha256 over the triangles, which identifies a topology; independent of the integer type."""
    return hashlib.sha256(np.ascontiguousarray(triangles, dtype="<i8").tobytes()).hexdigest()


def _validate(arrays: Mapping[str, np.ndarray], where: object) -> None:
    """Check what the table of types and shapes cannot express. Raises InputError."""
    parents = arrays["joint_parent_indices"]
    if parents[0] > 0 or (parents[1:] < 0).any() or (parents[1:] > np.arange(len(parents) - 1)).any():
        expected = "one root, first, and every parent before its children"
        defect = Defect(name="joint_parent_indices", what="index", expected=expected, got=parents.tolist())
        raise SCHEMA.error(defect, where)
    weights = arrays["skinning_weights"]
    if (weights < 0).any() or (weights.sum(0) <= 0).any():
        expected, got = (
            "weights >= 0 with a positive sum at every vertex",
            "negative weights, or a vertex without a joint",
        )
        raise SCHEMA.error(Defect(name="skinning_weights", what="value", expected=expected, got=got), where)


def _arrays(data: GNMData) -> dict[str, np.ndarray]:
    known = {f.name: getattr(data, f.name) for f in fields(data) if f.name != "extra"}
    return known | dict(data.extra)
