"""Penetration depth of a closed surface into itself.

Where two regions of one surface overlap, the winding number is 2 instead of 1. This shows that a vertex is inside, but
not which surface it penetrated: the opposite side of the solid behind the vertex may be nearer than that surface. The
rest pose distinguishes the two: there the segment from the vertex to its own opposite side stays inside the solid, the
segment to any other surface leaves it.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from registration.geometry.closest_point import on_triangles
from registration.geometry.topology import vertex_normals
from registration.geometry.winding import Winding, closed

_OFFSET_M = 2e-6  # of a query point along the normal: on the surface itself the winding number is undefined
# Cosines: a vertex within 60 degrees of a face's inner normal is behind the face. In the rest pose 75 degrees suffice,
# so that small rotations of the opposite side do not count as a penetration.
_BEHIND, _BEHIND_AT_REST = 0.5, 0.25
_INWARDS = 0.05  # of a segment's length, by which its start is moved inwards
_FEW = 8  # nearest faces whose segments are tested first
_ROUNDS = (64, 512, 4096)  # nearest faces tested, until one was penetrated
_BATCH = 128  # vertices compared with all faces together: about 100 MB of temporaries


class SelfOverlap:
    """A surface with its rest pose, in which it should overlap itself as little as possible. Metres; F triangles."""

    def __init__(self, rest: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]):
        self.rest, self.triangles = np.asarray(rest, np.float64), np.asarray(triangles, np.int64)
        self._solid = Winding(*closed(self.rest, self.triangles))
        self._normals = _normals(self.rest, self.triangles)
        self._overlaps = np.zeros(len(rest), bool)
        self._overlaps[self.inside(self.rest, np.unique(self.triangles))] = True

    def inside(self, vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"]) -> Int[np.ndarray, "M"]:
        """Return those of the vertices `members` that lie inside the surface with its openings closed."""
        vertices = np.asarray(vertices, np.float64)
        points = vertices[members] + _OFFSET_M * _normals(vertices, self.triangles)[members]
        return members[Winding(*closed(vertices, self.triangles)).numbers(points) > 0.5]

    def penetrated_faces(
        self,
        vertices: Float[np.ndarray, "V 3"],
        members: Int[np.ndarray, "N"],
        faces: Int[np.ndarray, "_"],
        reach: Float[np.ndarray, "N"],
    ) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
        """Find the nearest face that each vertex inside the surface can have penetrated.

        The vertex is behind such a face; in the rest pose it was not, or the segment between them left the solid. (The
        latter is not required of a vertex that is inside in the rest pose too.)

        Args:
            vertices: of the posed mesh.
            members: N vertices inside the surface.
            faces: that are searched.
            reach: distance of each vertex up to which faces are searched; may be infinite.

        Returns:
            Distance, face, and whether the vertex can have penetrated it. Where it cannot, the face is the opposite
            side of the vertex' own solid, or else the nearest face. Infinity and -1 without faces.
        """
        vertices = np.asarray(vertices, np.float64)
        distance, face = np.full(len(members), np.inf), np.full(len(members), -1)
        penetrated = np.zeros(len(members), bool)
        corners = vertices[self.triangles[faces]]
        centroids = corners.mean(1)
        radii = np.linalg.norm(corners - centroids[:, None], axis=-1).max(1)
        row_of = np.full(len(vertices), -1)  # of a vertex, in its batch
        for first in range(0, len(members) if len(faces) else 0, _BATCH):
            rows = np.arange(first, min(first + _BATCH, len(members)))
            bound = cdist(vertices[members[rows]], centroids) - radii  # of the distance, from below
            row_of[members[rows]] = np.arange(len(rows))
            own_face, corner = np.nonzero(row_of[self.triangles[faces]] >= 0)
            bound[row_of[self.triangles[faces[own_face], corner]], own_face] = np.inf
            row_of[members[rows]] = -1
            for count in _ROUNDS:
                count = min(count, len(faces))
                near = np.argpartition(bound, count - 1, axis=1)[:, :count]
                candidate, rank = self._ranked(vertices, members[rows], faces[near])
                # A distant face that can have been penetrated before a near one that cannot.
                best = np.lexsort((candidate, rank), axis=1)[:, 0]
                each = np.arange(len(rows))
                distance[rows], face[rows] = candidate[each, best], faces[near[each, best]]
                penetrated[rows] = rank[each, best] == 0
                tested = bound[each, near[:, -1]]  # every nearer face has been tested
                left = (tested < reach[rows]) & ~(penetrated[rows] & (distance[rows] <= tested))
                rows, bound = rows[left], bound[left]
                if not len(rows) or count == len(faces):
                    break
        return distance, face, penetrated

    def _ranked(
        self, vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"], faces: Int[np.ndarray, "N K"]
    ) -> tuple[Float[np.ndarray, "N K"], Int[np.ndarray, "N K"]]:
        """Distance of each vertex to each of its faces, and rank: 0 penetrated, 1 own opposite side, 2 other, 3 own."""
        member, face = np.repeat(members, faces.shape[1]), faces.ravel()
        corners, corners_at_rest = vertices[self.triangles[face]], self.rest[self.triangles[face]]
        distance, barycentric = on_triangles(vertices[member], corners)
        rank = np.where(_is_behind(vertices[member], corners, barycentric, _BEHIND), 0, 2)
        rank[(self.triangles[face] == member[:, None]).any(1)] = 3
        before = rank == 0
        at_rest = self.rest[member[before]], corners_at_rest[before], barycentric[before]
        before[before] = _is_behind(*at_rest, _BEHIND_AT_REST)
        rank[before & ~self._overlaps[member]] = 1
        distance, rank = distance.reshape(faces.shape), rank.reshape(faces.shape)
        # The nearest few first: usually one of them was penetrated, and only nearer faces need the test by segments.
        feet = np.einsum("mk,mkc->mc", barycentric, corners_at_rest).reshape(*faces.shape, 3)
        order = np.argsort(np.where(rank < 2, distance, np.inf), axis=1)
        for part in (order[:, :_FEW], order[:, _FEW:]):
            nearest = np.where(rank == 0, distance, np.inf).min(1, keepdims=True)
            tested = np.zeros(faces.shape, bool)
            np.put_along_axis(tested, part, True, axis=1)
            row, column = np.nonzero(tested & (rank == 1) & (distance < nearest))
            rank[row, column] = np.where(self._leaves_solid(members[row], feet[row, column]), 0, 1)
        return distance, rank

    def _leaves_solid(self, members: Int[np.ndarray, "M"], ends: Float[np.ndarray, "M 3"]) -> Bool[np.ndarray, "M"]:
        """Whether the segment from a vertex to an end leaves the solid in the rest pose."""
        length = np.linalg.norm(ends - self.rest[members], axis=1, keepdims=True)
        # A segment along the surface does not leave the solid, so it starts slightly inside.
        start = self.rest[members] - _INWARDS * length * self._normals[members]
        share = np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None]
        points = start[:, None] * (1 - share) + ends[:, None] * share
        winding = self._solid.numbers(points.reshape(-1, 3)).reshape(-1, len(share))
        return winding.min(1, initial=1.0) < 0.5


def _normals(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()


def _is_behind(
    points: Float[np.ndarray, "M 3"],
    corners: Float[np.ndarray, "M 3 3"],
    barycentric: Float[np.ndarray, "M 3"],
    cosine: float,
) -> Bool[np.ndarray, "M"]:
    """Whether the offset from a triangle's point with these barycentrics to a point is that near the inner normal."""
    offset = points - np.einsum("mk,mkc->mc", barycentric, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(offset, axis=1) * np.linalg.norm(normal, axis=1)
    return np.einsum("mc,mc->m", offset, normal) < -cosine * length
