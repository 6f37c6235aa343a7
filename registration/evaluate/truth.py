"""Errors against ground-truth vertices, in millimetres: of one mesh, and of its motion from the neutral."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from registration.errors import InputError
from registration.evaluate.distances import distance_statistics
from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.types import Registration


def face_vertices(truth: Float[np.ndarray, "N 3"], face_points: Float[np.ndarray, "P 3"]) -> Int[np.ndarray, "M"]:
    """Return the true vertices that are nearest to any of the scan's face points, each once, in ascending order.

    Args:
        truth: true vertices.
        face_points: points of the scan's face, in the unit and frame of `truth`.
    """
    return np.unique(cKDTree(truth).query(face_points)[1]).astype(np.int64)


def vertex_error(
    registration: Registration, truth: Float[np.ndarray, "V 3"], face: Int[np.ndarray, "M"]
) -> dict[str, Any]:
    """Return statistics of the distance between registered vertices and the true vertices of the same index.

    Args:
        registration: in the topology of the truth.
        truth: true vertices, metres, capture world.
        face: indices of the vertices that are compared.
    """
    residual = registration.vertices[face].astype(np.float64) - truth[face]
    return distance_statistics(np.linalg.norm(residual, axis=1) * MM_PER_M)


def require_same_topology(registration: Registration, neutral: Registration) -> None:
    """Check that two registrations have the same triangles.

    Raises:
        InputError: the triangles differ.
    """
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
    """Measure how far surface points slide between two registrations of one subject.

    Each true vertex of the neutral's face is projected to its closest point on the neutral registration. The point with
    the same triangle and barycentric coordinates on the other registration is compared with the same vertex of the
    other truth.

    Args:
        registration: of an expression.
        truth: its true vertices, metres, capture world.
        neutral: registration of the subject's neutral, in the topology of `registration`.
        neutral_truth: its true vertices, in the topology of `truth`; metres, world of the neutral's capture.
        face: indices of the true vertices that are compared.

    Returns:
        Statistics of the distances, and `carried_mm`, the mean distance of the projection, which is a part of them;
        None without vertices.
    """
    projection, triangle, barycentric = closest_points(neutral_truth[face], neutral.vertices, neutral.triangles)
    vertices = registration.vertices.astype(np.float64)
    points = barycentric_points(vertices, registration.triangles, triangle, barycentric)
    statistics = distance_statistics(np.linalg.norm(points - truth[face], axis=1) * MM_PER_M)
    return {**statistics, "carried_mm": float(projection.mean() * MM_PER_M) if len(projection) else None}
