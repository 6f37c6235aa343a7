"""Distances between a scan and a registered surface, and how they are summed up. Millimetres, unsigned."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.surface_samples import sample_surface
from registration.geometry.topology import edges

SAMPLES = 100_000
MAX_ANGLE = 60.0  # degrees between the normals of a sample and of its closest point


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A triangle mesh: of the scan or of the registration."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]

    def normals(self) -> Float[np.ndarray, "F 3"]:
        """Of the faces, of length twice the area."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.cross(b - a, c - a)


def summary(distance_mm: Float[np.ndarray, "P"]) -> dict[str, Any]:
    """Number, mean, median, standard deviation and 95th percentile; None without points."""
    if not len(distance_mm):
        return {"points": 0, "mean_mm": None, "median_mm": None, "std_mm": None, "p95_mm": None}
    return {
        "points": len(distance_mm),
        "mean_mm": float(distance_mm.mean()),
        "median_mm": float(np.median(distance_mm)),
        "std_mm": float(distance_mm.std()),
        "p95_mm": float(np.percentile(distance_mm, 95)),
    }


def distances_mm(points: Float[np.ndarray, "P 3"], surface: Surface) -> Float[np.ndarray, "P"]:
    """To the closest point of the surface; nothing is aligned and nothing dropped. Points in metres."""
    return closest_points(points, surface.vertices, surface.triangles)[0] * MM_PER_M


def spread(surface: Surface, count: int, seed: int = 0) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Random points of a surface, as many on every square millimetre, and the face of each."""
    face, weight = sample_surface(surface.vertices, surface.triangles, count, np.random.default_rng(seed))
    return barycentric_points(surface.vertices, surface.triangles, face, weight), face


def area_uniform(scan: Surface, within: Bool[np.ndarray, "V"], mesh: Surface, seed: int = 0) -> dict[str, Any]:
    """Figures of area-uniform points of the scan's triangles whose corners are all `within`.

    Points are dropped where the two surfaces' normals differ by more than 60 degrees, and where the closest point
    lies on the mesh's boundary; both shares are told.
    """
    part = Surface(vertices=scan.vertices, triangles=scan.triangles[within[scan.triangles].all(1)])
    if not part.normals().any():
        return {**summary(np.zeros(0)), "dropped_normals": None, "dropped_boundary": None}
    samples, face = spread(part, SAMPLES, seed)
    distance, hit, barycentric = closest_points(samples, mesh.vertices, mesh.triangles)
    there, here = mesh.normals()[hit], part.normals()[face]
    length = np.linalg.norm(there, axis=1) * np.linalg.norm(here, axis=1)
    turned = (there * here).sum(1) < np.cos(np.radians(MAX_ANGLE)) * length
    rim = on_boundary(mesh.triangles, hit, barycentric)
    return {
        **summary(distance[~turned & ~rim] * MM_PER_M),
        "dropped_normals": float(turned.mean()),
        "dropped_boundary": float((rim & ~turned).mean()),
    }


def on_boundary(
    triangles: Int[np.ndarray, "F 3"], face: Int[np.ndarray, "P"], barycentric: Float[np.ndarray, "P 3"]
) -> Bool[np.ndarray, "P"]:
    """Which surface points lie on an edge that has one triangle only."""
    connectivity = edges(triangles)
    rim = connectivity.faces[:, 1] < 0
    open_vertex = np.zeros(triangles.max() + 1, bool)
    open_vertex[connectivity.vertices[rim]] = True
    open_edge = np.zeros((len(triangles), 3), bool)  # by the corner that the edge lies opposite of
    start, end = (connectivity.corners[rim, 0, k] % 3 for k in (0, 1))
    open_edge[connectivity.faces[rim, 0], 3 - start - end] = True
    on_edge = (open_edge[face] & (barycentric < 1e-9)).any(1)
    at_corner = triangles[face, barycentric.argmax(1)]
    return on_edge | (open_vertex[at_corner] & (barycentric.max(1) > 1 - 1e-9))
