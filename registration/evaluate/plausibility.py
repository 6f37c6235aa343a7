"""How plausible a registered head is: its distance from the model, and from its subject's neutral (docs/formats.md,
"Figures"). Neither needs an image, so both also judge registrations that agree with spoiled images."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix, eye

from registration.frames import MM_PER_M, linear_to_srgb
from registration.geometry.topology import edges
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, lips, skin
from registration.types import Registration

MIN_CONFIDENCE = 0.3  # of a vertex that counts: below, shape and texture are guesses
_LEAST_SIGMA_M = 5e-4  # of a vertex: where the model hardly varies, noise alone would be many standard deviations
_SPREAD = 4  # rings of neighbours in a window of the textures' comparison
_STABLE = 9e-4  # of a product of brightness in [0, 1]: (0.03)^2 as in SSIM [Wang 2004]


def plausibility(registration: Registration, data: GNMData, neutral: Registration | None = None) -> dict[str, Any]:
    """Return the manifest's figures of a finite registration that need no image.

    Args:
        registration: of a capture, in the model's topology.
        data: the model.
        neutral: registration of the subject's neutral that it started from; None: it is a neutral itself.

    Returns:
        `from_model`: root mean squares of the coefficients in standard deviations, of the offsets in mm and in the
        model's own standard deviations at each vertex, and the difference of the size from the model's in percent.
        `from_neutral`, of an expression: the root mean square by which the offsets differ, mm, and the dissimilarity of
        the textures: 0 for equal ones, about 1 for unrelated ones.
    """
    seen = exterior(data) & (registration.confidence >= MIN_CONFIDENCE)
    lengths = np.linalg.norm(registration.offsets, axis=1)
    sigmas = np.sqrt(np.square(data.vertex_identity_basis.astype(np.float32)).sum((0, 2)))
    figures: dict[str, Any] = {
        "from_model": {
            "identity_sigmas": _rms(registration.identity),
            "expression_sigmas": _rms(registration.expression),
            "offsets_mm": MM_PER_M * _rms(lengths[seen]),
            "offset_sigmas": _rms(lengths[seen] / np.maximum(sigmas[seen], _LEAST_SIGMA_M)),
            "size_percent": 100 * abs(float(registration.scale) - 1),
        }
    }
    if neutral is not None:
        both = seen & (neutral.confidence >= MIN_CONFIDENCE)
        change = np.linalg.norm(registration.offsets - neutral.offsets, axis=1)
        figures["from_neutral"] = {
            "offsets_mm": MM_PER_M * _rms(change[both]),
            "texture": texture_dissimilarity(registration, neutral, both & skin(data) & ~np.logical_or(*lips(data))),
        }
    return figures


def texture_dissimilarity(
    registration: Registration, neutral: Registration, compared: Bool[np.ndarray, "V"]
) -> float | None:
    """Return one minus the mean structural similarity [Wang 2004] of two textures, over windows of the mesh.

    Args:
        registration: with a texture.
        neutral: with a texture in the same atlas.
        compared: vertices at which the textures are compared.

    Returns:
        0 for equal textures, about 1 for unrelated ones; None without vertices to compare.
    """
    if not compared.any():
        return None
    triangles, count = registration.triangles, len(compared)
    first, second = (_brightness(head, count) for head in (registration, neutral))
    known = compared.astype(np.float64)
    window = _windows(triangles, count)
    total = np.maximum(window @ known, 1e-9)

    def mean(values: Float[np.ndarray, "V"]) -> Float[np.ndarray, "V"]:
        return (window @ (known * values)) / total

    a, b = mean(first), mean(second)
    cross, spread = mean(first * second) - a * b, mean(first**2) - a**2 + mean(second**2) - b**2
    similarity = (2 * cross + _STABLE) / (spread + _STABLE) * (2 * a * b + _STABLE) / (a**2 + b**2 + _STABLE)
    return float(1 - similarity[compared].mean())


def _rms(values: Float[np.ndarray, "_"]) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean())) if len(values) else 0.0


def _brightness(head: Registration, count: int) -> Float[np.ndarray, "V"]:
    """The texture's mean sRGB value at every vertex, in [0, 1]: at one of its corners, for those on a seam."""
    size = len(head.texture)
    u, v = head.corner_uvs.reshape(-1, 2).T.astype(np.float64)
    column, row = (np.clip((axis * size).astype(int), 0, size - 1) for axis in (u, 1 - v))
    result = np.zeros(count)
    result[head.triangles.ravel()] = linear_to_srgb(head.texture[row, column]).mean(-1)
    return result


def _windows(triangles: Int[np.ndarray, "F 3"], count: int) -> csr_matrix:
    """The matrix that averages over a vertex and its neighbours, several times."""
    start, end = edges(triangles).vertices.T
    pairs = csr_matrix((np.ones(len(start)), (start, end)), (count, count))
    near = (pairs + pairs.T + eye(count)).tocsr()
    near = csr_matrix(near.multiply(1 / near.sum(1)))
    result = near
    for _ in range(_SPREAD - 1):
        result = result @ near
    return csr_matrix(result)
