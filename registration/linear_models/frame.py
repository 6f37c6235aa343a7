"""From a file's unit and axes to metres, +Y up and +Z out of the face."""

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.linear_models.data import LinearModelData
from registration.linear_models.options import Axis, ReadOptions

UNITS_M = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
_HEIGHT_M = (0.13, 1.2)  # of a face without forehead, to a head with the upper body
_TRIED = ("m", "cm", "mm", "um")
_MIRROR_RATIO = 3.0  # by which another axis must be the better one across, before a remark says so
_SAMPLED = 2000  # vertices


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A format's convention."""

    unit_m: float | None = None  # stated by the file
    usual_m: float | None = None  # of the format's files, unless the template's size says another
    up: str = "+y"  # an Axis; `turn` refuses others
    front: str = "+z"


def normalized(data: LinearModelData, where: object, convention: Frame, options: ReadOptions) -> LinearModelData:
    """Return the model in metres, +Y up, +Z out of the face.

    Args:
        data: the model as its file has it.
        where: the file, for messages.
        convention: of the format or stated by the file.
        options: override the convention.

    Raises:
        InputError: no unit makes the template as large as a head, or the axes are the same one.
    """
    unit = options.unit_m if options.unit_m is not None else convention.unit_m
    remarks = list(data.remarks)
    if unit is None:
        unit, name = _unit_of_size(data.template, where)
        if unit != convention.usual_m:
            long = _longest(data.template) * unit * 1e3
            remarks.append(f"the unit is taken as {name}: the template is {long:.0f} mm long")
    elif not 0 < unit < np.inf:
        raise InputError(
            "The model's unit cannot be used",
            where=where,
            expected="metres per unit of the file, above 0",
            got=unit,
            fix=f"give one of {', '.join(f'{m:g}' for m in UNITS_M.values())}",
        )
    rotation = turn(options.up or convention.up, options.front or convention.front)
    if (remark := _mirror_remark(data.template @ rotation.T)) is not None:
        remarks.append(remark)
    scaled = (unit * rotation).astype(np.float64)

    def moved(array: np.ndarray) -> np.ndarray:
        return (array @ scaled.T.astype(array.dtype)) if unit != 1 or (rotation != np.eye(3)).any() else array

    joints = data.joints
    correctives = joints.correctives
    if correctives is not None and (rotation != np.eye(3)).any():
        # A rotation in the file's axes is turn^T R turn in ours, so that the rows mix as well as the columns.
        feature = np.kron(rotation, rotation)
        correctives = np.einsum("ab,jbc->jac", feature, correctives.reshape(-1, 9, correctives.shape[1]))
        correctives = correctives.reshape(-1, correctives.shape[-1])
    if correctives is not None:
        correctives = moved(correctives.reshape(len(correctives), -1, 3)).reshape(len(correctives), -1)
    template, triangles = moved(data.template), data.triangles
    if _volume(template, triangles) < 0:
        triangles = triangles[:, ::-1]
        remarks.append("the triangles are turned round: they faced inwards")
    return replace(
        data,
        triangles=triangles,
        template=template,
        identity_basis=moved(data.identity_basis),
        expression_basis=moved(data.expression_basis),
        joints=replace(
            joints,
            template=moved(joints.template),
            identity_basis=moved(joints.identity_basis),
            expression_basis=moved(joints.expression_basis),
            correctives=correctives,
        ),
        unit_m=data.unit_m * unit,
        remarks=tuple(remarks),
    )


def turn(up: str, front: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from axes of these directions to +Y up, +Z out of the face.

    Raises:
        InputError: an axis has no such name, or both lie on one line.
    """
    vectors = {}
    for role, name in (("up", up), ("front", front)):
        if name not in get_args(Axis):
            raise _axes_error(f"the {role} axis {name}")
        vectors[role] = (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[1])]
    if abs(vectors["up"] @ vectors["front"]) > 0:
        raise _axes_error(f"{up} up and {front} to the front")
    return np.stack([np.cross(vectors["up"], vectors["front"]), vectors["up"], vectors["front"]])


def _axes_error(got: str) -> InputError:
    expected = "two different axes of +x, -x, +y, -y, +z, -z"
    return InputError(
        "The model's axes cannot be used", where="axes", expected=expected, got=got, fix="name two of them"
    )


def _volume(template: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> float:
    """Between the surface and its centre: positive if triangles face outwards, of closed heads and open faces alike."""
    corners = (template - template.mean(0)).astype(np.float64)[triangles]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))


def _longest(template: Float[np.ndarray, "V 3"]) -> float:
    return float(np.ptp(template, axis=0).max())


def _unit_of_size(template: Float[np.ndarray, "V 3"], where: object) -> tuple[float, str]:
    longest = _longest(template)
    for name in _TRIED:
        if _HEIGHT_M[0] <= longest * UNITS_M[name] < _HEIGHT_M[1]:
            return UNITS_M[name], name
    raise InputError(
        "The unit of the linear model cannot be told",
        where=where,
        expected=f"a template of {_HEIGHT_M[0]:g} to {_HEIGHT_M[1]:g} m in {', '.join(_TRIED)}",
        got=f"{longest:g} units along its longest side",
        fix="give the unit in metres",
    )


def _mirror_remark(template: Float[np.ndarray, "V 3"]) -> str | None:
    """Heads are symmetric across X: a remark if another axis is clearly the better one."""
    from scipy.spatial import cKDTree

    sampled = template[:: max(1, len(template) // _SAMPLED)].astype(np.float64)
    tree = cKDTree(template)
    errors = []
    for axis in range(3):
        mirrored = sampled.copy()
        mirrored[:, axis] = template[:, axis].min() + template[:, axis].max() - mirrored[:, axis]
        errors.append(float(np.median(tree.query(mirrored)[0])))
    best = int(np.argmin(errors))
    if best == 0 or errors[0] < _MIRROR_RATIO * errors[best]:
        return None
    return f"the template is symmetric across its {'XYZ'[best]} axis, not across X: check the axes `up` and `front`"
