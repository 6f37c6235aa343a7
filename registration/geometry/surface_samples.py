"""Random points of a triangle mesh."""

import numpy as np
from jaxtyping import Float, Int


def sample_surface(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], count: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Return faces and barycentric coordinates of random points, uniform by area.

    Args:
        vertices: positions, any unit.
        triangles: vertex indices; their total area must not be zero.
        count: number of points, N.
        rng: source of randomness.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return rng.choice(len(area), count, p=area / area.sum()), rng.dirichlet((1.0, 1.0, 1.0), count)
