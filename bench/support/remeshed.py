"""A head with other triangles, bent, whose correspondence with the original is known."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from registration.geometry.closest_point import closest_points
from registration.model.gnm_npz import GNMData
from registration.topology_map.landmarked import LandmarkedMesh, of_mesh

_WAVE_M = 0.3
_MIDDLE_M = (0.0, 0.29, 0.03)  # of the head, in the models' frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Remeshed:
    """The dual of a model's skin: a vertex in each quad, a polygon around each vertex."""

    source: LandmarkedMesh
    target: LandmarkedMesh  # without vertex groups; bent
    truth: Float[np.ndarray, "V 3"]  # of the target's vertices, on the source's surface, metres


def remeshed(
    data: GNMData,
    source: LandmarkedMesh,
    *,
    bend_m: float = 5e-3,
    along: bool = False,
    landmark_error_m: float = 0.0,
) -> Remeshed:
    """Make the dual mesh of a model's skin and bend it by up to `bend_m` in waves as long as a head.

    Args:
        data: the model.
        source: it with its landmarks.
        bend_m: largest displacement.
        along: displace in all directions, also along the surface, which leaves no trace on a smooth skull; else away
            from the middle of the head.
        landmark_error_m: standard deviation of the target's landmarks, along each axis; then they are projected.
    """
    quads = data.quads[source.skin[data.quads].all(1)].astype(np.int64)
    truth = (source.vertices[quads[:, 0]] + source.vertices[quads[:, 2]]) / 2  # on the diagonal that cuts the quad
    triangles, move = _dual_triangles(quads), _waves if along else _swellings
    scale = bend_m / np.linalg.norm(move(truth), axis=1).max()
    bent, schemes, rng = truth + scale * move(truth), {}, np.random.default_rng(0)
    for name, scheme in source.schemes.items():
        points = scheme.points(source.vertices)
        marked = points + scale * move(points) + landmark_error_m * rng.standard_normal(points.shape)
        face, share = closest_points(marked, bent, triangles)[1:]
        schemes[name] = replace(scheme, indices=triangles[face], weights=share, header={})
    return Remeshed(source=source, target=of_mesh(bent, triangles, schemes, "re-meshed head"), truth=truth)


def _waves(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    x, y, z = (2 * np.pi / _WAVE_M * points).T
    return np.stack([np.sin(y + 1), np.sin(z), np.sin(x + y)], 1)


def _swellings(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    x, y, z = (2 * np.pi / _WAVE_M * points).T
    away = points - _MIDDLE_M
    size = np.sin(x + 0.5) * np.cos(y) + np.sin(z + y) * np.cos(x)
    return size[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)


def _dual_triangles(quads: Int[np.ndarray, "Q 4"]) -> Int[np.ndarray, "F 3"]:
    """A fan for each vertex that quads surround; corners are indices of quads, counter-clockwise."""
    after = {}  # (vertex, next corner) -> quad, previous corner
    for number, corners in enumerate(quads.tolist()):
        for k in range(4):
            after[corners[k], corners[(k + 1) % 4]] = number, corners[k - 1]
    triangles, seen = [], set()
    for vertex, first in after:
        if vertex in seen:
            continue
        seen.add(vertex)
        ring, corner = [], first
        while (vertex, corner) in after and len(ring) < 16:
            number, corner = after[vertex, corner]
            ring.append(number)
            if corner == first:
                triangles += [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
                break
    return np.array(triangles, np.int64)
