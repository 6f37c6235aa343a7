"""Least-squares alignment of corresponding points, and small rigid motions as twists. Computed in float64."""

import numpy as np
from jaxtyping import Float

_SETS = 64  # aligned together: thousands of heads need no memory beside their own


def align(
    source: Float[np.ndarray, "S P 3"], target: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "S P"]
) -> Float[np.ndarray, "S 4 4"]:
    """Align point sets rigidly to one target by weighted least squares [Kabsch 1976]; never by a reflection.

    Args:
        source: S sets of P points.
        target: the corresponding points, in the same unit.
        weights: of the pairs, at least 0.

    Returns:
        T_target_source of each set; the identity for a set whose weights are all zero.
    """
    if len(source) > _SETS:
        batches = (slice(k, k + _SETS) for k in range(0, len(source), _SETS))
        return np.concatenate([align(source[batch], target, weights[batch]) for batch in batches])
    weights = weights.astype(np.float64)
    total = weights.sum(1)
    share = weights / np.where(total > 0, total, 1)[:, None]
    source_mean = np.einsum("sp,spc->sc", share, source)
    target_mean = share @ target.astype(np.float64)
    deviation = (source - source_mean[:, None]) * share[:, :, None]
    covariance = np.einsum("spc,spd->scd", deviation, target[None] - target_mean[:, None])
    u, _, vt = np.linalg.svd(covariance)
    flip = np.ones((len(source), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    T = np.tile(np.eye(4), (len(source), 1, 1))
    T[:, :3, :3] = (vt.swapaxes(1, 2) * flip[:, None, :]) @ u.swapaxes(1, 2)
    T[:, :3, 3] = target_mean - np.einsum("scd,sd->sc", T[:, :3, :3], source_mean)
    T[total <= 0] = np.eye(4)
    return T


def angle_deg(transform: Float[np.ndarray, "S 4 4"]) -> Float[np.ndarray, "S"]:
    """Compute the rotation angles of rigid transforms in degrees, accurate also for small angles."""
    rotation = transform[..., :3, :3]
    axis = np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(rotation, axis1=-2, axis2=-1) - 1))


def motion_fields(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "6 P 3"]:
    """Compute the displacements of points by the six unit twists; a twist (w, t) moves p by w x p + t.

    Args:
        points: metres.

    Returns:
        Displacements by rotations of one radian about x, y and z through the origin, to first order, then by
        translations of one metre along x, y and z.
    """
    fields = np.zeros((6, len(points), 3))
    fields[:3] = np.cross(np.eye(3)[:, None], points[None])
    fields[3:] = np.eye(3)[:, None]
    return fields


def fit_twists(
    displacements: Float[np.ndarray, "S P 3"], points: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "S 6"]:
    """Fit a twist to each displacement field by weighted least squares; linear in the displacements.

    Args:
        displacements: S fields at P points, metres.
        points: where they are, metres.
        weights: of the points, at least 0.

    Returns:
        Rotation vector (radians) and translation (metres) of each field. Rotations that coincident or collinear points
        do not determine are zero.
    """
    fields = motion_fields(points)
    weighted = (fields * weights[:, None]).reshape(6, -1)
    gram = weighted @ fields.reshape(6, -1).T
    right = displacements.reshape(len(displacements), weighted.shape[1]) @ weighted.T
    return np.asarray(right @ np.linalg.pinv(gram, rcond=1e-10, hermitian=True))


def similarity_transform(
    source: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    *,
    free_scale: bool,
    weights: Float[np.ndarray, "P"] | None = None,
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return the similarity transform of least squares between two point sets [Umeyama 1991].

    Args:
        source: points.
        target: the corresponding points, in the same unit.
        free_scale: estimate the scale; else it is 1.
        weights: of the squared distances; None: all alike.

    Returns:
        Scale s, rotation R and translation t with target = s R source + t.
    """
    if weights is None:
        a, b, roots = source.mean(0), target.mean(0), np.ones((len(source), 1))
    else:
        a, b, roots = weights @ source / weights.sum(), weights @ target / weights.sum(), np.sqrt(weights)[:, None]
    u, s, vt = np.linalg.svd(((target - b) * roots).T @ ((source - a) * roots))
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = float((s * np.diag(flip)).sum() / (((source - a) * roots) ** 2).sum()) if free_scale else 1.0
    return scale, rotation, b - scale * rotation @ a
