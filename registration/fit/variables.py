"""What a fit solves for, and the mesh that follows from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.frames import axis_angle_to_matrix, matrix_to_axis_angle
from registration.geometry.large_steps import LargeSteps
from registration.geometry.topology import edges
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group, neck_other
from registration.types import Parameters


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where a fit begins. The pose puts the model's pivot (its exterior's centre) at `position`, turned and scaled."""

    rotation: Float[np.ndarray, "3 3"]  # of the whole head, world from model
    position: Float[np.ndarray, "3"]  # world, metres
    scale: float = 1.0
    identity: Float[np.ndarray, "I"] | None = None
    expression: Float[np.ndarray, "E"] | None = None
    joints: Float[np.ndarray, "C 3"] | None = None  # rotations of all joints but the root
    offsets: Float[np.ndarray, "V 3"] | None = None
    landmarks_used: Bool[np.ndarray, "L"] | None = None  # of the scheme it was found with
    notes: tuple[str, ...] = ()  # what the person should know about how it was found


class Unknowns:
    """Tensors by name. A stage frees some of them; `vertices` is differentiable in the free ones.

    The root's rotation is kept as a small turn of a constant one, and the position is where the pivot lies: in these
    terms turning and moving are independent, and no rotation is near the axis-angle's seam. Free offsets live on the
    skin; each eyeball may leave the model's place by a move and a scale about its centre, and keeps its shape.
    """

    def __init__(self, model: GNM, data: GNMData, start: Start):
        device, count = model.template.device, len(data.template_vertex_positions)

        def tensor(value: Any, *shape: int) -> Tensor:
            value = np.zeros(shape) if value is None else np.array(value)
            return torch.tensor(value, dtype=torch.float32, device=device).reshape(shape)

        self.model = model
        self.pivot = tensor(pivot(data), 3)
        self.base_rotation = tensor(start.rotation, 3, 3)
        self.skin = skin_vertices(data)
        self._skin = torch.as_tensor(self.skin, device=device)
        eyes = [np.flatnonzero(group(data, name) > 0.5) for name in ("left_eye", "right_eye")]
        self._eyes = [torch.as_tensor(index, device=device) for index in eyes]
        self.fixed_offsets = tensor(None, count, 3)  # of all that is neither skin nor free
        self.tensors = {
            "identity": tensor(start.identity, len(model.identity_basis)),
            "expression": tensor(start.expression, len(model.expression_basis)),
            "root": tensor(None, 3),
            "joints": tensor(start.joints, len(model.parents) - 1, 3),
            "position": tensor(start.position, 3),
            "scale": tensor(np.log(start.scale)),
            "eyes": tensor(None, 2, 4),
            "offsets": tensor(start.offsets, count, 3)[self._skin],
        }
        if start.offsets is not None:
            self.fixed_offsets = tensor(start.offsets, count, 3)
            self.fixed_offsets[self._skin] = 0
        outside = torch.as_tensor(np.flatnonzero(exterior(data)), device=device)
        shown = model.expression_basis.unflatten(-1, (-1, 3)).index_select(1, outside)
        self._inner = (shown == 0).all(-1).all(-1)  # expression components that move nothing of the outer skin
        self.reference_offsets = self.tensors["offsets"].clone()  # what the offsets' penalties are measured from
        self._steps: LargeSteps | None = None
        self._bind: tuple[Tensor, Tensor] | None = None

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    def free(self, names: Sequence[str], steps: LargeSteps | None) -> None:
        """Make exactly these require gradients. While `offsets` is free, its tensor holds the large steps' latent."""
        for tensor in self.tensors.values():
            tensor.requires_grad_(False)
        self.settle()
        if "offsets" in names:
            assert steps is not None
            self._steps = steps
            self.tensors["offsets"] = steps.latent(self.tensors["offsets"])
        if not {"identity", "expression"} & set(names):
            with torch.no_grad():
                self._bind = self._bind_pose(self.tensors)
        for name in names:
            self.tensors[name].requires_grad_(True)

    def settle(self) -> None:
        """Leave the stage: offsets are offsets again, nothing is cached."""
        with torch.no_grad():
            self.tensors["offsets"] = self.skin_offsets().detach()
        self._steps = self._bind = None

    def skin_offsets(self) -> Float[Tensor, "S 3"]:
        """Free offsets of the skin's vertices, bind space, metres."""
        latent = self.tensors["offsets"]
        return latent if self._steps is None else self._steps.displacement(latent)

    def _bind_pose(self, tensors: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        identity = tensors["identity"]
        return self.model.bind(identity, tensors["expression"]), self.model.joints(identity)

    def _offsets(self, skin_offsets: Tensor, bind: Tensor, eyes: Tensor) -> Float[Tensor, "V 3"]:
        """All offsets in bind space: the skin's, and the eyeballs' moves."""
        offsets = self.fixed_offsets.index_add(0, self._skin, skin_offsets)
        for move, index in zip(eyes, self._eyes, strict=True):
            own = bind[index]
            offsets = offsets.index_add(0, index, move[:3] + torch.expm1(move[3]) * (own - own.mean(0).detach()))
        return offsets

    def rotation(self) -> Float[Tensor, "3 3"]:
        return axis_angle_to_matrix(self.tensors["root"]) @ self.base_rotation

    def vertices(self, skin_offsets: Tensor) -> Float[Tensor, "V 3"]:
        """The mesh in the capture's world, metres."""
        return self._posed(skin_offsets, self.tensors)

    def yielding(self, skin_offsets: Tensor) -> Float[Tensor, "V 3"]:
        """The same mesh, with a gradient for what yields where parts touch: offsets, and the tongue.

        A face does not become another one for its parts to fit, nor do the eyeballs move, which images place.
        """
        held = {name: tensor.detach() for name, tensor in self.tensors.items()}
        held["expression"] = torch.where(self._inner, self.tensors["expression"], held["expression"])
        return self._posed(skin_offsets, held)

    @torch.no_grad()
    def at_rest(self) -> Float[Tensor, "V 3"]:
        """The model's head of this identity, its face relaxed, in the model's frame."""
        identity = self.tensors["identity"]
        return self.model.bind(identity, torch.zeros_like(self.tensors["expression"]))

    def _posed(self, skin_offsets: Tensor, tensors: Mapping[str, Tensor]) -> Float[Tensor, "V 3"]:
        bind, joints = self._bind or self._bind_pose(tensors)
        bind = bind + self._offsets(skin_offsets, bind, tensors["eyes"])
        root = axis_angle_to_matrix(tensors["root"]) @ self.base_rotation
        local = torch.cat([root[None], axis_angle_to_matrix(tensors["joints"])])
        # The root turns the head about its joint; the pivot, turned likewise, is then put in its place.
        pivot = root @ (self.pivot - joints[0]) + joints[0]
        return tensors["scale"].exp() * (self.model.pose(bind, joints, local) - pivot) + tensors["position"]

    @torch.no_grad()
    def parameters(self) -> tuple[Parameters, Float[Tensor, "V 3"]]:
        """The model's own parameters and bind-space offsets that give the same mesh."""
        rotation, scale = self.rotation(), self.tensors["scale"].exp()
        bind, joints = self._bind_pose(self.tensors)
        root = matrix_to_axis_angle(rotation.double().cpu().numpy())
        rotations = torch.cat([torch.tensor(root, dtype=torch.float32, device=rotation.device)[None], self["joints"]])
        # The model turns about its root joint, we about the pivot.
        translation = self["position"] - scale * (rotation @ (self.pivot - joints[0]) + joints[0])
        parameters = Parameters(
            identity=self["identity"].detach().clone(),
            expression=self["expression"].detach().clone(),
            rotations=rotations,
            translation=translation,
            scale=scale,
        )
        return parameters, self._offsets(self.skin_offsets(), bind, self["eyes"])


def pivot(data: GNMData) -> Float[np.ndarray, "3"]:
    """The point of the model that `Start.position` places: the centre of the head without neck and chest."""
    head = (group(data, "skin_exterior") > 0.5) & ~neck_other(data)
    points = data.template_vertex_positions[head]
    return (points.min(0) + points.max(0)) / 2


def start_of(parameters: Parameters, offsets: Float[np.ndarray, "V 3"], model: GNM, data: GNMData) -> Start:
    """The start that reproduces a registration (used to begin from a neutral)."""
    rotation = axis_angle_to_matrix(parameters.rotations[0].double()).cpu().numpy()
    joints = model.joints(parameters.identity)[0].double().cpu().numpy()
    scale = float(parameters.scale)
    centre = pivot(data)
    position = parameters.translation.double().cpu().numpy() + scale * (rotation @ (centre - joints) + joints)
    return Start(
        rotation=rotation,
        position=position,
        scale=scale,
        identity=parameters.identity.cpu().numpy(),
        expression=parameters.expression.cpu().numpy(),
        joints=parameters.rotations[1:].cpu().numpy(),
        offsets=offsets,
    )


def skin_vertices(data: GNMData) -> Int[np.ndarray, "S"]:
    """The vertices that carry free offsets: all of the skin, its inner linings included."""
    return np.flatnonzero(group(data, "skin") > 0.5)


def skin_topology(
    triangles: Int[np.ndarray, "F 3"], skin: Int[np.ndarray, "S"], vertex_count: int
) -> tuple[Int[np.ndarray, "G 3"], Int[np.ndarray, "E 2"]]:
    """Triangles of the skin alone, in indices into `skin`, and the edges among them."""
    local = np.full(vertex_count, -1)
    local[skin] = np.arange(len(skin))
    own = local[triangles]
    own = own[(own >= 0).all(1)]
    return own, edges(own).vertices
