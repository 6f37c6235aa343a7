"""How near a model's random heads come to real ones [GNM, Specificity of GNM]; docs/algorithms.md, "Specificity".

Generalization rewards a model that can be anything; this is the other pan of the scales: neither is told without the
other.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.linear_fit import LinearPart
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import align

_POINTS = 400  # spread evenly over the surface of each random head


def specificity_mm(
    part: LinearPart,
    real: Float[np.ndarray, "N P 3"],
    components: Sequence[int],
    *,
    samples: int,
    shortlist: int = 3,
    seed: int = 0,
) -> Float[np.ndarray, "S k"]:
    """Mean distance (mm) of each random head from its nearest real one, for each number of components.

    Coefficients are drawn from N(0, I); a head of k components has the first k of one and the same draw. Of the real
    neutrals (the part's vertices, m, any frames) those nearest by vertices make a shortlist; among them counts the
    distance from 400 points of the random head, aligned rigidly, to the real one's surface.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal((samples, max(components)))
    face, barycentric = _spread(part.rest, part.triangles, rng)
    every = np.ones((1, len(part.rows)))
    placed = np.stack([transform_points(align(one[None], part.rest, every)[0], one) for one in real.astype(np.float64)])
    flat = placed.reshape(len(placed), -1)
    sizes = (flat**2).sum(1)
    heads, nearest, taken = [], [], []
    for count in components:
        for row in drawn:
            head = part.shape(row[:count])
            head = transform_points(align(head[None], part.rest, every)[0], head)
            candidates = np.argsort(sizes - 2 * flat @ head.ravel())[:shortlist]  # squared distance, less a constant
            for one in candidates:
                T_real_head = align(head[None], placed[one], every)[0]
                points = barycentric_points(head, part.triangles, face, barycentric)
                heads.append(transform_points(T_real_head, points).astype(np.float32))
                nearest.append(one)
            taken.append(len(candidates))
    distance = _distances_mm(heads, np.array(nearest), placed, part.triangles)
    best = np.minimum.reduceat(distance, np.cumsum([0, *taken[:-1]]))
    return best.reshape(len(components), samples).T


def _distances_mm(
    heads: Sequence[Float[np.ndarray, "M 3"]],
    nearest: Int[np.ndarray, "C"],
    real: Float[np.ndarray, "N P 3"],
    triangles: Int[np.ndarray, "F 3"],
) -> Float[np.ndarray, "C"]:
    """Mean distance of each set of points from its real surface; all sets of one surface together, which is faster."""
    found = np.empty(len(heads))
    for one in np.unique(nearest):
        members = np.flatnonzero(nearest == one)
        points = np.concatenate([heads[k] for k in members.tolist()])
        distance = closest_points(points, real[one], triangles)[0]
        found[members] = distance.reshape(len(members), -1).mean(1) * MM_PER_M
    return found


def _spread(
    vertices: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "F 3"], rng: np.random.Generator
) -> tuple[Int[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """Faces and barycentrics of points spread evenly by the area at rest."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return rng.choice(len(area), _POINTS, p=area / area.sum()), rng.dirichlet((1.0, 1.0, 1.0), _POINTS)
