"""Specificity: mean distance of a model's random heads from the nearest real ones [GNM, Specificity of GNM],
[Styner 2003]; docs/algorithms.md, "Specificity".

Specificity complements generalization, which alone rewards a model that can represent anything; report both.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.linear_fit import LinearPart
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import align
from registration.geometry.surface_samples import sample_surface

_POINTS = 400  # of the surface of each random head, uniform by area at rest


def specificity_mm(
    part: LinearPart,
    real: Float[np.ndarray, "N P 3"],
    components: Sequence[int],
    *,
    samples: int,
    shortlist: int = 3,
    seed: int = 0,
) -> Float[np.ndarray, "S k"]:
    """Return the distance of each random head from its nearest real one, mm, for each number of components.

    Coefficients are samples of N(0, I); a head with k components has the first k coefficients of its sample. The real
    heads nearest by vertices are candidates; the distance is the least mean distance of 400 points of the random head
    from a candidate's surface, after rigid alignment.

    Args:
        part: the model.
        real: neutrals, the part's vertices, metres, each in any frame.
        components: numbers of components.
        samples: number of random heads, S.
        shortlist: number of candidates.
        seed: of coefficients and points.
    """
    rng = np.random.default_rng(seed)
    coefficients = rng.standard_normal((samples, max(components)))
    face, barycentric = sample_surface(part.rest, part.triangles, _POINTS, rng)
    weights = np.ones((1, len(part.rows)))
    heads = real.astype(np.float64)
    aligned = np.stack([transform_points(align(head[None], part.rest, weights)[0], head) for head in heads])
    flat = aligned.reshape(len(aligned), -1)
    squares = (flat**2).sum(1)
    points, nearest, counts = [], [], []
    for count in components:
        for row in coefficients:
            head = part.shape(row[:count])
            head = transform_points(align(head[None], part.rest, weights)[0], head)
            candidates = np.argsort(squares - 2 * flat @ head.ravel())[:shortlist]  # squared distance, less a constant
            surface_points = barycentric_points(head, part.triangles, face, barycentric)
            for candidate in candidates:
                T_real_head = align(head[None], aligned[candidate], weights)[0]
                points.append(transform_points(T_real_head, surface_points).astype(np.float32))
                nearest.append(candidate)
            counts.append(len(candidates))
    distance = _distances_mm(points, np.array(nearest), aligned, part.triangles)
    best = np.minimum.reduceat(distance, np.cumsum([0, *counts[:-1]]))
    return best.reshape(len(components), samples).T


def _distances_mm(
    points: Sequence[Float[np.ndarray, "M 3"]],
    nearest: Int[np.ndarray, "C"],
    real: Float[np.ndarray, "N P 3"],
    triangles: Int[np.ndarray, "F 3"],
) -> Float[np.ndarray, "C"]:
    """Mean distance of each set of points from its real surface; all sets of one surface in one query, for speed."""
    distances = np.empty(len(points))
    for index in np.unique(nearest):
        members = np.flatnonzero(nearest == index)
        queries = np.concatenate([points[k] for k in members.tolist()])
        distance = closest_points(queries, real[index], triangles)[0]
        distances[members] = distance.reshape(len(members), -1).mean(1) * MM_PER_M
    return distances
