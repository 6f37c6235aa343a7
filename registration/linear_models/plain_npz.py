"""The plain form of a linear model: an NPZ file of named arrays (docs/other_models.md)."""

from pathlib import Path
from typing import Any

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import Joints, LinearModelData, check, rigid
from registration.linear_models.frame import Frame, normalized
from registration.linear_models.npz_names import array_names
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.storage.npz import Kind, NpzSchema

_FIX = "write the arrays as docs/other_models.md describes them"
REQUIRED: dict[str, tuple[Kind, str]] = {
    "template": ("float", "V 3"),
    "triangles": ("integer", "F 3"),
    "identity_basis": ("float", "I V 3"),
    "expression_basis": ("float", "E V 3"),
}
OPTIONAL: dict[str, tuple[Kind, str]] = {
    "identity_deviations": ("float", "I"),
    "expression_deviations": ("float", "E"),
    "name": ("text", ""),
    "licence": ("text", ""),
    "unit_m": ("float", ""),
    "up": ("text", ""),
    "front": ("text", ""),
}
JOINTS: dict[str, tuple[Kind, str]] = {  # all or none
    "joint_names": ("text", "J"),
    "joint_parents": ("integer", "J"),
    "joint_template": ("float", "J 3"),
    "skinning_weights": ("float", "V J"),
}
OPTIONAL_OF_JOINTS: dict[str, tuple[Kind, str]] = {
    "joint_identity_basis": ("float", "I J 3"),
    "joint_expression_basis": ("float", "E J 3"),
    "pose_correctives": ("float", "9*J 3*V"),
}
MAX_BYTES = 8 * 2**30
UNSTATED = "not stated by the file"


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read the plain form. Raises InputError: an array is missing, has a wrong type or shape, or wrong values."""
    names = array_names(path)
    jointed = bool(names & (JOINTS.keys() | OPTIONAL_OF_JOINTS.keys()))
    known = {**OPTIONAL, **(OPTIONAL_OF_JOINTS if jointed else {})}
    fields = {
        **REQUIRED,
        **(JOINTS if jointed else {}),
        **{name: field for name, field in known.items() if name in names},
    }
    schema = NpzSchema(
        title="linear model",
        fix=_FIX,
        fields=fields,
        indices={"triangles": "V"},
        never_empty="VF",
        max_bytes=MAX_BYTES,
    )
    arrays = schema.read(path, only=tuple(fields))
    unknown = sorted(names - fields.keys())
    model = LinearModelData(
        name=str(arrays.get("name", path.stem)),
        format="plain",
        licence=f"licence of the file: {arrays.get('licence', UNSTATED)}",
        triangles=arrays["triangles"].astype(np.int64),
        template=_real(arrays["template"]),
        identity_basis=_scaled(arrays, "identity"),
        expression_basis=_scaled(arrays, "expression"),
        joints=_joints(arrays)
        if jointed
        else rigid(*(_scaled(arrays, n) for n in ("template", "identity", "expression"))),
        remarks=(f"arrays that are not used: {', '.join(unknown)}",) if unknown else (),
    )
    check(model, path)
    stated = Frame(
        unit_m=float(arrays["unit_m"]) if "unit_m" in arrays else None,
        up=str(arrays.get("up", "+y")).lower(),
        front=str(arrays.get("front", "+z")).lower(),
    )
    model = normalized(model, path, stated, options)
    if not options.without_jaw:
        return model
    if "jaw" in model.joints.names[1:]:
        return model.without_joint("jaw")
    expected, got = "a joint of the name jaw, not the root", ", ".join(model.joints.names)
    raise InputError("The model has no jaw joint", where=path, expected=expected, got=got, fix="omit the option")


def write(data: LinearModelData, path: Path) -> None:
    """Write a model in the plain form, in metres; `read` gives the same model back, but for groups of vertices."""
    from registration.storage.files import atomic_file

    joints = data.joints
    arrays: dict[str, Any] = {
        "template": data.template,
        "triangles": data.triangles,
        "identity_basis": data.identity_basis,
        "expression_basis": data.expression_basis,
        "name": data.name,
        "licence": data.licence.removeprefix("licence of the file: "),
        "unit_m": 1.0,
        "joint_names": np.array(joints.names),
        "joint_parents": joints.parents,
        "joint_template": joints.template,
        "joint_identity_basis": joints.identity_basis,
        "joint_expression_basis": joints.expression_basis,
        "skinning_weights": joints.weights,
    }
    if joints.correctives is not None:
        arrays["pose_correctives"] = joints.correctives
    with atomic_file(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def _real(array: np.ndarray) -> np.ndarray:
    """At least single precision, as the file has it."""
    return array if array.dtype == np.float64 else array.astype(np.float32)


def _scaled(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    """The template, or a basis times its standard deviations."""
    if name == "template":
        return _real(arrays["template"])
    basis = _real(arrays[f"{name}_basis"])
    deviations = arrays.get(f"{name}_deviations")
    return basis if deviations is None else basis * _real(deviations)[:, None, None].astype(basis.dtype)


def _joints(arrays: dict[str, np.ndarray]) -> Joints:
    """The file's joints; what moves them beside the template is 0 where the file does not say."""
    J = len(arrays["joint_names"])
    moved = {}
    for name in ("identity", "expression"):
        deviations = arrays.get(f"{name}_deviations", np.ones(len(arrays[f"{name}_basis"])))
        basis = arrays.get(f"joint_{name}_basis")
        shape = (len(deviations), J, 3)
        moved[name] = np.zeros(shape, np.float32) if basis is None else _real(basis) * deviations[:, None, None]
    return Joints(
        names=tuple(map(str, arrays["joint_names"])),
        parents=np.maximum(arrays["joint_parents"].astype(np.int64), -1),
        template=_real(arrays["joint_template"]),
        identity_basis=moved["identity"],
        expression_basis=moved["expression"],
        weights=_real(arrays["skinning_weights"]),
        correctives=_real(arrays["pose_correctives"]) if "pose_correctives" in arrays else None,
    )


def _detect(path: Path) -> bool:
    return {"template", "triangles"} <= array_names(path)


FORMAT = ModelFormat(name="plain", title="plain NPZ", detect=_detect, read=read)
