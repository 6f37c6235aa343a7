"""Unfolds the skin: what a stage of offsets has folded is made smooth again, with the least motion that does it.

Folds are as short as an edge, on the lids nearly all. A step of the offsets is smooth over millimetres and hardly
reaches them, however strong the penalty on folds; a minimization over the few vertices around them does.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from registration.fit.context import FitContext
from registration.fit.variables import Variables
from registration.frames import MM_PER_M
from registration.geometry.folds import Creases, turn_cosines
from registration.geometry.large_steps import normalised_laplacian, to_torch
from registration.geometry.topology import grown

_SHARP_DEG = 115.0  # a little below a fold's 120; with 100, creases of a lid were pushed into the lid
_RINGS = 2  # of vertices around a fold that may move
_ROUNDS = 2  # a fold at the border of what moved
_ROUGHNESS, _MOTION = 0.1, 0.005  # per mm^2, against one edge's squared excess of the turn's cosine
_ITERATIONS = 60


def unfold(context: FitContext, variables: Variables) -> None:
    """Displace the outer skin around its folds, between two stages.

    Args:
        context: with the mesh and the creases of its outer skin.
        variables: their offsets take up the motion.
    """
    mesh = variables.vertices(variables.skin_offsets()).detach().double().cpu().numpy()
    displacement = unfolding(context.data.triangles, context.creases, context.outer_skin, mesh)
    if displacement.any():
        variables.move_skin(displacement)


def unfolding(
    triangles: Int[np.ndarray, "F 3"],
    creases: Creases,
    members: Bool[np.ndarray, "V"],
    vertices: Float[np.ndarray, "V 3"],
) -> Float[np.ndarray, "V 3"]:
    """Return a displacement that opens the folds: zero but within two rings of vertices around them.

    It minimizes the squared excess of the turns' cosines, summed over edges, plus its own roughness and size.

    Args:
        triangles: of the mesh.
        creases: the edges that may not fold.
        members: vertices that may move.
        vertices: posed, metres.

    Returns:
        In the unit and frame of the vertices.
    """
    moved = vertices.astype(np.float64)
    for _ in range(_ROUNDS):
        sharp = creases.sharp(moved, _SHARP_DEG)
        if not len(sharp):
            break
        folded = np.zeros(len(vertices), bool)
        folded[sharp] = True
        rows = np.flatnonzero(grown(triangles, folded, _RINGS) & members)
        moved[rows] += _least_motion(triangles, creases, rows, moved)
    return moved - vertices


def _least_motion(
    triangles: Int[np.ndarray, "F 3"], creases: Creases, rows: Int[np.ndarray, "N"], vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "N 3"]:
    """The displacement of some vertices, metres."""
    edges = np.isin(creases.faces, rows).any((1, 2))
    faces = torch.as_tensor(creases.faces[edges])
    limit = torch.as_tensor(creases.free_cosine[edges])
    laplacian = normalised_laplacian(triangles, len(vertices))[rows][:, rows]
    laplacian = to_torch(laplacian, torch.device("cpu"), torch.float64)
    base, index = torch.as_tensor(vertices), torch.as_tensor(rows)

    def objective(flat: Float[np.ndarray, "M"]) -> tuple[float, Float[np.ndarray, "M"]]:
        motion_mm = torch.as_tensor(flat).view(-1, 3).requires_grad_(True)
        cosines = turn_cosines(base.index_add(0, index, motion_mm / MM_PER_M), faces)
        excess = (limit - cosines).clamp_min(0.0)
        roughness = (laplacian @ motion_mm).square().sum()
        loss = excess.square().sum() + _ROUGHNESS * roughness + _MOTION * motion_mm.square().sum()
        loss.backward()
        assert motion_mm.grad is not None
        return loss.item(), motion_mm.grad.numpy().ravel()

    start = np.zeros(3 * len(rows))
    solution = minimize(objective, start, jac=True, method="L-BFGS-B", options={"maxiter": _ITERATIONS})
    return solution.x.reshape(-1, 3) / MM_PER_M
