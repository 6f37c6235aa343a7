"""Read and write GNM model files: 23 named arrays in one NPZ file, each field checked.

Arrays outside these are kept. Google's loader refuses a file with other fields, so they are written into a second file
beside the model, NAME.extra.npz, which belongs to it and is read with it.
"""

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePath
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Integer, Shaped

from registration.errors import InputError
from registration.model import wrong_files
from registration.storage.files import atomic_file
from registration.storage.npz import Defect, Kind, NpzSchema

AnyPath = TypeVar("AnyPath", bound=PurePath)


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
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)  # fields outside the schema

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user should know of the file: fields and versions that this project does not know."""
        remarks = []
        if not str(self.version).startswith(f"{VERSION.split('.')[0]}."):
            remarks.append(
                f"the model states version {self.version}: its {len(AXES)} known fields are read as {VERSION}"
            )
        if self.extra:
            remarks.append(f"fields of the model outside version {VERSION}, kept and not used: {', '.join(self.extra)}")
        return tuple(remarks)


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
VERSION = "3.0"
MAX_BYTES = 8 * 2**30  # of a model's arrays: ten times the official one
SCHEMA = NpzSchema(
    title="head model",
    fix="use the official gnm_head.npz (`gnmreg model fetch`) or a file that this project wrote",
    fields=AXES,
    indices={"triangles": "V", "quads": "V", "mirror_indices": "V"},
    never_empty="VJQFPG",  # without identities or expressions it is still a model
    max_bytes=MAX_BYTES,
)
_VERSION_ALONE = NpzSchema(title="head model", fix=SCHEMA.fix, fields={"version": ("text", "")}, max_bytes=MAX_BYTES)
_EXTRA = NpzSchema(
    title="second file of the head model",
    fix="remove it, or copy it again together with the model",
    fields={},
    max_bytes=MAX_BYTES,
)
_DAMAGED = ("BadZipFile", "error:", "EOFError")  # what zipfile and zlib raise for members whose bytes changed


def read(path: Path) -> GNMData:
    """Read the model in an NPZ file, and the fields of its second file, if it has one. Nothing is unpickled.

    Args:
        path: a file of the official schema; further fields are kept in `extra` (`GNMData.remarks` names them).

    Raises:
        InputError: the file cannot be read, is something else or of an older version, or a field is missing, has a
            wrong type or shape, holds values that are not finite, or indices out of range. The message names the field.
    """
    path = Path(path)
    try:
        arrays = SCHEMA.read(path)
    except InputError as error:
        raise _explained(error, path) from None
    if (version := wrong_files.older_version(arrays)) is not None:
        raise SCHEMA.error(Defect(name="version", what="value", expected=f"version {VERSION}", got=version), path)
    _validate(arrays, path)
    fields_of_schema = {name: arrays.pop(name) for name in AXES}
    return GNMData(**fields_of_schema, extra={**arrays, **_read_extra(extra_path(path), arrays)})


def write(data: GNMData, path: Path, *, extra_inside: bool = False) -> None:
    """Write a model, names and dtypes kept, in one rename. Equal models make equal files.

    The file has exactly the fields of the schema; the other ones go into `extra_path(path)`, which is removed if there
    are none.

    Args:
        data: the model.
        path: of the file.
        extra_inside: write the fields outside the schema into the same file; Google's loader refuses it.

    Raises:
        InputError: `read` would refuse the data.
    """
    path = Path(path)
    arrays = _arrays(data)
    if (defect := SCHEMA.find_defect(arrays)) is not None:
        raise SCHEMA.error(defect, path)
    _validate(arrays, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = {} if extra_inside else dict(data.extra)
    if beside:
        _write_arrays(beside, extra_path(path))
    _write_arrays({name: array for name, array in arrays.items() if name not in beside}, path)
    if not beside:
        extra_path(path).unlink(missing_ok=True)  # of a model that was here before


def extra_path(path: AnyPath) -> AnyPath:
    """Return the path of a model's second file, with the fields outside the schema."""
    return path.with_suffix(".extra.npz")


def _read_extra(path: Path, inside: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    if not path.exists():
        return {}
    arrays = _EXTRA.read(path)
    if twice := [name for name in arrays if name in AXES or name in inside]:
        raise InputError(
            "Fields of the head model are in two files",
            where=path,
            expected="fields that the model's own file does not have",
            got=", ".join(twice),
            fix="remove this file, or take these fields out of it",
        )
    return arrays


def _write_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))  # a fixed date, for equal files
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def _explained(error: InputError, path: Path) -> InputError:
    """The error of a file that is no model, with what it is instead: a damaged model or something else."""
    if not path.is_file():  # missing, a folder, a pipe or a device, as the error says
        return error
    fix, what = error.fix, wrong_files.describe_wrong_file(path)
    if what is None:
        try:
            names = SCHEMA.names(path)
        except InputError:
            return error
        what = wrong_files.describe_wrong_names(names)
        if what is None and not set(AXES).intersection(names):
            what = f"none of these fields; it has {', '.join(names[:9]) or 'no array'}"
        if what is None:  # a GNM model: of another version, or damaged
            if error.got.startswith(_DAMAGED):
                fix = f"the file is damaged: copy it again, or {fix}"
            version = _stated_version(path) if "missing:" in error.got else None
            what = f"version {version}, with {error.got}" if version and version != VERSION else error.got
    return InputError(error.what, where=error.where, expected=error.expected, got=what, fix=fix)


def _stated_version(path: Path) -> str | None:
    try:
        return str(_VERSION_ALONE.read(path, only=("version",))["version"])[:40]
    except InputError:
        return None


def content_hash(data: GNMData) -> str:
    """Return the sha256 over every field's name, type, shape and bytes, also of the fields outside the schema.

    It does not depend on the files' compression, nor on which of the two files holds a field.
    """
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
