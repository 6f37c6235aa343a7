"""Errors against true vertices: of one mesh, and of a mesh's motion between two moments. Millimetres."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from registration.errors import InputError
from registration.evaluate.distances import summary
from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.types import Registration


def face_vertices(truth: Float[np.ndarray, "N 3"], face_points: Float[np.ndarray, "P 3"]) -> Int[np.ndarray, "M"]:
    """The true vertices of the face: each scan point of the face chooses the nearest one."""
    return np.unique(cKDTree(truth).query(face_points)[1]).astype(np.int64)


def vertex_error(
    registration: Registration, truth: Float[np.ndarray, "V 3"], face: Int[np.ndarray, "M"]
) -> dict[str, Any]:
    """How far each vertex of the face is from the true vertex of the same index."""
    away = registration.vertices[face].astype(np.float64) - truth[face]
    return summary(np.linalg.norm(away, axis=1) * MM_PER_M)


def require_same_topology(registration: Registration, neutral: Registration) -> None:
    """Raise InputError if the two registrations' triangles differ."""
    if not np.array_equal(registration.triangles, neutral.triangles):
        raise InputError(
            "The two registrations have different topologies",
            where="the registration and its neutral",
            expected=f"the neutral's {len(neutral.triangles)} triangles",
            got=f"{len(registration.triangles)} triangles, or the same number in another order",
            fix="register both with the same model",
        )


def drift(
    registration: Registration,
    truth: Float[np.ndarray, "N 3"],
    neutral: Registration,
    neutral_truth: Float[np.ndarray, "N 3"],
    face: Int[np.ndarray, "M"],
) -> dict[str, Any]:
    """How far surface points slide between two registrations of one person.

    Each true vertex of the neutral (those in `face`) is carried to its closest point on the neutral registration;
    the same face and barycentrics on the other registration are compared with that vertex in the other truth.
    `carried_mm` is the mean distance of the first step, which the drift holds too. Both registrations must have one
    topology.
    """
    carried, hit, barycentric = closest_points(neutral_truth[face], neutral.vertices, neutral.triangles)
    there = barycentric_points(registration.vertices.astype(np.float64), registration.triangles, hit, barycentric)
    figures = summary(np.linalg.norm(there - truth[face], axis=1) * MM_PER_M)
    return {**figures, "carried_mm": float(carried.mean() * MM_PER_M) if len(carried) else None}
