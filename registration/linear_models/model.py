"""A linear model in torch: parameters -> posed vertices, batched and differentiable, with exact derivatives."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.frames import axis_angle_to_matrix
from registration.linear_models.data import LinearModelData
from registration.model.skinning import skin
from registration.types import Parameters


@dataclass(frozen=True, kw_only=True, eq=False)
class Affine:
    """The vertices for fixed rotations, scale 1 and no translation: constant + identity @ ... + expression @ ...

    It is exact: with fixed rotations a posed vertex is an affine function of the coefficients, joints included.
    """

    constant: Float[Tensor, "V 3"]  # metres
    identity: Float[Tensor, "I V 3"]
    expression: Float[Tensor, "E V 3"]

    def vertices(self, identity: Float[Tensor, "*B I"], expression: Float[Tensor, "*B E"]) -> Float[Tensor, "*B V 3"]:
        """Return the vertices of coefficients, metres."""
        moved = identity @ self.identity.flatten(1) + expression @ self.expression.flatten(1)
        return self.constant + moved.unflatten(-1, (-1, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class Derivatives:
    """Posed vertices, and what each parameter moves them by, at one set of parameters. Metres, world."""

    vertices: Float[Tensor, "V 3"]
    identity: Float[Tensor, "I V 3"]  # per unit of a coefficient
    expression: Float[Tensor, "E V 3"]
    rotations: Float[Tensor, "J 3 V 3"]  # per radian of a joint's axis-angle component
    scale: Float[Tensor, "V 3"]  # per unit of scale; the translation's is the unit matrix at every vertex


class LinearModel(torch.nn.Module):
    """A linear model that evaluates on one device, in one floating-point type.

    V vertices, I identity, E expression, J joints, *B any batch axes. Metres and radians, the model's frame. The
    parameters are those of GNM (`registration.types.Parameters`); of a GNM file it is the same function.
    """

    template: Float[Tensor, "3*V"]
    identity_basis: Float[Tensor, "I 3*V"]
    expression_basis: Float[Tensor, "E 3*V"]
    joint_template: Float[Tensor, "3*J"]
    joint_identity: Float[Tensor, "I 3*J"]
    joint_expression: Float[Tensor, "E 3*J"]
    weights: Float[Tensor, "V J"]
    correctives: Float[Tensor, "9*J 3*V"] | None
    triangles: Int[Tensor, "F 3"]

    def __init__(
        self, data: LinearModelData, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__()
        joints = data.joints

        def register(name: str, array: np.ndarray | None, *shape: int) -> None:
            tensor = None if array is None else torch.tensor(array).reshape(shape).to(device, dtype)
            self.register_buffer(name, tensor, persistent=False)

        V, J = joints.weights.shape
        register("template", data.template, 3 * V)
        register("identity_basis", data.identity_basis, len(data.identity_basis), 3 * V)
        register("expression_basis", data.expression_basis, len(data.expression_basis), 3 * V)
        register("joint_template", joints.template, 3 * J)
        register("joint_identity", joints.identity_basis, len(data.identity_basis), 3 * J)
        register("joint_expression", joints.expression_basis, len(data.expression_basis), 3 * J)
        weights = joints.weights.astype(np.float64)
        register("weights", weights / weights.sum(1, keepdims=True), V, J)
        used = joints.correctives is not None and joints.correctives.any()
        register("correctives", joints.correctives if used else None, 9 * J, 3 * V)
        triangles = torch.from_numpy(data.triangles.astype(np.int64)).to(device)
        self.register_buffer("triangles", triangles, persistent=False)
        self.parents: list[int] = joints.parents.tolist()
        self.joint_names = joints.names

    def neutral(self, *batch: int) -> Parameters:
        """All parameters at rest: zeros, and scale one."""
        zeros = self.template.new_zeros
        return Parameters(
            identity=zeros(*batch, len(self.identity_basis)),
            expression=zeros(*batch, len(self.expression_basis)),
            rotations=zeros(*batch, len(self.parents), 3),
            translation=zeros(*batch, 3),
            scale=self.template.new_ones(batch),
        )

    def forward(self, parameters: Parameters) -> Float[Tensor, "*B V 3"]:
        """Return posed vertices, metres, world: scale * skin(bind + correctives) + translation."""
        p = parameters
        posed = self.pose(
            self.bind(p.identity, p.expression),
            self.joints(p.identity, p.expression),
            axis_angle_to_matrix(p.rotations),
        )
        return p.scale[..., None, None] * posed + p.translation[..., None, :]

    def bind(self, identity: Float[Tensor, "*B I"], expression: Float[Tensor, "*B E"]) -> Float[Tensor, "*B V 3"]:
        """Return the bind pose, without pose correctives: what a rotation-free model is, metres."""
        flat = self.template + identity @ self.identity_basis + expression @ self.expression_basis
        return flat.unflatten(-1, (-1, 3))

    def joints(self, identity: Float[Tensor, "*B I"], expression: Float[Tensor, "*B E"]) -> Float[Tensor, "*B J 3"]:
        """Return the joints' positions in the bind pose, metres."""
        flat = self.joint_template + identity @ self.joint_identity + expression @ self.joint_expression
        return flat.unflatten(-1, (-1, 3))

    def pose(
        self, bind: Float[Tensor, "*B V 3"], joints: Float[Tensor, "*C J 3"], rotations: Float[Tensor, "*D J 3 3"]
    ) -> Float[Tensor, "*E V 3"]:
        """Add pose correctives to the bind pose and skin it; rotations are relative to the joints' parents."""
        if self.correctives is not None:
            feature = rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
            bind = bind + (feature.flatten(-3) @ self.correctives).unflatten(-1, (-1, 3))
        return skin(bind, joints, rotations, weights=self.weights, parents=self.parents)

    def affine(self, rotations: Float[Tensor, "J 3"]) -> Affine:
        """Return the exact affine map from coefficients to vertices for fixed rotations, axis-angle.

        A fit in correspondence is then a linear least-squares problem. The map takes the memory of the bases again.
        """
        R = axis_angle_to_matrix(rotations)
        constant = self.pose(self.template.unflatten(-1, (-1, 3)), self.joint_template.unflatten(-1, (-1, 3)), R)
        bases = []
        for basis, joints in (
            (self.identity_basis, self.joint_identity),
            (self.expression_basis, self.joint_expression),
        ):
            moved = (basis.unflatten(-1, (-1, 3)), joints.unflatten(-1, (-1, 3)))
            # Skinning is linear in the bind pose and the joints together, so that it skins displacements too.
            bases.append(skin(*moved, R, weights=self.weights, parents=self.parents) if len(basis) else moved[0])
        return Affine(constant=constant, identity=bases[0], expression=bases[1])

    def derivatives(self, parameters: Parameters) -> Derivatives:
        """Return vertices and their exact derivatives by all parameters, of one sample, not a batch.

        Those by coefficients come from `affine`, those by rotations from forward-mode differentiation.
        """
        p = parameters
        affine = self.affine(p.rotations)
        posed = affine.vertices(p.identity, p.expression)
        bind, joints = self.bind(p.identity, p.expression), self.joints(p.identity, p.expression)

        def turned(rotations: Tensor) -> Tensor:
            return self.pose(bind, joints, axis_angle_to_matrix(rotations))

        by_rotation = torch.func.jacfwd(turned)(p.rotations)  # V 3 J 3
        return Derivatives(
            vertices=p.scale * posed + p.translation,
            identity=p.scale * affine.identity,
            expression=p.scale * affine.expression,
            rotations=p.scale * by_rotation.permute(2, 3, 0, 1),
            scale=posed,
        )
