"""The tangent planes of a raw surface nearest to points: of a mesh, or of a point cloud, where they are estimated."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.geometry.surface_views import SurfaceViews

_NEIGHBOURS = 12  # points of a cloud that give a plane
_FLAT = 0.3  # spread of these across their plane, of that along it; beyond it there is no plane
_BESIDE = 1.5  # times their rms distance from their mean: a foot farther away lies beside the cloud
_WIDE = 3.0  # times the median size of neighbourhoods: a wider one bridges a hole
_SAMPLE = 2000  # neighbourhoods that give the median
_MAX_CLOUD = 2_000_000  # points; more are thinned out evenly


@dataclass(frozen=True, kw_only=True, eq=False)
class Planes:
    """One plane per query point."""

    points: Float[np.ndarray, "P 3"]  # on the plane
    normals: Float[np.ndarray, "P 3"]  # unit
    trusted: Bool[np.ndarray, "P"]  # not at a border, nor where the surface is no plane


@runtime_checkable
class NearestPlanes(Protocol):
    """A raw surface that gives the planes nearest to points."""

    oriented: bool  # whether the normals point to the outside; else their sign means nothing

    def of(self, points: Float[np.ndarray, "P 3"]) -> Planes:
        """Return the plane nearest to each point, in the surface's frame."""
        ...


class MeshPlanes:
    """Those of a mesh: at the closest point, perpendicular to the interpolated vertex normal."""

    oriented = True

    def __init__(self, surface: SurfaceViews):
        """Build the tree of a surface whose normals, outside and borders are known."""
        self._surface = surface
        self._query = ClosestPointQuery(surface.vertices, surface.triangles)

    def of(self, points: Float[np.ndarray, "P 3"]) -> Planes:
        """Return the plane nearest to each point. Planes at the surface's border are not trusted."""
        surface = self._surface
        _, face, share = self._query.closest(points)
        closest = barycentric_points(surface.vertices, surface.triangles, face, share)
        normals = barycentric_points(surface.normals, surface.triangles, face, share)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        trusted = ~surface.at_border[face] & (length[:, 0] > 0.5)
        return Planes(points=closest, normals=normals / np.maximum(length, 1e-20), trusted=trusted)


class CloudPlanes:
    """Those of a point cloud: fitted to the nearest points; the normals' sign is arbitrary."""

    oriented = False

    def __init__(self, points: Float[np.ndarray, "N 3"]):
        """Build the tree of a cloud, of which at most two million points are used."""
        self._points = np.asarray(points, np.float64)[:: -(-len(points) // _MAX_CLOUD)]
        self._tree = cKDTree(self._points)
        some = self._points[:: -(-len(self._points) // _SAMPLE)]
        self._widest = _WIDE * float(np.median(self._fit(some)[3]))

    def of(self, points: Float[np.ndarray, "P 3"]) -> Planes:
        """Return the plane nearest to each point. Where the cloud is no surface, thin or ends, none is trusted."""
        mean, normals, variances, radius = self._fit(points)
        offset = points - mean
        along = np.linalg.norm(offset - (offset * normals).sum(1, keepdims=True) * normals, axis=1)
        flat = variances[:, 0] < _FLAT**2 * variances[:, 1]
        trusted = flat & (along < _BESIDE * radius) & (radius <= self._widest)
        return Planes(points=mean, normals=normals, trusted=trusted)

    def _fit(self, points: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Mean, normal, principal variances in ascending order and rms size of the points nearest to each query."""
        nearest = self._tree.query(points, k=min(_NEIGHBOURS, len(self._points)))[1].reshape(len(points), -1)
        mean = self._points[nearest].mean(1)
        spread = self._points[nearest] - mean[:, None]
        variances, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", spread, spread) / nearest.shape[1])
        return mean, axes[:, :, 0], variances, np.sqrt(variances.sum(1).clip(0))
