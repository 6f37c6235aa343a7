"""The variables of a fit, and the mesh they describe."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.anatomy.own_parts import OwnParts
from registration.frames import axis_angle_to_matrix, matrix_to_axis_angle
from registration.geometry.large_steps import LargeSteps
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group, neck_other
from registration.types import Parameters


@dataclass(frozen=True, kw_only=True)
class InitialGuess:
    """Values of the variables before the first step.

    The pose places the model's pivot (the centre of its exterior) at `position`, rotated and scaled about it.
    """

    rotation: Float[np.ndarray, "3 3"]  # of the whole head, world from model
    position: Float[np.ndarray, "3"]  # world, metres
    scale: float = 1.0
    identity: Float[np.ndarray, "I"] | None = None
    expression: Float[np.ndarray, "E"] | None = None
    joints: Float[np.ndarray, "C 3"] | None = None  # rotations of all joints but the root, axis-angle
    offsets: Float[np.ndarray, "V 3"] | None = None  # bind pose, metres
    landmarks_used: Mapping[str, Bool[np.ndarray, "L"]] = field(default_factory=dict)  # scheme -> without outliers
    notes: tuple[str, ...] = ()  # for the user: how the guess was estimated


class Latent:
    """Offsets in the coordinates of large steps (Nicolet 2021): u = M d, so that steps on u change d smoothly.

    It exists while a stage optimizes the offsets d.
    """

    def __init__(self, steps: LargeSteps, offsets: Float[Tensor, "S 3"]):
        self._steps = steps
        self.tensor: Float[Tensor, "S 3"] = steps.latent(offsets).requires_grad_(True)

    def offsets(self) -> Float[Tensor, "S 3"]:
        """Return d = M^-1 u, bind pose, metres; differentiable."""
        return self._steps.displacement(self.tensor)


class Variables:
    """Tensors by name, and the free offsets of the skin. A stage frees some; the mesh is differentiable in those.

    The names: identity (I) and expression (E) coefficients; root (3), joints (C 3), axis-angle rotations; position (3),
    of the pivot in the world, metres; scale, its logarithm; eyes (2 4), of each eyeball a translation in the bind pose,
    metres, and the logarithm of a scale about its centre; parts (C), added to the identity coefficients that move
    no skin and to the placements of the dental arches (`anatomy.own_parts`): teeth and eyes, which an expression may
    show better than the neutral that its identity comes from.

    The root rotates by a small rotation times a constant one, and the position is that of the pivot: in these
    coordinates rotation and translation are independent, and no rotation is near the singularity of the axis-angle
    representation. Eyeballs keep their shape.
    """

    def __init__(self, model: GNM, data: GNMData, initial: InitialGuess):
        device, count = model.template.device, len(data.template_vertex_positions)

        def tensor(value: Any, *shape: int) -> Tensor:
            value = np.zeros(shape) if value is None else np.array(value)
            return torch.tensor(value, dtype=torch.float32, device=device).reshape(shape)

        self.model = model
        self.pivot = tensor(pivot(data), 3)
        self.base_rotation = tensor(initial.rotation, 3, 3)
        self.skin = skin_vertices(data)
        self._skin = torch.as_tensor(self.skin, device=device)
        eyes = [np.flatnonzero(group(data, name) > 0.5) for name in ("left_eye", "right_eye")]
        self._eyes = [torch.as_tensor(index, device=device) for index in eyes]
        self.tensors = {
            "identity": tensor(initial.identity, len(model.identity_basis)),
            "expression": tensor(initial.expression, len(model.expression_basis)),
            "root": tensor(None, 3),
            "joints": tensor(initial.joints, len(model.parents) - 1, 3),
            "position": tensor(initial.position, 3),
            "scale": tensor(np.log(initial.scale)),
            "eyes": tensor(None, 2, 4),
        }
        own = OwnParts.of(data)
        self._own_parts = torch.as_tensor(own.components, device=device)
        self._part_vertices = torch.as_tensor(own.vertices, device=device)
        self._part_basis = tensor(own.basis, *own.basis.shape)
        self.tensors["parts"] = tensor(None, len(own.basis))
        self.fixed_offsets = tensor(initial.offsets, count, 3)  # of all vertices but the skin's
        self._offsets = self.fixed_offsets[self._skin]  # of the skin, unless there is a latent
        self.fixed_offsets[self._skin] = 0
        self.reference_offsets = self._offsets.clone()  # where the penalties of the offsets are zero
        outside = torch.as_tensor(np.flatnonzero(exterior(data)), device=device)
        visible = model.expression_basis.unflatten(-1, (-1, 3)).index_select(1, outside)
        self._inner = (visible == 0).all(-1).all(-1)  # expression components that do not move the outer skin
        self.latent: Latent | None = None
        self._fixed_bind_pose: tuple[Tensor, Tensor] | None = None  # while identity and expression are fixed

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    def set_free(self, names: Collection[str], steps: LargeSteps | None = None) -> None:
        """Start a stage: let exactly these variables require gradients.

        Args:
            names: of `tensors`, and "offsets".
            steps: the preconditioner of the offsets if they are among the names: `latent` then replaces them until
                `commit_latent`.
        """
        for tensor in self.tensors.values():
            tensor.requires_grad_(False)
        self.commit_latent()
        if "offsets" in names:
            assert steps is not None
            self.latent = Latent(steps, self._offsets)
        if not {"identity", "expression"} & set(names):
            with torch.no_grad():
                self._fixed_bind_pose = self._bind_pose(self.tensors)
        for name in names:
            if name != "offsets":
                self.tensors[name].requires_grad_(True)

    @torch.no_grad()
    def commit_latent(self) -> None:
        """End a stage: keep the offsets that the latent has reached."""
        self._offsets = self.skin_offsets().detach()
        self.latent = self._fixed_bind_pose = None

    def skin_offsets(self) -> Float[Tensor, "S 3"]:
        """Return the free offsets of the skin's vertices, bind pose, metres."""
        return self._offsets if self.latent is None else self.latent.offsets()

    def rotation(self) -> Float[Tensor, "3 3"]:
        """Return the rotation of the whole head, world from model."""
        return axis_angle_to_matrix(self.tensors["root"]) @ self.base_rotation

    def vertices(self, skin_offsets: Float[Tensor, "S 3"]) -> Float[Tensor, "V 3"]:
        """Return the mesh in the capture's world, metres."""
        return self._posed(skin_offsets, self.tensors)

    def contact_vertices(self, skin_offsets: Float[Tensor, "S 3"]) -> Float[Tensor, "V 3"]:
        """Return the same mesh, differentiable only in the offsets and the coefficients of the tongue.

        Identity, pose and eyeballs are detached: images determine them, and contacts between parts must not.
        """
        detached = {name: tensor.detach() for name, tensor in self.tensors.items()}
        detached["expression"] = torch.where(self._inner, self.tensors["expression"], detached["expression"])
        return self._posed(skin_offsets, detached)

    @torch.no_grad()
    def bind_pose_vertices(self) -> Float[Tensor, "V 3"]:
        """Return the model's head of this identity with a neutral expression and no offsets, model frame, metres."""
        return self.model.bind(self.identity(), torch.zeros_like(self.tensors["expression"]))

    def identity(self) -> Float[Tensor, "I"]:
        """Return the identity coefficients with the own parts'."""
        return self.tensors["identity"].index_add(0, self._own_parts, self.tensors["parts"][: len(self._own_parts)])

    @property
    def has_parts(self) -> bool:
        """Whether the model has identity components that move no skin."""
        return len(self.tensors["parts"]) > 0

    def part_coefficients(self) -> Float[Tensor, "C"]:
        """Return the identity coefficients of the components that move no skin, and the placements' since the start."""
        parts, count = self.tensors["parts"], len(self._own_parts)
        return torch.cat([self.tensors["identity"][self._own_parts] + parts[:count], parts[count:]])

    @torch.no_grad()
    def expression_vertices(self) -> Float[Tensor, "V 3"]:
        """Return the displacements that the expression alone gives the head at rest, metric size, metres."""
        bind, _ = self._bind_pose(self.tensors)
        return self.tensors["scale"].exp() * (bind - self.bind_pose_vertices())

    @torch.no_grad()
    def move_skin(self, displacement: Float[np.ndarray, "V 3"]) -> None:
        """Displace the skin of the posed mesh, between two stages; world, metres. Its offsets take up the motion."""
        assert self.latent is None
        posed, unit = self.vertices(self._offsets), torch.eye(3, device=self._offsets.device)
        # Posing is linear in the offsets of each vertex.
        axes = torch.stack([self.vertices(self._offsets + axis)[self._skin] - posed[self._skin] for axis in unit], -1)
        moved = torch.as_tensor(displacement[self.skin], dtype=self._offsets.dtype, device=self._offsets.device)
        self._offsets = self._offsets + torch.linalg.solve(axes, moved)

    @torch.no_grad()
    def parameters(self) -> tuple[Parameters, Float[Tensor, "V 3"]]:
        """Return the model's parameters and offsets (bind pose, metres) that give the same mesh."""
        rotation, scale = self.rotation(), self.tensors["scale"].exp()
        bind, joints = self._bind_pose(self.tensors)
        bind = self._with_parts(bind, self.tensors["parts"])
        root = matrix_to_axis_angle(rotation.double().cpu().numpy())
        rotations = torch.cat([torch.tensor(root, dtype=torch.float32, device=rotation.device)[None], self["joints"]])
        # The model rotates about its root joint, the variables about the pivot.
        translation = self["position"] - scale * (rotation @ (self.pivot - joints[0]) + joints[0])
        parameters = Parameters(
            identity=self.identity().detach().clone(),
            expression=self["expression"].detach().clone(),
            rotations=rotations,
            translation=translation,
            scale=scale,
        )
        offsets = self._all_offsets(self.skin_offsets(), bind, self["eyes"])
        count = len(self._own_parts)
        placed = torch.tensordot(self["parts"][count:], self._part_basis[count:], 1)
        return parameters, offsets.index_add(0, self._part_vertices, placed)

    def _bind_pose(self, tensors: Mapping[str, Tensor]) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "J 3"]]:
        """Vertices without offsets and without the own parts, and joints."""
        identity = tensors["identity"]
        return self.model.bind(identity, tensors["expression"]), self.model.joints(identity)

    def _with_parts(self, bind: Float[Tensor, "V 3"], parts: Float[Tensor, "C"]) -> Float[Tensor, "V 3"]:
        return bind.index_add(0, self._part_vertices, torch.tensordot(parts, self._part_basis, 1))

    def _all_offsets(self, skin_offsets: Tensor, bind: Tensor, eyes: Tensor) -> Float[Tensor, "V 3"]:
        """Offsets of all vertices in the bind pose: the skin's, and the motion of the eyeballs."""
        offsets = self.fixed_offsets.index_add(0, self._skin, skin_offsets)
        for motion, index in zip(eyes, self._eyes, strict=True):
            eyeball = bind[index]
            scaled = torch.expm1(motion[3]) * (eyeball - eyeball.mean(0).detach())
            offsets = offsets.index_add(0, index, motion[:3] + scaled)
        return offsets

    def _posed(self, skin_offsets: Tensor, tensors: Mapping[str, Tensor]) -> Float[Tensor, "V 3"]:
        bind, joints = self._fixed_bind_pose or self._bind_pose(tensors)
        bind = self._with_parts(bind, tensors["parts"])
        bind = bind + self._all_offsets(skin_offsets, bind, tensors["eyes"])
        root = axis_angle_to_matrix(tensors["root"]) @ self.base_rotation
        local = torch.cat([root[None], axis_angle_to_matrix(tensors["joints"])])
        # The root joint rotates the head about itself; then the pivot, rotated likewise, is moved to its position.
        pivot = root @ (self.pivot - joints[0]) + joints[0]
        return tensors["scale"].exp() * (self.model.pose(bind, joints, local) - pivot) + tensors["position"]


def pivot(data: GNMData) -> Float[np.ndarray, "3"]:
    """Return the point of the model at `InitialGuess.position`: the centre of the head without neck and chest, metres.

    Raises:
        InputError: the model lacks a vertex group.
    """
    head = (group(data, "skin_exterior") > 0.5) & ~neck_other(data)
    points = data.template_vertex_positions[head]
    return (points.min(0) + points.max(0)) / 2


def initial_guess_from(
    parameters: Parameters, offsets: Float[np.ndarray, "V 3"], model: GNM, data: GNMData
) -> InitialGuess:
    """Return the initial guess whose mesh is that of a registration, such as the subject's neutral.

    Args:
        parameters: of the registration, without batch axes.
        offsets: of the registration, bind pose, metres.
        model: the registration's, as a function.
        data: the same model's arrays.
    """
    rotation = axis_angle_to_matrix(parameters.rotations[0].double()).cpu().numpy()
    joints = model.joints(parameters.identity)[0].double().cpu().numpy()
    scale = float(parameters.scale)
    centre = pivot(data)
    position = parameters.translation.double().cpu().numpy() + scale * (rotation @ (centre - joints) + joints)
    return InitialGuess(
        rotation=rotation,
        position=position,
        scale=scale,
        identity=parameters.identity.cpu().numpy(),
        expression=parameters.expression.cpu().numpy(),
        joints=parameters.rotations[1:].cpu().numpy(),
        offsets=offsets,
    )


def skin_vertices(data: GNMData) -> Int[np.ndarray, "S"]:
    """Return the vertices that carry free offsets: all of the skin, its inner surfaces included."""
    return np.flatnonzero(group(data, "skin") > 0.5)


def skin_triangles(
    triangles: Int[np.ndarray, "F 3"], skin: Int[np.ndarray, "S"], vertex_count: int
) -> Int[np.ndarray, "G 3"]:
    """Return the triangles whose corners all belong to the skin, as indices into `skin`."""
    row = np.full(vertex_count, -1)
    row[skin] = np.arange(len(skin))
    corners = row[triangles]
    return corners[(corners >= 0).all(1)]
