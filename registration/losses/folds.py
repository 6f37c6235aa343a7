"""Penalty on folds of the outer skin: faces that turn against their neighbours further than at rest."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.geometry.folds import Creases, turn_cosines


class FoldPenalty:
    """How much of the skin's area turns against its neighbours: 90 degrees are free, and what there is at rest.

    Args:
        creases: the edges of the skin that may not fold.
        device: of the vertices.
    """

    def __init__(self, creases: Creases, device: torch.device):
        self._faces = torch.as_tensor(creases.faces, device=device)
        self._limit = torch.as_tensor(creases.free_cosine.astype(np.float32), device=device)
        self._share = torch.as_tensor((creases.area / creases.area.sum()).astype(np.float32), device=device)

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, ""]:
        """Return the sum over the edges of their share of the area times the squared excess of their turn's cosine.

        Args:
            vertices: of the posed mesh, any frame.
        """
        with torch.no_grad():
            folded = (turn_cosines(vertices, self._faces) < self._limit).nonzero()[:, 0]
        excess = self._limit[folded] - turn_cosines(vertices, self._faces[folded])  # few: the others have no gradient
        return (self._share[folded] * excess.square()).sum()
