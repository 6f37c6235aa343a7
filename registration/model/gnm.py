"""The GNM function in torch [GNM, Model Formulation]: parameters -> posed vertices, batched and differentiable.

`gnm_numpy.py` is the reference implementation.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.frames import axis_angle_to_matrix
from registration.model import skinning
from registration.model.gnm_npz import GNMData
from registration.types import Parameters


class GNM(torch.nn.Module):
    """A head model that evaluates the GNM function on one device, in one floating-point type.

    V vertices, I identity, E expression, J joints, *B any batch axes. Metres and radians, the model's frame.
    """

    template: Float[Tensor, "3*V"]
    identity_basis: Float[Tensor, "I 3*V"]
    expression_basis: Float[Tensor, "E 3*V"]
    joint_template: Float[Tensor, "3*J"]
    joint_basis: Float[Tensor, "I 3*J"]
    weights: Float[Tensor, "V J"]
    corrective_basis: Float[Tensor, "9*J 3*V"] | None
    triangles: Int[Tensor, "F 3"]

    def __init__(self, data: GNMData, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"):
        super().__init__()
        joints, vertices = data.skinning_weights.shape

        def register(name: str, array: np.ndarray | None, *shape: int) -> None:
            tensor = None if array is None else torch.from_numpy(np.ascontiguousarray(array)).reshape(shape)
            self.register_buffer(name, None if tensor is None else tensor.to(device, dtype), persistent=False)

        register("template", data.template_vertex_positions, 3 * vertices)
        register("identity_basis", data.vertex_identity_basis, -1, 3 * vertices)
        register("expression_basis", data.expression_basis, -1, 3 * vertices)
        register("joint_template", data.template_joint_positions, 3 * joints)
        register("joint_basis", data.joint_identity_basis, -1, 3 * joints)
        # The inverse homogeneous map [GNM, Model Formulation] divides by the sum of a vertex' weights.
        weights = data.skinning_weights.astype(np.float64)
        register("weights", (weights / weights.sum(0)).T, vertices, joints)
        # Released models have zeros here; multiplying by them would take a tenth of the time of the bases.
        correctives = data.pose_correctives_regressor
        register("corrective_basis", correctives if correctives.any() else None, 9 * joints, 3 * vertices)
        triangles = torch.from_numpy(data.triangles.astype(np.int64)).to(device)
        self.register_buffer("triangles", triangles, persistent=False)
        self.parents: list[int] = data.joint_parent_indices.tolist()

    def neutral(self, *batch: int) -> Parameters:
        """All parameters at rest: zeros, and scale one."""
        shapes = {"identity": len(self.identity_basis), "expression": len(self.expression_basis), "translation": 3}
        zeros = {name: self.template.new_zeros(*batch, size) for name, size in shapes.items()}
        rotations = self.template.new_zeros(*batch, len(self.parents), 3)
        return Parameters(**zeros, rotations=rotations, scale=self.template.new_ones(batch))

    def forward(
        self, parameters: Parameters, offsets: Float[Tensor, "*C V 3"] | None = None
    ) -> Float[Tensor, "*B V 3"]:
        """Return posed vertices, metres, world: scale * LBS(bind + correctives + offsets) + translation.

        Args:
            parameters: of one sample or a batch.
            offsets: added in the bind pose, metres; broadcast over the batch.
        """
        bind = self.bind(parameters.identity, parameters.expression)
        if offsets is not None:
            bind = bind + offsets
        posed = self.pose(bind, self.joints(parameters.identity), axis_angle_to_matrix(parameters.rotations))
        return parameters.scale[..., None, None] * posed + parameters.translation[..., None, :]

    def pose(
        self, bind: Float[Tensor, "*B V 3"], joints: Float[Tensor, "*C J 3"], rotations: Float[Tensor, "*D J 3 3"]
    ) -> Float[Tensor, "*E V 3"]:
        """Add pose correctives to the bind pose and skin it; rotations are relative to the joints' parents."""
        if self.corrective_basis is not None:
            bind = bind + self.correctives(rotations)
        return self.skin(bind, joints, rotations)

    def bind(self, identity: Float[Tensor, "*B I"], expression: Float[Tensor, "*B E"]) -> Float[Tensor, "*B V 3"]:
        """Return the bind pose: template plus both bases [GNM, Model Formulation], without pose correctives."""
        flat = self.template + identity @ self.identity_basis + expression @ self.expression_basis
        return flat.unflatten(-1, (-1, 3))

    def joints(self, identity: Float[Tensor, "*B I"]) -> Float[Tensor, "*B J 3"]:
        """Return the joint positions in the bind pose, metres."""
        return (self.joint_template + identity @ self.joint_basis).unflatten(-1, (-1, 3))

    def correctives(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B V 3"]:
        """Return the pose correctives of rotations in the bind pose; in the released file, not in [GNM]."""
        if self.corrective_basis is None:
            return self.template.new_zeros(*rotations.shape[:-3], *self.weights.shape[:1], 3)
        feature = rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        return (feature.flatten(-3) @ self.corrective_basis).unflatten(-1, (-1, 3))

    def skin(
        self, bind: Float[Tensor, "*B V 3"], joints: Float[Tensor, "*C J 3"], rotations: Float[Tensor, "*D J 3 3"]
    ) -> Float[Tensor, "*E V 3"]:
        """Apply linear blend skinning along the kinematic chain; batch axes broadcast."""
        return skinning.skin(bind, joints, rotations, weights=self.weights, parents=self.parents)
