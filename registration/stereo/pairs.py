"""Which photographs are compared with which: angles between views of the head."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.types import Camera

LEAST_DEG, BEST_DEG, MOST_DEG = 10.0, 22.0, 32.0  # between two views: below depths are vague, above windows differ
WIDEST_DEG = 60.0  # where there is no better partner: half the face is hidden beyond
_NARROWEST_DEG = 3.0
_SAME_SIDE_DEG = 40.0  # partners that lie in about one direction from the view show the same


def view_angles(cameras: Sequence[Camera], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N N"]:
    """Return the angles (degrees) between the directions from the head's centre to the cameras."""
    directions = _directions(cameras, centre)
    return np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))


def choose_partners(
    cameras: Sequence[Camera], centre: Float[np.ndarray, "3"], count: int = 4
) -> tuple[tuple[int, ...], ...]:
    """Choose for each view the views that it is compared with, best first.

    Partners are 10 to 32 degrees away, on different sides of the view where there are such; a view that has none takes
    the next best one up to 60 degrees away.

    Args:
        cameras: of the views.
        centre: of the head, world, metres.
        count: of partners of a view, at most.

    Returns:
        Indices into the views; () for a view that none overlaps with.

    Raises:
        InputError: no two views are near enough, or there are fewer than two.
    """
    if len(cameras) < 2:
        raise InputError(
            "Stereo needs two views",
            where="views",
            expected="at least 2 that show the head",
            got=len(cameras),
            fix="add photographs, or register without stereo",
        )
    angles, directions = view_angles(cameras, centre), _directions(cameras, centre)
    partners = tuple(_partners(view, angles[view], directions, count) for view in range(len(cameras)))
    if not any(partners):
        apart = angles[np.triu_indices(len(cameras), 1)]
        raise InputError(
            "No two views overlap enough for stereo",
            where="cameras",
            expected=f"two views {LEAST_DEG:.0f} to {MOST_DEG:.0f} degrees apart about the head, "
            f"{_NARROWEST_DEG:.0f} to {WIDEST_DEG:.0f} at the utmost",
            got=f"{apart.min():.0f} to {apart.max():.0f} degrees",
            fix="add photographs between them, or register without stereo",
        )
    return partners


def _partners(
    view: int, angles: Float[np.ndarray, "N"], directions: Float[np.ndarray, "N 3"], count: int
) -> tuple[int, ...]:
    near = [k for k in range(len(angles)) if k != view and LEAST_DEG <= angles[k] <= MOST_DEG]
    near.sort(key=lambda k: abs(angles[k] - BEST_DEG))
    sides = directions - (directions @ directions[view])[:, None] * directions[view]
    sides /= np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), 1e-12)
    limit = np.cos(np.radians(_SAME_SIDE_DEG))
    chosen: list[int] = []
    for k in near:
        if all(sides[k] @ sides[other] < limit for other in chosen):
            chosen.append(k)
    chosen += [k for k in near if k not in chosen]
    if len(chosen) < min(2, count):
        others = [k for k in range(len(angles)) if k not in (view, *chosen) and angles[k] > _NARROWEST_DEG]
        others = [k for k in others if angles[k] <= WIDEST_DEG]
        chosen += sorted(others, key=lambda k: abs(angles[k] - BEST_DEG))[: min(2, count) - len(chosen)]
    return tuple(chosen[:count])


def _directions(cameras: Sequence[Camera], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N 3"]:
    offset = np.stack([camera.centre for camera in cameras]) - centre
    return offset / np.linalg.norm(offset, axis=1, keepdims=True)
