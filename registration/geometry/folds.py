"""Folds of a surface: edges at which it turns back on itself, as it does not at rest.

The turn of an edge is the angle between the normals of its two faces: 0 where the surface is flat, 180 degrees where
one face lies on the other.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.geometry.topology import LEAST_AREA, edges

_FREE_COSINE = 0.0  # of a turn that is no fold yet, 90 degrees: half a circle over two edges is a rim, not a fold


@dataclass(frozen=True, kw_only=True)
class Creases:
    """The inner edges of a surface, which may become folds: two vertices, two faces, and the turn at rest."""

    vertices: Int[np.ndarray, "E 2"]
    faces: Int[np.ndarray, "E 2 3"]  # corners of both faces
    rest_cosine: Float[np.ndarray, "E"]  # of the turn
    area: Float[np.ndarray, "E"]  # a third of both faces' at rest: the sum is that of the surface

    @classmethod
    def of(
        cls, triangles: Int[np.ndarray, "F 3"], rest: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"]
    ) -> "Creases":
        """Find the inner edges between triangles all of whose corners are members.

        Args:
            triangles: of the mesh.
            rest: vertices at rest.
            members: vertices of the surface.

        Raises:
            InputError: the surface is not a manifold.
        """
        own = triangles[members[triangles].all(1)].astype(np.int64)
        found = edges(own)
        inner = found.faces[:, 1] >= 0
        faces = own[found.faces[inner]]
        points = np.asarray(rest, np.float64)
        a, b, c = (points[faces[..., k]] for k in range(3))
        return cls(
            vertices=found.vertices[inner],
            faces=faces,
            rest_cosine=turn_cosines(torch.as_tensor(points), torch.as_tensor(faces)).numpy(),
            area=np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum(1) / 6,
        )

    @property
    def free_cosine(self) -> Float[np.ndarray, "E"]:
        """The cosine of the turn up to which an edge is no fold: 90 degrees, or what it has at rest."""
        return np.minimum(self.rest_cosine, _FREE_COSINE)

    def sharp(self, vertices: Float[np.ndarray, "V 3"], beyond_deg: float) -> Int[np.ndarray, "N 2"]:
        """Return the edges that turn by more than an angle (degrees) here and not at rest, as pairs of vertices."""
        points = torch.as_tensor(np.asarray(vertices, np.float64))
        cosine = turn_cosines(points, torch.as_tensor(self.faces)).numpy()
        limit = np.cos(np.radians(beyond_deg))
        return self.vertices[(cosine < limit) & (self.rest_cosine >= limit)]


def turn_cosines(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "E 2 3"]) -> Float[Tensor, "E"]:
    """Return the cosine of the angle between the normals of pairs of faces; 0 where a face has no area. Differentiable.

    Args:
        vertices: of the mesh, metres.
        faces: corners of both faces of each pair, wound alike.
    """
    units = []
    for side in range(2):
        a, b, c = (vertices.index_select(0, faces[:, side, k]) for k in range(3))
        normal = torch.linalg.cross(b - a, c - a)
        squared = normal.square().sum(-1)
        solid = squared > LEAST_AREA**2
        units.append(normal * (torch.where(solid, squared, 1.0).rsqrt() * solid)[:, None])
    return (units[0] * units[1]).sum(-1)
