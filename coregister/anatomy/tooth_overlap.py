"""How deep teeth of many samples lie in one another, by signed distance grids in the teeth's own frames.

A tooth's surface points are carried into the frame of the other tooth as it is in the template, where a grid holds the
signed distance to its surface. Exact to about 0.05 mm for the spreads of a dentition. Metres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from registration.anatomy.tooth_structure import Tooth
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.surface_samples import sample_surface
from registration.geometry.winding import Winding, closed

_CELL = 5e-4  # of the grids
_MARGIN = 1.2e-3  # of the grids around a tooth, and largest distance in them
_SHELL_POINTS = 3000  # of a tooth's surface, which select the cells near it
_SPACING = 4e-4  # of the surface points, about
_NEAR = 3e-3  # points of a tooth that are nearer to another one in the template are watched


@dataclass(frozen=True, kw_only=True, eq=False)
class _Field:
    low: Float[np.ndarray, "3"]
    distance: Float[np.ndarray, "X Y Z"]  # negative inside

    def at(self, points: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S"]:
        where = np.moveaxis((points - self.low) / _CELL, -1, 0)
        found: np.ndarray = map_coordinates(self.distance, where, order=1, mode="constant", cval=_MARGIN, output=float)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Watch:
    """Points of one tooth that are near another one: barycentric, on triangles of the tooth's own vertices."""

    moving: int
    fixed: int
    corners: Int[np.ndarray, "P 3"]
    weights: Float[np.ndarray, "P 3"]


class ToothOverlap:
    """Teeth prepared for overlaps of samples; pairs are all that are near one another in the template."""

    def __init__(self, teeth: list[Tooth], template: Float[np.ndarray, "V 3"]):
        self._template = [template[tooth.vertices] for tooth in teeth]
        self._fields = [_field(tooth, template) for tooth in teeth]
        self._watches = list(_watches(teeth, template))
        self._lower = [tooth.fdi >= 30 for tooth in teeth]
        self.pairs = tuple(sorted({tuple(sorted((w.moving, w.fixed))) for w in self._watches}))

    def depth(self, samples: list[Float[np.ndarray, "S N 3"]]) -> Float[np.ndarray, "S P"]:
        """Return the depth of the deepest point of each pair in S samples, metres; 0: apart.

        Args:
            samples: vertices of each tooth, in the order of the constructor.
        """
        backs = [_back(template, points) for template, points in zip(self._template, samples, strict=True)]
        depth = np.zeros((len(samples[0]), len(self.pairs)))
        for watch in self._watches:
            column = self.pairs.index((min(watch.moving, watch.fixed), max(watch.moving, watch.fixed)))
            points = np.einsum("pk,spkc->spc", watch.weights, samples[watch.moving][:, watch.corners])
            matrix, offset = backs[watch.fixed]
            found = -self._fields[watch.fixed].at(points @ matrix + offset[:, None])
            depth[:, column] = np.maximum(depth[:, column], found.max(1))
        return depth

    def clearance(self) -> float:
        """Return the least distance between an upper and a lower tooth of the template, at most `_MARGIN`."""
        least = _MARGIN
        for watch in self._watches:
            if self._lower[watch.moving] != self._lower[watch.fixed]:
                points = np.einsum("pk,pkc->pc", watch.weights, self._template[watch.moving][watch.corners])
                least = min(least, float(self._fields[watch.fixed].at(points).min()))
        return least


def _back(
    template: Float[np.ndarray, "N 3"], samples: Float[np.ndarray, "S N 3"]
) -> tuple[Float[np.ndarray, "S 3 3"], Float[np.ndarray, "S 3"]]:
    """The affine maps that carry samples of a tooth back to the template, by least squares."""
    middle, centres = template.mean(0), samples.mean(1)
    moved = samples - centres[:, None]
    forth = np.linalg.pinv(template - middle) @ moved  # x_template @ forth = x_sample
    matrix = np.linalg.inv(forth)
    return matrix, middle - np.einsum("sc,sck->sk", centres, matrix)


def _field(tooth: Tooth, template: Float[np.ndarray, "V 3"]) -> _Field:
    vertices, triangles = closed(template, tooth.triangles)
    own = vertices[np.unique(triangles)]
    low = own.min(0) - _MARGIN
    counts = np.ceil((np.ptp(own, axis=0) + 2 * _MARGIN) / _CELL).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3) * _CELL + low
    distance = np.full(len(grid), _MARGIN)
    face, weight = sample_surface(vertices, triangles, _SHELL_POINTS, np.random.default_rng(0))
    shell = cKDTree(np.einsum("pk,pkc->pc", weight, vertices[triangles[face]]))
    near = shell.query(grid, distance_upper_bound=_MARGIN)[0] < np.inf
    exact = ClosestPointQuery(vertices, triangles).closest(grid[near])[0]
    distance[near] = np.minimum(exact, _MARGIN)
    inside = Winding(vertices, triangles).numbers(grid) > 0.5
    return _Field(low=low, distance=np.where(inside, -distance, distance).reshape(counts))


def _watches(teeth: list[Tooth], template: Float[np.ndarray, "V 3"]) -> list[_Watch]:
    rng = np.random.default_rng(0)
    points, corners, weights = [], [], []
    for tooth in teeth:
        crown = tooth.triangles[np.isin(tooth.triangles, tooth.vertices[tooth.crown]).all(1)]
        a, b, c = (template[crown[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        face, weight = sample_surface(template, crown, int(area / _SPACING**2), rng)
        own = tooth.vertices[tooth.crown]  # and the vertices themselves
        at = np.concatenate([crown[face], np.stack([own] * 3, 1)])
        weight = np.concatenate([weight, np.tile([1.0, 0, 0], (len(own), 1))])
        points.append(np.einsum("pk,pkc->pc", weight, template[at]))
        corners.append(np.searchsorted(tooth.vertices, at))
        weights.append(weight)
    trees = [cKDTree(p) for p in points]
    watches = []
    for moving in range(len(teeth)):
        for fixed in range(len(teeth)):
            if moving == fixed:
                continue
            rows = np.flatnonzero(trees[fixed].query(points[moving], distance_upper_bound=_NEAR)[0] < np.inf)
            if len(rows):
                watches.append(
                    _Watch(moving=moving, fixed=fixed, corners=corners[moving][rows], weights=weights[moving][rows])
                )
    return watches
