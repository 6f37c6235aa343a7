"""The mesh of one anatomical part, before the assembly of a model."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """One mesh component in the model's frame: V vertices, Q quads."""

    vertices: Float[np.ndarray, "V 3"]  # metres
    quads: Int[np.ndarray, "Q 4"]  # counter-clockwise seen from outside
    quad_uvs: Float[np.ndarray, "Q 4 2"]  # in [0, 1]^2
    groups: Mapping[str, Bool[np.ndarray, "V"]]  # official vertex-group name -> membership
    mirror: Int[np.ndarray, "V"]  # the mirror image's vertex: of this part, or of the other eye
