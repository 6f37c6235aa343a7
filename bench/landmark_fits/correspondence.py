"""Points of one mesh on a model of another topology: its template is deformed onto the mesh, closest points decide.

First a similarity by landmarks, then displacements of least bending [Amberg 2007, with point-to-point pairs]: the
stiffness falls from round to round while closest points with like normals, and landmarks, pull.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from bench.landmark_fits.heads import HeadModel
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.large_steps import combinatorial_laplacian
from registration.geometry.rigid import similarity_transform
from registration.geometry.topology import vertex_normals
from registration.model.landmarks import LandmarkScheme

_STIFFNESS = (300.0, 100.0, 30.0, 10.0, 3.0, 1.0, 0.5, 0.5)  # of a round, against one pair per vertex
_LANDMARK = 5.0  # weight against a pair, in the first round; it falls with the stiffness
_REACH_M = 0.02  # of pairs
_COMPATIBLE = 0.5  # cosine between normals


def matched_scheme(
    model: HeadModel,
    vertices: Float[np.ndarray, "W 3"],
    triangles: Int[np.ndarray, "F 3"],
    landmarks: dict[str, Float[np.ndarray, "L 3"]],
    points: Float[np.ndarray, "P 3"],
) -> tuple[LandmarkScheme, Float[np.ndarray, "P"]]:
    """Points of a mesh as a scheme of a model.

    Args:
        model: whose template is deformed.
        vertices: of the mesh, metres, any frame; without expression.
        triangles: of its outer skin.
        landmarks: on the mesh, by the name of a scheme that the model has.
        points: on the mesh.

    Returns:
        The scheme, and the distances of the points from the deformed template, metres.
    """
    deformed = _deformed(model, vertices, triangles, landmarks)
    distance, face, barycentric = ClosestPointQuery(deformed, model.outer_triangles).closest(points)
    scheme = LandmarkScheme(name="matched", indices=model.outer_triangles[face], weights=barycentric)
    return scheme, distance


def _deformed(
    model: HeadModel,
    vertices: Float[np.ndarray, "W 3"],
    triangles: Int[np.ndarray, "F 3"],
    landmarks: dict[str, Float[np.ndarray, "L 3"]],
) -> Float[np.ndarray, "V 3"]:
    """The model's template on the mesh; only its outer skin is moved beyond the similarity."""
    schemes = [model.schemes[name] for name in landmarks]
    indices = np.concatenate([scheme.indices for scheme in schemes])
    weights = np.concatenate([scheme.weights for scheme in schemes])
    goal = np.concatenate(list(landmarks.values()))
    rest = np.einsum("lk,lkc->lc", weights, model.template[indices])
    s, R, t = similarity_transform(rest, goal, free_scale=True)
    moved = s * model.template @ R.T + t
    used = np.unique(model.outer_triangles)
    row = np.full(len(moved), -1)
    row[used] = np.arange(len(used))
    inner = (row[indices] >= 0).all(1)  # irises are no part of the skin
    indices, weights, goal = row[indices[inner]], weights[inner], goal[inner]
    own = row[model.outer_triangles]
    laplacian = combinatorial_laplacian(own, len(used))
    bending = (laplacian.T @ laplacian).tocsr()
    count = np.repeat(np.arange(len(indices)), 3)
    sparse = csr_matrix((weights.ravel(), (count, indices.ravel())), (len(indices), len(used)))
    query = ClosestPointQuery(vertices, triangles)
    x = moved[used].copy()
    start = x.copy()
    for stiffness in _STIFFNESS:
        distance, face, barycentric = query.closest(x)
        nearest = np.einsum("pk,pkc->pc", barycentric, vertices[triangles[face]])
        like = np.einsum("pc,pc->p", _normals(x, own), _unit(np.cross(*_sides(vertices, triangles[face]))))
        pairs = ((distance < _REACH_M) & (like > _COMPATIBLE)).astype(float)
        pull = _LANDMARK * np.clip(stiffness / _STIFFNESS[0], 0.02, 1)
        matrix = stiffness * bending + diags(pairs + 1e-6) + pull * (sparse.T @ sparse)
        right = pairs[:, None] * (nearest - start) + pull * (sparse.T @ (goal - sparse @ start))
        x = start + splu(matrix.tocsc()).solve(right)
    moved[used] = x
    return moved


def _sides(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return b - a, c - a


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles)).numpy()
