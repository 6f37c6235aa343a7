"""Rigid motions of points: the one that fits best, and small ones as twists. Float64 inside."""

import numpy as np
from jaxtyping import Float


def align(
    source: Float[np.ndarray, "S P 3"], target: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "S P"]
) -> Float[np.ndarray, "S 4 4"]:
    """T_target_source of each point set: rotation and shift with the least weighted squared distance (Kabsch 1976).

    Never a reflection. A set whose weights sum to zero stays where it is.
    """
    weights = weights.astype(np.float64)
    total = weights.sum(1)
    share = weights / np.where(total > 0, total, 1)[:, None]
    middle = np.einsum("sp,spc->sc", share, source)
    aim = share @ target.astype(np.float64)
    spread = np.einsum("spc,spd->scd", (source - middle[:, None]) * share[:, :, None], target[None] - aim[:, None])
    u, _, vt = np.linalg.svd(spread)
    flip = np.ones((len(source), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    found = np.tile(np.eye(4), (len(source), 1, 1))
    found[:, :3, :3] = (vt.swapaxes(1, 2) * flip[:, None, :]) @ u.swapaxes(1, 2)
    found[:, :3, 3] = aim - np.einsum("scd,sd->sc", found[:, :3, :3], middle)
    found[total <= 0] = np.eye(4)
    return found


def angle_deg(transform: Float[np.ndarray, "S 4 4"]) -> Float[np.ndarray, "S"]:
    """By how much transforms turn, degrees; exact also for small angles."""
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
    """What the six unit twists do to points: turns by one radian about x, y, z through the origin, to first order,
    then shifts by one metre along them. A twist (w, t) moves p by w x p + t."""
    fields = np.zeros((6, len(points), 3))
    fields[:3] = np.cross(np.eye(3)[:, None], points[None])
    fields[3:] = np.eye(3)[:, None]
    return fields


def fit_twists(
    displacements: Float[np.ndarray, "S P 3"], points: Float[np.ndarray, "P 3"], weights: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "S 6"]:
    """The twist whose motion of the points is nearest to each displacement, in weighted least squares: rad, metres.

    Linear in the displacement. Points at one place, or on one line, leave some turns open: those are zero.
    """
    fields = motion_fields(points)
    weighted = (fields * weights[:, None]).reshape(6, -1)
    gram = weighted @ fields.reshape(6, -1).T
    right = displacements.reshape(len(displacements), -1) @ weighted.T
    return np.asarray(right @ np.linalg.pinv(gram, rcond=1e-10, hermitian=True))


def similarity_transform(
    source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"], *, free_scale: bool
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return the similarity transform of least squares between two point sets [Umeyama 1991].

    Args:
        source: points.
        target: the corresponding points, in the same unit.
        free_scale: estimate the scale; else it is 1.

    Returns:
        Scale s, rotation R and translation t with target = s R source + t.
    """
    a, b = source.mean(0), target.mean(0)
    u, s, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = float((s * np.diag(flip)).sum() / ((source - a) ** 2).sum()) if free_scale else 1.0
    return scale, rotation, b - scale * rotation @ a
