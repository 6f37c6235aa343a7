"""The official GNM file schema: 23 named arrays in one NPZ, every field checked, written back unchanged."""

import hashlib
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer, Shaped

from registration.errors import InputError
from registration.storage.npz import check_unpacked


@dataclass(frozen=True, kw_only=True, eq=False)
class GNMData:
    """A GNM model as it lies on disk, under the official field names; dtypes are the file's own.

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
    joint_parent_indices: Integer[np.ndarray, "J"]  # parents come before their children; the root's is negative
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
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)  # fields of the file that the schema does not know


# The annotations above vanish when shape checks are disabled, so the reader keeps its own table; a test compares both.
AXES = {
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
_KINDS = {"text": "U", "float": "f", "integer": "iu"}
MAX_BYTES = 8 * 2**30  # of a model's arrays: ten times the official one
_FETCH = "use the official gnm_head.npz (`gnmreg model fetch`) or a file that this project wrote"


def read(path: Path) -> GNMData:
    """The model in an NPZ file. Nothing is ever unpickled.

    Raises InputError, naming the field, for a file that cannot be read, a missing field, a wrong type or shape, values
    that are not finite, and indices out of range.
    """
    path = Path(path)
    arrays = _load(path)
    missing = [name for name in AXES if name not in arrays]
    if missing:
        raise InputError(
            f"the model file lacks the field '{missing[0]}'",
            where=path,
            expected=f"the {len(AXES)} fields of the GNM schema",
            got=f"{len(AXES) - len(missing)} of them; missing: {', '.join(missing)}",
            fix=_FETCH,
        )
    _validate(arrays, path)
    return GNMData(**{name: arrays.pop(name) for name in AXES}, extra=arrays)


def write(data: GNMData, path: Path) -> None:
    """Write all fields and extras, names and dtypes kept; the file appears whole or not at all.

    Raises InputError for data that `read` would refuse.
    """
    path = Path(path)
    arrays = _arrays(data)
    _validate(arrays, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in arrays.items():
                # A fixed date makes equal models equal files.
                entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(entry, "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, array, allow_pickle=False)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def content_hash(data: GNMData) -> str:
    """sha256 over every field's name, type, shape and bytes: equal for equal models, whatever the file."""
    digest = hashlib.sha256()
    for name, array in sorted(_arrays(data).items()):
        array = np.ascontiguousarray(array).reshape(array.shape)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def topology_hash(triangles: Integer[np.ndarray, "F 3"]) -> str:
    """sha256 over the triangles: two meshes share a topology exactly when this is equal, whatever the integer type."""
    return hashlib.sha256(np.ascontiguousarray(triangles, dtype="<i8").tobytes()).hexdigest()


def _load(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        what = "there is no model file"
        raise InputError(what, where=path, expected="a GNM .npz file", got="no such file", fix=_FETCH)
    name: str | None = None
    try:
        check_unpacked(path, MAX_BYTES)
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("a single array")
            arrays = {}
            for name in archive.files:
                arrays[name] = archive[name]
                if not isinstance(arrays[name], np.ndarray):  # numpy hands out a foreign zip member as bytes
                    raise ValueError("no array")
            return arrays
    except Exception as error:  # whatever a hostile or broken file makes zipfile, zlib and numpy raise
        what = "the model file cannot be read" if name is None else f"the model file's field '{name}' cannot be read"
        expected = "plain arrays in an undamaged .npz file (pickled objects are never loaded)"
        got = f"{type(error).__name__}: {error}"
        raise InputError(what, where=path, expected=expected, got=got, fix=_FETCH) from error


def _validate(arrays: Mapping[str, np.ndarray], where: object) -> None:
    """Raises InputError, naming the field, unless types, shapes, values and indices all fit together."""
    sizes: dict[str, int] = {}
    for name, (kind, axes) in AXES.items():
        array = arrays[name]
        if array.dtype.kind not in _KINDS[kind]:
            raise _wrong(name, "type", where, f"a {kind} array", array.dtype)
        _check_shape(name, array.shape, axes, sizes, where)
        if kind == "float" and not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))
            got = f"{len(bad)} NaN or infinite, first at {tuple(bad[0].tolist())}"
            raise _wrong(name, "value", where, "finite numbers", got)
    for name in ("triangles", "quads", "mirror_indices"):
        array = arrays[name]
        if array.size and (array.min() < 0 or array.max() >= sizes["V"]):
            got = f"indices from {array.min()} to {array.max()}"
            raise _wrong(name, "index", where, f"indices of the {sizes['V']} vertices", got)
    parents = arrays["joint_parent_indices"]
    if parents[0] > 0 or (parents[1:] < 0).any() or (parents[1:] > np.arange(len(parents) - 1)).any():
        expected = "one root, first, and every parent before its children"
        raise _wrong("joint_parent_indices", "index", where, expected, parents.tolist())
    weights = arrays["skinning_weights"]
    if (weights < 0).any() or (weights.sum(0) <= 0).any():
        expected = "weights of at least 0 with a positive sum at every vertex"
        raise _wrong("skinning_weights", "value", where, expected, "negative weights, or a vertex without a joint")


def _check_shape(name: str, shape: tuple[int, ...], axes: str, sizes: dict[str, int], where: object) -> None:
    letters = axes.split()
    expected = "(" + ", ".join(f"{axis}={sizes[axis]}" if axis in sizes else axis for axis in letters) + ")"
    if len(shape) != len(letters):
        raise _wrong(name, "shape", where, expected, shape)
    for axis, size in zip(letters, shape, strict=True):
        factor, _, letter = axis.rpartition("*")
        # A model may come without identities or expressions; without vertices or joints it is none.
        if axis.isalpha() and letter not in sizes and (size > 0 or letter in "IE"):
            sizes[letter] = size
        wanted = int(letter) if letter.isdigit() else int(factor or 1) * sizes.get(letter, -1)
        if size != wanted:
            raise _wrong(name, "shape", where, expected, shape)


def _wrong(name: str, what: str, where: object, expected: object, got: object) -> InputError:
    sentence = f"the model's field '{name}' has a wrong {what}"
    return InputError(sentence, where=where, expected=expected, got=got, fix=_FETCH)


def _arrays(data: GNMData) -> dict[str, np.ndarray]:
    known = {f.name: getattr(data, f.name) for f in fields(data) if f.name != "extra"}
    return known | dict(data.extra)
