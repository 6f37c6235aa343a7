"""FLAME from its user's own file: the published pickle, which is never run, or the same arrays in an NPZ file.

Both have the layout of SMPL: `shapedirs` holds the identity components, 300 of 400, before the expressions; joints are
regressed from the shaped vertices, so that expressions move them too; pose correctives follow all joints but the root.
"""

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import Joints, LinearModelData, check
from registration.linear_models.frame import Frame, normalized
from registration.linear_models.npz_names import array_names, first_bytes
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.storage.npz import Kind, NpzSchema
from registration.storage.pickled_arrays import as_array, read_pickled_arrays

TITLE = "FLAME model"
LICENCE = (
    "FLAME: the terms of the Max Planck Society under which its user obtained the file; this program neither grants "
    "nor checks them"
)
JOINTS = {5: ("root", "neck", "jaw", "left_eye", "right_eye"), 4: ("root", "neck", "left_eye", "right_eye")}
COMPONENTS = 400  # of the published files, of which the first are identities
IDENTITIES = 300
_FIX = "use the model's file as it was published, or write its arrays as a plain NPZ (docs/other_models.md)"
_FIELDS: dict[str, tuple[Kind, str]] = {
    "v_template": ("float", "V 3"),
    "f": ("integer", "F 3"),
    "shapedirs": ("float", "V 3 K"),
    "J_regressor": ("float", "J V"),
    "weights": ("float", "V J"),
    "kintree_table": ("integer", "2 J"),
}
_OPTIONAL: dict[str, tuple[Kind, str]] = {"posedirs": ("float", "V 3 P"), "exp_dirs": ("float", "V 3 E")}
_PICKLE = re.compile(rb"\x80[\x02-\x05]|\(dp|\}q")
_MAX_BYTES = 2**31


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read a FLAME file, a pickle or an NPZ.

    Args:
        path: of the 2020 or the 2023 model; of the 2023 one without the jaw, with `without_jaw`.
        options: `identity_components` is needed for files of another number than 400 components.

    Raises:
        InputError: it is damaged, wants to run something, or its arrays do not belong together.
    """
    arrays = _from_npz(path) if array_names(path) else _from_pickle(path)
    identity, expression = _bases(arrays, path, options)
    model = LinearModelData(
        name="FLAME",
        format="flame",
        licence=LICENCE,
        triangles=arrays["f"].astype(np.int64),
        template=_real(arrays["v_template"]),
        identity_basis=identity,
        expression_basis=expression,
        joints=_joints(arrays, identity, expression, path),
    )
    check(model, path)
    model = normalized(model, path, Frame(usual_m=1.0), options)
    if options.without_jaw and len(model.joints.names) != 4:  # with four joints it has none
        return model.without_joint("jaw")
    return model


def _from_npz(path: Path) -> dict[str, np.ndarray]:
    present = {name: field for name, field in _OPTIONAL.items() if name in array_names(path)}
    fields = {**_FIELDS, **present}
    schema = NpzSchema(
        title=TITLE, fix=_FIX, fields=fields, indices={"f": "V"}, never_empty="VFJ", max_bytes=_MAX_BYTES
    )
    return schema.read(path, only=tuple(fields))


def _from_pickle(path: Path) -> dict[str, np.ndarray]:
    refuse = partial(InputError.unreadable, TITLE, where=path, fix=_FIX)
    values = read_pickled_arrays(path, refuse)
    arrays = {}
    for name in (*_FIELDS, *(name for name in _OPTIONAL if name in values)):
        if name not in values:
            got = ", ".join(sorted(values)) or "nothing"
            raise refuse(expected=f"the arrays {', '.join(_FIELDS)}", got=f"no {name}, but {got}")
        try:
            arrays[name] = as_array(values[name])
        except ValueError as error:
            raise refuse(expected=f"an array {name}", got=error) from None
    present = {name: field for name, field in (_FIELDS | _OPTIONAL).items() if name in arrays}
    schema = NpzSchema(title=TITLE, fix=_FIX, fields=present, indices={"f": "V"}, never_empty="VFJ")
    if (defect := schema.find_defect(arrays)) is not None:
        raise schema.error(defect, path)
    return arrays


def _bases(arrays: Mapping[str, np.ndarray], path: Path, options: ReadOptions) -> tuple[np.ndarray, np.ndarray]:
    """Identity and expression components, (K, V, 3): deviations are multiplied in by convention."""
    basis = np.moveaxis(_real(arrays["shapedirs"]), 2, 0)
    if "exp_dirs" in arrays:
        return np.ascontiguousarray(basis), np.ascontiguousarray(np.moveaxis(_real(arrays["exp_dirs"]), 2, 0))
    count = options.identity_components
    if count is None and len(basis) == COMPONENTS:
        count = IDENTITIES
    if count is None or not 0 <= count <= len(basis):
        raise InputError(
            "The FLAME model's identity components cannot be told from its expressions",
            where=path,
            expected=f"{COMPONENTS} components, or a stated number of identity components up to their number",
            got=f"{len(basis)} components" + ("" if count is None else f", {count} of them identities"),
            fix="state how many of them are identities",
        )
    return np.ascontiguousarray(basis[:count]), np.ascontiguousarray(basis[count:])


def _joints(arrays: Mapping[str, np.ndarray], identity: np.ndarray, expression: np.ndarray, path: Path) -> Joints:
    regressor = arrays["J_regressor"].astype(np.float64)
    J, V = regressor.shape
    parents, ids = arrays["kintree_table"].astype(np.int64)
    if (ids != np.arange(J)).any():
        expected, got = f"joints from 0 to {J - 1} in the second row", ids.tolist()
        raise InputError("The FLAME model's joints are out of order", where=path, expected=expected, got=got, fix=_FIX)
    # The root's parent is 2^32 - 1, which is -1 in 32 bits.
    parents = np.where((parents < 0) | (parents >= J), -1, parents)
    correctives = None
    if "posedirs" in arrays:
        directions = _real(arrays["posedirs"])
        if directions.shape[2] != 9 * (J - 1):
            expected, got = f"{9 * (J - 1)} pose correctives of {J} joints", directions.shape[2]
            what = "The FLAME model's pose correctives do not belong to its joints"
            raise InputError(what, where=path, expected=expected, got=got, fix=_FIX)
        correctives = np.zeros((9 * J, 3 * V), directions.dtype)  # none follow the root
        correctives[9:] = directions.reshape(3 * V, -1).T
    template = _real(arrays["v_template"])
    weights = _real(arrays["weights"])
    return Joints(
        names=JOINTS.get(J, ("root", *(f"joint_{j}" for j in range(1, J)))),
        parents=parents,
        template=(regressor @ template).astype(template.dtype),
        identity_basis=(regressor @ identity).astype(template.dtype),
        expression_basis=(regressor @ expression).astype(template.dtype),
        weights=weights,
        correctives=correctives,
    )


def _real(array: np.ndarray) -> np.ndarray:
    """Single precision: the published files are double, which doubles memory for steps of a nanometre."""
    return array.astype(np.float32)


def _detect(path: Path) -> bool:
    if {"v_template", "shapedirs"} <= array_names(path):
        return True
    return _PICKLE.match(first_bytes(path)) is not None


FORMAT = ModelFormat(name="flame", title="FLAME (pickle or NPZ)", detect=_detect, read=read)
