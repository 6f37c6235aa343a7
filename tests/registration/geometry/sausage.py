"""A closed surface with two lobes that can be bent into one another: a sausage along an arc of a circle."""

import numpy as np

RADIUS = 0.01  # of the sausage; its ends are half balls
BEND = 0.03  # radius of the arc
_AROUND, _ALONG, _CAP = 32, 64, 8


def sausage(half_angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), outward triangles (F, 3), and where along the arc each vertex lies, -1 .. 1.

    The arc lies in the x-y plane around the origin and is open towards -x; its ends are at +- `half_angle`, so that
    at pi they meet and beyond they overlap.
    """
    cap = np.linspace(0, np.pi / 2, _CAP, endpoint=False)[1:]
    share = np.concatenate([np.full(len(cap), -1.0), np.linspace(-1, 1, _ALONG), np.full(len(cap), 1.0)])
    latitude = np.concatenate([cap - np.pi / 2, np.zeros(_ALONG), cap[::-1] * -1 + np.pi / 2])
    around = np.arange(_AROUND) * 2 * np.pi / _AROUND
    share, latitude = (
        np.r_[-1, np.repeat(share, _AROUND), 1],
        np.r_[-np.pi / 2, np.repeat(latitude, _AROUND), np.pi / 2],
    )
    around = np.r_[0, np.tile(around, (len(share) - 2) // _AROUND), 0]
    angle = half_angle * share
    outwards = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    onwards = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], 1)
    ring = np.cos(around)[:, None] * outwards + np.sin(around)[:, None] * [0, 0, 1]
    offset = np.cos(latitude)[:, None] * ring + np.sin(latitude)[:, None] * onwards
    return BEND * outwards + RADIUS * offset, _triangles(len(share)), share


def end(half_angle: float, side: int) -> np.ndarray:
    """The centre of the half ball at one end; side -1 or 1."""
    return BEND * np.array([np.cos(half_angle), side * np.sin(half_angle), 0])


def _triangles(count: int) -> np.ndarray:
    rings = np.arange(1, count - 1).reshape(-1, _AROUND)
    here, beside = rings, np.roll(rings, -1, 1)
    a, b, c, d = here[:-1], beside[:-1], beside[1:], here[1:]
    sides = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    first = np.stack([np.zeros(_AROUND, int), here[0], beside[0]], 1)
    last = np.stack([np.full(_AROUND, count - 1), beside[-1], here[-1]], 1)
    return np.concatenate([sides, first, last])
