"""Depths of points behind surfaces that move with them, in float64: the contacts of the anatomical term.

A point is deep in a piece of a surface if the closest point of that piece lies behind it; of several pieces near
it the one in which it lies deepest counts. An open piece ends at its rim: nothing is behind it there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from registration.geometry.closest_point import on_triangles
from registration.geometry.topology import connected_parts, edges

_CELL, _CHANGE = 1.5, 0.7  # size of a cell, and change of a rigid surface's shape, mm
_OPEN = 2.0  # from the bounding box of an open surface, mm
_PLANES = 3  # triangles, with centroids nearest to a point, that say whether it may be behind the surface
MIN_TRIANGLES = _CANDIDATES = 6  # of which the closest point is computed
_MIN_COSINE = 0.5  # of the normal and the offset to the closest point; below, that one is on no candidate
_ON_RIM = 1 - 1e-6  # sum of the barycentrics of corners on the rim


@dataclass(frozen=True, kw_only=True, eq=False)
class Contact:
    """Points that must not lie behind a surface."""

    points: Int[np.ndarray, "P"]  # vertices
    triangles: Int[np.ndarray, "F 3"]  # of the surface, normals outwards
    rigid: bool = False  # the surface moves almost rigidly, and its shape changes little
    solid: bool = False  # the surface is closed but where it is attached: its bounding box contains what is behind it
    reach: float = 6.0  # largest depth, and distance from a triangle's centroid, of points that count, mm


@dataclass(frozen=True, kw_only=True, eq=False)
class Depths:
    """M points behind surfaces: depth = direction . (sum of weights * corners - point), stationary in the weights."""

    query: Int[np.ndarray, "M"]  # into the points of all contacts
    depth: Float[np.ndarray, "M"]
    point: Int[np.ndarray, "M"]  # vertices
    triangle: Int[np.ndarray, "M 3"]  # vertices
    weights: Float[np.ndarray, "M 3"]
    direction: Float[np.ndarray, "M 3"]  # unit


class ContactDepths:
    """Depths of the points of several contacts.

    Args:
        contacts: each with at least one point and `MIN_TRIANGLES` triangles.
        rest: vertices of the template, mm.
    """

    def __init__(self, contacts: Sequence[Contact], rest: Float[np.ndarray, "V 3"]):
        self._contacts = contacts
        self._reach = np.repeat([c.reach for c in contacts], [len(c.triangles) for c in contacts])
        self._point_offsets = np.cumsum([0, *(len(contact.points) for contact in contacts)])
        self._triangle_offsets = np.cumsum([0, *(len(contact.triangles) for contact in contacts)])
        self._points = np.concatenate([contact.points for contact in contacts])
        self._triangles = np.concatenate([contact.triangles for contact in contacts])
        self._corners = [np.ascontiguousarray(contact.triangles.T) for contact in contacts]
        self._surfaces = [np.unique(contact.triangles) for contact in contacts]
        self._grids = [_Grid(rest, contact.triangles, contact.reach) if contact.rigid else None for contact in contacts]
        pieces, rims, count = [], [], 0
        for contact in contacts:
            piece, connectivity = connected_parts(contact.triangles), edges(contact.triangles)
            pieces.append(piece + count)
            count += piece.max() + 1
            rims.append(np.isin(contact.triangles, connectivity.vertices[connectivity.faces[:, 1] < 0]))
        self._piece, self._rim = np.concatenate(pieces), np.concatenate(rims)
        self.count = len(self._points)

    def __call__(self, vertices: Float[np.ndarray, "V 3"], tolerance: Float[np.ndarray, "P"]) -> Depths:
        """Return the points that lie deeper than tolerated.

        Args:
            vertices: mm, in any frame.
            tolerance: of each point, not negative.
        """
        found = [self._candidates(vertices, number) for number in range(len(self._contacts))]
        query = np.concatenate([rows for rows, _ in found])
        near = np.concatenate([triangles for _, triangles in found])
        depth, weights, direction = self._in_candidates(vertices, vertices[self._points[query]], near)
        best, own = depth.argmax(1), np.arange(len(query))
        deep = np.flatnonzero(depth[own, best] > tolerance[query])
        best, query = best[deep], query[deep]
        return Depths(
            query=query,
            depth=depth[deep, best],
            point=self._points[query],
            triangle=self._triangles[near[deep, best]],
            weights=weights[deep, best],
            direction=direction[deep, best],
        )

    def _candidates(self, vertices: np.ndarray, number: int) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M K"]]:
        """Points that may be behind the surface, and the triangles with the nearest centroids."""
        contact, grid = self._contacts[number], self._grids[number]
        x = vertices[contact.points]
        if grid is not None:
            own, near = grid.near(x, vertices[grid.surface])
            first = near[:, :_PLANES]
            a, b, c = (vertices[contact.triangles[first, k]].reshape(-1, 3) for k in range(3))
            behind = _plane(np.repeat(x[own], first.shape[1], 0), a, b, c).reshape(first.shape) < 0
            maybe = behind.any(1)
            own, near = own[maybe], near[maybe]
        else:
            own, near = self._near(x, vertices, number)
        return self._point_offsets[number] + own, self._triangle_offsets[number] + near

    def _near(self, x: np.ndarray, vertices: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        surface = vertices[self._surfaces[number]]
        own = _bounded(x, surface, 0.0 if self._contacts[number].solid else _OPEN)
        if not len(own):
            return own, np.empty((0, _CANDIDATES), np.int64)
        a, b, c = (vertices[corner] for corner in self._corners[number])
        centres = (a + b + c) / 3
        tree = cKDTree(centres, balanced_tree=False, compact_nodes=False)
        near = tree.query(x[own], np.arange(1, _PLANES + 1), distance_upper_bound=self._contacts[number].reach)[1]
        rows, columns = np.nonzero(near < len(centres))
        chosen = near[rows, columns]
        behind = _plane(x[own[rows]], a[chosen], b[chosen], c[chosen]) < 0
        maybe = np.zeros(len(own), bool)
        maybe[rows[behind]] = True
        own = own[maybe]
        return own, tree.query(x[own], np.arange(1, _CANDIDATES + 1))[1].astype(np.int64)

    def _in_candidates(
        self, vertices: np.ndarray, x: Float[np.ndarray, "M 3"], near: Int[np.ndarray, "M K"]
    ) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K 3"], Float[np.ndarray, "M K 3"]]:
        """Depth in each candidate that is the closest of its piece, -inf for others; barycentrics; direction."""
        flat = near.ravel()
        corners = vertices[self._triangles[flat]]
        repeated = np.repeat(x, near.shape[1], 0)
        distance, weights = on_triangles(repeated, corners)
        offset = np.einsum("mk,mkc->mc", weights, corners) - repeated
        normal = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        along = np.einsum("mc,mc->m", normal, offset) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
        # Of triangles that share the closest edge the one that faces the point decides on which side it lies.
        order = (distance - 1e-4 * np.abs(along)).reshape(near.shape)
        side = np.sign(along)
        outside = (np.abs(along) < _MIN_COSINE * distance) | ((weights * self._rim[flat]).sum(1) > _ON_RIM)
        depth = np.where(outside | (distance > self._reach[flat]), -np.inf, distance * side).reshape(near.shape)
        piece = self._piece[near]
        rival = (piece[:, :, None] == piece[:, None, :]) & (order[:, None, :] < order[:, :, None])
        depth[rival.any(2)] = -np.inf
        direction = offset * (side / np.maximum(distance, 1e-30))[:, None]
        return depth, weights.reshape(*near.shape, 3), direction.reshape(*near.shape, 3)


class _Grid:
    """The triangles near each cell of the space around a surface in the template, which move with the surface."""

    def __init__(self, rest: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], reach: float):
        self.surface = np.unique(triangles)
        shape = rest[self.surface]
        self._to_rest = np.linalg.pinv(np.column_stack([shape, np.ones(len(shape))]))
        self._low = shape.min(0) - _CELL
        self._size = np.ceil((shape.max(0) + _CELL - self._low) / _CELL).astype(np.int64)
        cells = np.stack(np.meshgrid(*(np.arange(n) for n in self._size), indexing="ij"), -1).reshape(-1, 3)
        middle = self._low + (cells + 0.5) * _CELL
        a, b, c = (rest[corner] for corner in triangles.T)
        tree = cKDTree((a + b + c) / 3)
        within = np.flatnonzero(tree.query(middle, distance_upper_bound=reach)[1] < len(triangles))
        near = tree.query(middle[within], np.arange(1, _CANDIDATES + 1))[1].astype(np.int32)
        first = near[:, :_PLANES]
        repeated = np.repeat(middle[within], first.shape[1], 0)
        height = _plane(repeated, *(corners[first].reshape(-1, 3) for corners in (a, b, c))).reshape(first.shape)
        used = height.min(1) < _CELL + _CHANGE
        self._entry: Int[np.ndarray, C] = np.full(len(cells), -1)
        self._entry[within[used]] = np.arange(used.sum())
        self._triangles = near[used]

    def near(
        self, x: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "S 3"]
    ) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M K"]]:
        """Points near or behind the surface where it is now, and triangles near them."""
        affine = self._to_rest @ surface
        cell = np.floor(((x - affine[3]) @ np.linalg.inv(affine[:3]) - self._low) / _CELL).astype(np.int64)
        inside = np.flatnonzero(((cell >= 0) & (cell < self._size)).all(1))
        cell = cell[inside]
        entry = self._entry[(cell[:, 0] * self._size[1] + cell[:, 1]) * self._size[2] + cell[:, 2]]
        used = entry >= 0
        return inside[used], self._triangles[entry[used]].astype(np.int64)


def _plane(x: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Float[np.ndarray, "M"]:
    """Height of each point above the plane of its triangle."""
    normal = _cross(b - a, c - a)
    return ((x - a) * normal).sum(1) / np.maximum(np.sqrt((normal**2).sum(1)), 1e-30)


def _bounded(x: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "S 3"], wider: float) -> Int[np.ndarray, "M"]:
    """Points in the bounding box of a surface."""
    return np.flatnonzero(((x > surface.min(0) - wider) & (x < surface.max(0) + wider)).all(1))


def _cross(a: Float[np.ndarray, "M 3"], b: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Faster than `np.cross` for few rows."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
