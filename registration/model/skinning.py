"""Linear blend skinning along a kinematic chain, the same for all models of heads."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def skin(
    bind: Float[Tensor, "*B V 3"],
    joints: Float[Tensor, "*C J 3"],
    rotations: Float[Tensor, "*D J 3 3"],
    *,
    weights: Float[Tensor, "V J"],
    parents: Sequence[int],
) -> Float[Tensor, "*E V 3"]:
    """Apply linear blend skinning. For fixed rotations it is linear in (bind, joints).

    Args:
        bind: vertices of the bind pose, metres.
        joints: the joints' positions in the bind pose, metres.
        rotations: each relative to its parent; the root's turns everything.
        weights: of each vertex; rows sum to 1.
        parents: of each joint, before its children; the root's, the first, is negative.
    """
    chained, positions = [rotations[..., 0, :, :]], [joints[..., 0, :]]
    for j, parent in enumerate(parents[1:], start=1):
        bone = joints[..., j, :] - joints[..., parent, :]
        positions.append(positions[parent] + (chained[parent] @ bone[..., None])[..., 0])
        chained.append(chained[parent] @ rotations[..., j, :, :])
    rotation = torch.stack(chained, -3)
    shift = torch.stack(positions, -2) - (rotation @ joints[..., None])[..., 0]
    if rotation.shape[:-3] != shift.shape[:-2]:  # displacements of many components under the same rotations
        turned = (weights @ rotation.flatten(-2)).unflatten(-1, (3, 3))
        return torch.einsum("...vij,...vj->...vi", turned, bind) + weights @ shift
    affine = weights @ torch.cat([rotation, shift[..., None]], -1).flatten(-2)
    affine = affine.unflatten(-1, (3, 4))
    return (affine[..., :3] @ bind[..., None])[..., 0] + affine[..., 3]
