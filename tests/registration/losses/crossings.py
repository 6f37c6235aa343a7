"""Heads in which one part of a pair is pushed into the other, as deep as a measure without the penalty says.

How far a part has to be pushed follows from the model: no distance is written here, so that any model will do.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.support.crossed_parts import (
    ear_depths_mm,
    eyeball_depths_mm,
    lip_depths_mm,
    part_depths_mm,
    pressed_lid,
    raised_lower_lip,
    teeth_of,
    translated_part,
)
from registration.model import regions
from registration.model.gnm_npz import GNMData

DEPTH_MM = 1.5
_MOST_PUSHES = 60

Depths = Callable[[GNMData, Tensor], Float[np.ndarray, "V"]]


@dataclass(frozen=True)
class Crossing:
    """How to bring two parts into contact."""

    pushed: Callable[[GNMData], Tensor]  # the template with one part moved by 1 mm at most
    depths_mm: Depths  # of each vertex in the other part, measured without the penalty
    points: Callable[[GNMData], Bool[np.ndarray, "V"]]  # the vertices whose depth is measured


@dataclass(frozen=True)
class Crossed:
    """A head with crossed parts."""

    vertices: Float[Tensor, "V 3"]
    push_mm: float
    depth_mm: Float[np.ndarray, "V"]
    rest_mm: Float[np.ndarray, "V"]  # depths in the template
    points: Bool[np.ndarray, "V"]


def template(data: GNMData) -> Float[Tensor, "V 3"]:
    return torch.as_tensor(data.template_vertex_positions)


def pushed(data: GNMData, crossing: Crossing, push_mm: float) -> Float[Tensor, "V 3"]:
    return template(data) + push_mm * (crossing.pushed(data) - template(data))


def push_until(data: GNMData, crossing: Crossing, depth_mm: float) -> Crossed:
    """Push until a vertex is deeper than in the template by `depth_mm`, or up to a tenth less.

    A depth grows by no more than the push, so that what is lacking is a safe next push.
    """
    motion, rest = crossing.pushed(data) - template(data), crossing.depths_mm(data, template(data))
    push = 0.0
    for _ in range(_MOST_PUSHES):
        vertices = template(data) + push * motion
        depth = crossing.depths_mm(data, vertices)
        lacking = depth_mm - float((depth - rest).max())
        if lacking < 0.1 * depth_mm:
            return Crossed(vertices, push, depth, rest, crossing.points(data))
        push += lacking
    raise AssertionError(f"the parts do not meet within {push:.0f} mm")


def tongue_moved(*direction: float) -> Callable[[GNMData], Tensor]:
    unit = np.array(direction) / np.linalg.norm(direction)
    return lambda data: translated_part(data, regions.tongue(data), tuple(unit.tolist()))


def bent_ear(data: GNMData) -> Float[Tensor, "V 3"]:
    """The outer part of the left ear's hind rim, moved inwards and backwards, until it meets the scalp behind it."""
    points = data.template_vertex_positions.astype(np.float64)
    ear = regions.ears(data) & (points[:, 0] > 0)
    hind = points[ear][points[ear, 2].argmin()]
    around = np.clip(1 - (np.linalg.norm(points - hind, axis=1) / 0.020) ** 2, 0, 1) ** 2
    outer = np.clip((points[:, 0] - points[ear, 0].max() + 0.0154) / 0.006, 0, 1)
    motion = (ear * around * outer)[:, None] * np.array([-1e-3, 0, -1e-3]) / np.sqrt(2)
    return torch.as_tensor(points + motion).float()


def _lips(data: GNMData) -> Bool[np.ndarray, "V"]:
    return np.logical_or(*regions.lips(data))


def _part(data: GNMData, members: Bool[np.ndarray, "V"]) -> Int[np.ndarray, "F 3"]:
    return data.triangles[members[data.triangles].all(1)].astype(np.int64)


def _tongue(data: GNMData) -> list[Int[np.ndarray, "F 3"]]:
    return [_part(data, regions.tongue(data))]


def _gums(data: GNMData) -> list[Int[np.ndarray, "F 3"]]:
    return [_part(data, jaw) for jaw in regions.gums(data)]


def _into(
    pushed: Callable[[GNMData], Tensor],
    *sides: tuple[Callable[[GNMData], Bool[np.ndarray, "V"]], Callable[[GNMData], list[Int[np.ndarray, "F 3"]]]],
) -> Crossing:
    """Return a crossing in which the vertices of each side lie in solid parts."""

    def depths_mm(data: GNMData, vertices: Tensor) -> Float[np.ndarray, "V"]:
        at, depth = vertices.numpy().astype(np.float64), np.zeros(len(vertices))
        for members, parts in sides:
            inner = members(data)
            depth[inner] = part_depths_mm(at[inner], at, parts(data))
        return depth

    return Crossing(pushed, depths_mm, lambda data: np.any([members(data) for members, _ in sides], axis=0))


CROSSINGS = {
    "lids-eyeballs": Crossing(lambda data: pressed_lid(data, 1.0), eyeball_depths_mm, regions.exterior),
    "lips-teeth": _into(lambda data: translated_part(data, regions.lips(data)[0], (0.0, 0.0, -1.0)), (_lips, teeth_of)),
    "upper-lower lip": Crossing(lambda data: raised_lower_lip(data, 1.0), lip_depths_mm, _lips),
    "tongue-teeth": _into(tongue_moved(1, 0, 0), (regions.tongue, teeth_of), (regions.teeth, _tongue)),
    # Of the upper lip alone: below, the released model's tongue is open.
    "tongue-lips": _into(tongue_moved(0, 2, 15), (lambda data: regions.lips(data)[0], _tongue)),
    "tongue-palate": _into(tongue_moved(1, 1, 0), (regions.palate, _tongue)),
    "tongue-gums": _into(tongue_moved(0, -4, 6), (regions.tongue, _gums)),
    "ears-head": Crossing(bent_ear, ear_depths_mm, regions.ears),
}
