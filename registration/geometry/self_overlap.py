"""How deep a closed surface runs into itself.

Where two stretches of one surface overlap, the winding number is 2 instead of 1. It tells that a vertex is inside, not
of what: behind the vertex lies its own flesh, whose far side may be nearer than the surface that it ran through.
At rest the two differ: the straight way to the far side leads through flesh, to anything else through air.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from registration.geometry.closest_point import on_triangles
from registration.geometry.topology import vertex_normals
from registration.geometry.winding import Winding, closed

_OFF = 2e-6  # m; a vertex is looked for this far off its own surface, on which the winding number jumps
# Cosines: a vertex within 60 degrees of a face's inner normal is squarely behind it. It was so at rest already if it
# was within 75 degrees there, so that little turns of the far side do not count.
_SQUARE, _SQUARE_AT_REST = 0.5, 0.25
_INWARDS = 0.05  # of a way's length
_FEW = 8  # faces whose way from the vertex is followed first
_ROUNDS = (64, 512, 4096)  # nearest faces looked at, until one is a way out
_BATCH = 128  # vertices compared with all faces together: about 100 MB of temporaries


class SelfOverlap:
    """A surface with its rest shape, which should overlap itself as little as may be. Metres; F triangles."""

    def __init__(self, rest: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        self.rest, self.triangles = np.asarray(rest, np.float64), np.asarray(triangles, np.int64)
        self._flesh = Winding(*closed(self.rest, self.triangles))
        self._normals = _normals(self.rest, self.triangles)
        self._overlaps = np.zeros(len(rest), bool)
        self._overlaps[self.inside(self.rest, np.unique(self.triangles))] = True

    def inside(self, vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"]) -> Int[np.ndarray, "M"]:
        """Which of these vertices lie inside the surface, its openings closed."""
        vertices = np.asarray(vertices, np.float64)
        points = vertices[members] + _OFF * _normals(vertices, self.triangles)[members]
        return members[Winding(*closed(vertices, self.triangles)).numbers(points) > 0.5]

    def ways_out(
        self,
        vertices: Float[np.ndarray, "V 3"],
        members: Int[np.ndarray, "N"],
        faces: Int[np.ndarray, "_"],
        reach: Float[np.ndarray, "N"],
    ) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
        """For vertices inside: distance and number of the nearest of these faces that they can have run through.

        A face farther than the vertex' `reach` is not searched for; infinity will do.

        The vertex is squarely behind such a face, and was not so at rest, or there was air between them. (A vertex that
        is inside at rest too may have been.) The last array tells where there is such a face; elsewhere it is the
        far side of the vertex' own flesh, or failing that the nearest face. Infinity and -1 without faces.
        """
        vertices = np.asarray(vertices, np.float64)
        distance, face = np.full(len(members), np.inf), np.full(len(members), -1)
        sure = np.zeros(len(members), bool)
        corners = vertices[self.triangles[faces]]
        centroids = corners.mean(1)
        radii = np.linalg.norm(corners - centroids[:, None], axis=-1).max(1)
        for first in range(0, len(members) if len(faces) else 0, _BATCH):
            rows = np.arange(first, min(first + _BATCH, len(members)))
            away = cdist(vertices[members[rows]], centroids) - radii  # at least
            away[(self.triangles[faces][None] == members[rows][:, None, None]).any(2)] = np.inf
            for count in _ROUNDS:
                count = min(count, len(faces))
                near = np.argpartition(away, count - 1, axis=1)[:, :count]
                found, rank = self._ways(vertices, members[rows], faces[near])
                # Better a far way out than a near face that is none.
                best = np.lexsort((found, rank), axis=1)[:, 0]
                each = np.arange(len(rows))
                distance[rows], face[rows] = found[each, best], faces[near[each, best]]
                sure[rows] = rank[each, best] == 0
                seen = away[each, near[:, -1]]  # all that is nearer has been looked at
                left = (seen < reach[rows]) & ~(sure[rows] & (distance[rows] <= seen))
                rows, away = rows[left], away[left]
                if not len(rows) or count == len(faces):
                    break
        return distance, face, sure

    def _ways(
        self, vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"], faces: Int[np.ndarray, "N K"]
    ) -> tuple[Float[np.ndarray, "N K"], Int[np.ndarray, "N K"]]:
        """Distance of each vertex to each of its faces, and its rank: 0 a way out, 1 the far side of its own flesh."""
        member, face = np.repeat(members, faces.shape[1]), faces.ravel()
        corners, corners_at_rest = vertices[self.triangles[face]], self.rest[self.triangles[face]]
        distance, barycentric = on_triangles(vertices[member], corners)
        rank = np.where(_is_behind(vertices[member], corners, barycentric, _SQUARE), 0, 2)
        rank[(self.triangles[face] == member[:, None]).any(1)] = 3
        before = rank == 0
        at_rest = self.rest[member[before]], corners_at_rest[before], barycentric[before]
        before[before] = _is_behind(*at_rest, _SQUARE_AT_REST)
        rank[before & ~self._overlaps[member]] = 1
        distance, rank = distance.reshape(faces.shape), rank.reshape(faces.shape)
        # The nearest few first: most often one of them is a way out, and only what is nearer need be followed.
        feet = np.einsum("mk,mkc->mc", barycentric, corners_at_rest).reshape(*faces.shape, 3)
        order = np.argsort(np.where(rank < 2, distance, np.inf), axis=1)
        for part in (order[:, :_FEW], order[:, _FEW:]):
            nearest = np.where(rank == 0, distance, np.inf).min(1, keepdims=True)
            asked = np.zeros(faces.shape, bool)
            np.put_along_axis(asked, part, True, axis=1)
            row, column = np.nonzero(asked & (rank == 1) & (distance < nearest))
            rank[row, column] = np.where(self._through_air(members[row], feet[row, column]), 0, 1)
        return distance, rank

    def _through_air(self, members: Int[np.ndarray, "M"], ends: Float[np.ndarray, "M 3"]) -> Bool[np.ndarray, "M"]:
        """Whether the straight way from a vertex to an end leads through air at rest."""
        length = np.linalg.norm(ends - self.rest[members], axis=1, keepdims=True)
        # A way along the surface is no way through air, so it starts a little inside.
        start = self.rest[members] - _INWARDS * length * self._normals[members]
        share = np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None]
        points = start[:, None] * (1 - share) + ends[:, None] * share
        winding = self._flesh.numbers(points.reshape(-1, 3)).reshape(-1, len(share))
        return winding.min(1, initial=1.0) < 0.5


def _normals(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()


def _is_behind(
    points: Float[np.ndarray, "M 3"],
    corners: Float[np.ndarray, "M 3 3"],
    barycentric: Float[np.ndarray, "M 3"],
    cosine: float,
) -> Bool[np.ndarray, "M"]:
    """Whether the way from a triangle's point with these barycentrics to a point is that near its inner normal."""
    way = points - np.einsum("mk,mkc->mc", barycentric, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(way, axis=1) * np.linalg.norm(normal, axis=1)
    return np.einsum("mc,mc->m", way, normal) < -cosine * length
