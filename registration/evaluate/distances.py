"""Unsigned distances between a scan and a registered surface, in millimetres, and their statistics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.surface_samples import sample_surface
from registration.geometry.topology import edges

SAMPLE_COUNT = 100_000
MAX_NORMAL_ANGLE_DEG = 60.0  # between the normals of a sample and of its closest point
_FEW_REVERSED = 0.01
_EPSILON = 1e-9  # barycentric; a point this close to an edge or a vertex lies on it


@dataclass(frozen=True, kw_only=True)
class TriangleSurface:
    """A triangle mesh: of the scan or of the registration."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]

    def normals(self) -> Float[np.ndarray, "F 3"]:
        """Return the normals of the faces, not normalized: their length is twice the face's area in m^2."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.cross(b - a, c - a)


def distance_statistics(distance_mm: Float[np.ndarray, "P"]) -> dict[str, Any]:
    """Return the number of points, mean, median, standard deviation and 95th percentile; None without points."""
    if not len(distance_mm):
        return {"points": 0, "mean_mm": None, "median_mm": None, "std_mm": None, "p95_mm": None}
    return {
        "points": len(distance_mm),
        "mean_mm": float(distance_mm.mean()),
        "median_mm": float(np.median(distance_mm)),
        "std_mm": float(distance_mm.std()),
        "p95_mm": float(np.percentile(distance_mm, 95)),
    }


def distances_mm(points: Float[np.ndarray, "P 3"], surface: TriangleSurface) -> Float[np.ndarray, "P"]:
    """Return the distance of each point to the closest point of the surface, without alignment or exclusions.

    Args:
        points: metres, in the surface's frame.
        surface: with at least one triangle.

    Returns:
        Millimetres.
    """
    return closest_points(points, surface.vertices, surface.triangles)[0] * MM_PER_M


def scan_to_mesh_area_uniform(
    scan: TriangleSurface,
    within: Bool[np.ndarray, "V"],
    mesh: TriangleSurface,
    towards_cameras: Float[np.ndarray, "V 3"] | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Measure the distance of 100,000 points of the scan, sampled uniformly by area, to the mesh.

    A point is excluded if the two surfaces' normals differ by more than 60 degrees, or if its closest point lies on the
    mesh's boundary.

    Args:
        scan: the surface to sample.
        within: scan vertices; triangles with all three corners among them are sampled.
        mesh: the registered surface, in the scan's frame.
        towards_cameras: a direction from each scan vertex to the side that cameras see. Normals of the scan that point
            away from it are reversed if they are more than a few: an inside-out scan is measured like any other.
        seed: of the random points.

    Returns:
        `distance_statistics` of the remaining points, and the excluded fractions `dropped_normals` and
        `dropped_boundary` (None if there is no area to sample). A point with both defects counts for the normals.
    """
    region = TriangleSurface(vertices=scan.vertices, triangles=scan.triangles[within[scan.triangles].all(1)])
    if not region.normals().any():
        return {**distance_statistics(np.zeros(0)), "dropped_normals": None, "dropped_boundary": None}
    rng = np.random.default_rng(seed)
    scan_face, weight = sample_surface(region.vertices, region.triangles, SAMPLE_COUNT, rng)
    samples = barycentric_points(region.vertices, region.triangles, scan_face, weight)
    distance, mesh_face, barycentric = closest_points(samples, mesh.vertices, mesh.triangles)
    scan_normals = region.normals()
    if towards_cameras is not None:
        scan_normals = _outward(scan_normals, towards_cameras[region.triangles].sum(1))
    mesh_normal, scan_normal = mesh.normals()[mesh_face], scan_normals[scan_face]
    length = np.linalg.norm(mesh_normal, axis=1) * np.linalg.norm(scan_normal, axis=1)
    opposed = (mesh_normal * scan_normal).sum(1) < np.cos(np.radians(MAX_NORMAL_ANGLE_DEG)) * length
    boundary = on_boundary(mesh.triangles, mesh_face, barycentric)
    return {
        **distance_statistics(distance[~opposed & ~boundary] * MM_PER_M),
        "dropped_normals": float(opposed.mean()),
        "dropped_boundary": float((boundary & ~opposed).mean()),
    }


def _outward(normals: Float[np.ndarray, "F 3"], outwards: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3"]:
    """Reverse the normals (with the area as length) that point inwards, unless their share of the area is negligible:
    at grazing angles the direction to the cameras is ambiguous."""
    inward = (normals * outwards).sum(1) < 0
    area = np.linalg.norm(normals, axis=1)
    if area[inward].sum() <= _FEW_REVERSED * area.sum():
        return normals
    return np.where(inward[:, None], -normals, normals)


def on_boundary(
    triangles: Int[np.ndarray, "F 3"], face: Int[np.ndarray, "P"], barycentric: Float[np.ndarray, "P 3"]
) -> Bool[np.ndarray, "P"]:
    """Return which surface points lie on the mesh's boundary: on an edge that only one triangle has.

    Args:
        triangles: vertex indices.
        face: triangle of each point.
        barycentric: coordinates of each point in its triangle.
    """
    connectivity = edges(triangles)
    boundary = connectivity.faces[:, 1] < 0
    boundary_vertex = np.zeros(triangles.max() + 1, bool)
    boundary_vertex[connectivity.vertices[boundary]] = True
    boundary_edge = np.zeros((len(triangles), 3), bool)  # of a triangle, by the corner opposite to the edge
    start, end = (connectivity.corners[boundary, 0, k] % 3 for k in (0, 1))
    boundary_edge[connectivity.faces[boundary, 0], 3 - start - end] = True
    on_edge = (boundary_edge[face] & (barycentric < _EPSILON)).any(1)
    nearest_corner = triangles[face, barycentric.argmax(1)]
    return on_edge | (boundary_vertex[nearest_corner] & (barycentric.max(1) > 1 - _EPSILON))
