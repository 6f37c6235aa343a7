"""Random points of a triangle mesh."""

import numpy as np
from jaxtyping import Float, Int

_MORTON_BITS = 10  # a coordinate: cells of a quarter of a millimetre on a head


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
    area = _areas(vertices, triangles)
    return rng.choice(len(area), count, p=area / area.sum()), rng.dirichlet((1.0, 1.0, 1.0), count)


def spread_over_surface(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], count: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Return random points as `sample_surface`, spread evenly: every patch of the surface gets its share of points.

    Triangles are put in the order of a space-filling curve [Morton 1966], and points lie at equal steps of area along
    it. Means over the surface are then several times more precise than over independent points.

    Args:
        vertices: positions, any unit.
        triangles: vertex indices; their total area must not be zero.
        count: number of points, N.
        rng: source of randomness.
    """
    order = np.argsort(_morton_codes(vertices[triangles].mean(1)), kind="stable")
    area = np.cumsum(_areas(vertices, triangles)[order])
    steps = (np.arange(count) + rng.random()) / count * area[-1]
    face = order[np.minimum(np.searchsorted(area, steps, side="right"), len(order) - 1)]
    return face, rng.dirichlet((1.0, 1.0, 1.0), count)


def _areas(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "F"]:
    """Twice the areas of triangles."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _morton_codes(points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """Positions along a space-filling curve: the bits of the three coordinates, interleaved."""
    low = points.min(0)
    size = max(float((points.max(0) - low).max()), np.finfo(float).tiny)
    cells = ((points - low) / size * (2**_MORTON_BITS - 1)).astype(np.int64)
    codes = np.zeros(len(points), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes
