"""The one form of every linear head model: template, two bases in standard deviations, joints with skinning."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError

ROOT = "head"  # the name of the only joint of a model that states none


@dataclass(frozen=True, kw_only=True, eq=False)
class Joints:
    """A kinematic chain and how it moves the vertices. J joints; the root, the first, turns the whole model."""

    names: tuple[str, ...]
    parents: Int[np.ndarray, "J"]  # each before its children; the root's is -1
    template: Float[np.ndarray, "J 3"]  # metres
    identity_basis: Float[np.ndarray, "I J 3"]  # what an identity coefficient of 1 moves the joints by, metres
    expression_basis: Float[np.ndarray, "E J 3"]  # the same of expressions: zeros, but for FLAME
    weights: Float[np.ndarray, "V J"]  # of skinning; rows sum to 1
    correctives: Float[np.ndarray, "9*J 3*V"] | None = None  # times (rotations - 1), row by row: added in the bind pose


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearModelData:
    """A linear model of heads or faces: metres, +Y up, +Z out of the face, +X the subject's left.

    vertices = skin(template + identity @ identity_basis + expression @ expression_basis + correctives). Coefficients
    are in standard deviations: N(0, 1) where the model's file states deviations or has the convention.
    """

    name: str  # "FLAME", "GNM head 3.0"
    format: str  # the reader's name, a key of `registry.FORMATS`
    licence: str  # a sentence: whose terms apply, which are the user's affair
    triangles: Int[np.ndarray, "F 3"]
    template: Float[np.ndarray, "V 3"]
    identity_basis: Float[np.ndarray, "I V 3"]
    expression_basis: Float[np.ndarray, "E V 3"]
    joints: Joints
    unit_m: float = 1.0  # metres per unit of the file, which all arrays here were multiplied by
    remarks: tuple[str, ...] = ()  # what a user should know of how the file was read
    groups: Mapping[str, Bool[np.ndarray, "V"]] = field(
        default_factory=dict
    )  # named sets of vertices, if the file has any

    def truncated(self, identity: int | None = None, expression: int | None = None) -> "LinearModelData":
        """Return the model with the first components only; None: all."""
        joints = replace(
            self.joints,
            identity_basis=self.joints.identity_basis[:identity],
            expression_basis=self.joints.expression_basis[:expression],
        )
        return replace(
            self,
            identity_basis=self.identity_basis[:identity],
            expression_basis=self.expression_basis[:expression],
            joints=joints,
        )

    def without_joint(self, name: str) -> "LinearModelData":
        """Return the model without a joint: what it moved follows its parent, and its pose correctives are dropped.

        Args:
            name: of the joint; its children become its parent's.

        Raises:
            InputError: the model has no such joint, or it is the root.
        """
        joints = self.joints
        if name not in joints.names[1:]:
            expected, got = f"a joint of {', '.join(joints.names[1:]) or 'none'}", name
            fix = "keep all joints of this model"
            raise InputError("The model has no such joint", where=self.name, expected=expected, got=got, fix=fix)
        j = joints.names.index(name)
        parent, kept = int(joints.parents[j]), np.arange(len(joints.names)) != j
        parents = np.where(joints.parents == j, parent, joints.parents)
        weights = joints.weights.copy()
        weights[:, parent] += weights[:, j]
        correctives = joints.correctives
        reduced = replace(
            joints,
            names=tuple(n for n in joints.names if n != name),
            parents=(parents - (parents > j))[kept],
            template=joints.template[kept],
            identity_basis=joints.identity_basis[:, kept],
            expression_basis=joints.expression_basis[:, kept],
            weights=weights[:, kept],
            correctives=None if correctives is None else correctives[np.repeat(kept, 9)],
        )
        return replace(self, joints=reduced)


def rigid(
    template: Float[np.ndarray, "V 3"], identity: Float[np.ndarray, "I V 3"], expression: Float[np.ndarray, "E V 3"]
) -> Joints:
    """Return the chain of a model without joints: one, at the template's centre, that turns everything."""
    return Joints(
        names=(ROOT,),
        parents=np.array([-1]),
        template=template.mean(0, keepdims=True),
        identity_basis=np.zeros((len(identity), 1, 3), template.dtype),
        expression_basis=np.zeros((len(expression), 1, 3), template.dtype),
        weights=np.ones((len(template), 1), template.dtype),
    )


def check(data: LinearModelData, where: object) -> None:
    """Refuse a model whose arrays do not belong together; readers call it last.

    Args:
        data: the model.
        where: its file, for the message.

    Raises:
        InputError: a shape differs from the others', a number is not finite, an index is out of range, a parent is not
            before its child, or a vertex has no positive weight.
    """

    def refuse(name: str, expected: object, got: object) -> InputError:
        what = f"The linear model's {name} cannot be used"
        return InputError(what, where=where, expected=expected, got=got, fix="use the model's file as it was published")

    joints = data.joints
    V, J = len(data.template), len(joints.names)
    identity, expression = len(data.identity_basis), len(data.expression_basis)
    if V == 0 or len(data.triangles) == 0 or J == 0:
        raise refuse("mesh", "vertices, triangles and a joint", f"{V}, {len(data.triangles)} and {J}")
    shapes: tuple[tuple[str, np.ndarray, tuple[int, ...]], ...] = (
        ("template", data.template, (V, 3)),
        ("identity basis", data.identity_basis, (identity, V, 3)),
        ("expression basis", data.expression_basis, (expression, V, 3)),
        ("triangles", data.triangles, (len(data.triangles), 3)),
        ("joints", joints.template, (J, 3)),
        ("joints' parents", joints.parents, (J,)),
        ("joints' identity basis", joints.identity_basis, (identity, J, 3)),
        ("joints' expression basis", joints.expression_basis, (expression, J, 3)),
        ("skinning weights", joints.weights, (V, J)),
        *([("pose correctives", joints.correctives, (9 * J, 3 * V))] if joints.correctives is not None else []),
    )
    for name, array, shape in shapes:
        if array.shape != shape:
            raise refuse(name, f"the shape {shape}", array.shape)
        if not np.isfinite(array).all():
            raise refuse(name, "finite numbers", f"{(~np.isfinite(array)).sum()} NaN or infinite")
    if data.triangles.min() < 0 or data.triangles.max() >= V:
        got = f"{data.triangles.min()} to {data.triangles.max()}"
        raise refuse("triangles", f"indices from 0 to {V - 1}", got)
    if joints.parents[0] >= 0 or (joints.parents[1:] < 0).any() or (joints.parents[1:] >= np.arange(1, J)).any():
        raise refuse("joints", "one root, first, and every parent before its children", joints.parents.tolist())
    sums = joints.weights.sum(1)
    if joints.weights.min() < -1e-6 or np.abs(sums - 1).max() > 1e-3:
        got = f"weights from {joints.weights.min():.3g}, sums from {sums.min():.3g} to {sums.max():.3g}"
        raise refuse("skinning weights", "weights >= 0 that sum to 1 at every vertex", got)
