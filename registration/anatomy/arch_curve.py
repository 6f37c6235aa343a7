"""The curve of a dental arch: through its teeth's necks, by arc length, with directions along and across it. Metres."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_DEGREES = (5, 6, 4)  # of the polynomials: across, forwards, upwards
_STEP = 1e-4  # of the table
_BEYOND = 0.02  # by which the curve goes on, straight, beyond its last teeth


@dataclass(frozen=True, kw_only=True, eq=False)
class ArchCurve:
    """A smooth curve, tabulated by its signed arc length s: zero in the middle, positive on the subject's left.

    Its plane is that of the teeth's necks. Rows of `plane`: to the subject's left, forwards, upwards; right-handed in
    the order left, upwards, forwards.
    """

    plane: Float[np.ndarray, "3 3"]
    centre: Float[np.ndarray, "3"]  # the middle of the two ends
    arc: Float[np.ndarray, "P"]  # ascending
    points: Float[np.ndarray, "P 3"]  # in the plane's coordinates, relative to the centre
    heading: Float[np.ndarray, "P"]  # angle from `left` to the tangent in the plane, radians

    def at(self, s: Float[np.ndarray, "*S"]) -> tuple[Float[np.ndarray, "*S 3"], Float[np.ndarray, "*S"]]:
        """Return points in the plane's coordinates and headings at arc lengths."""
        points = np.stack([np.interp(s, self.arc, self.points[:, axis]) for axis in range(3)], -1)
        return points, np.asarray(np.interp(s, self.arc, self.heading))

    def locate(self, point: Float[np.ndarray, "3"]) -> float:
        """Return the arc length whose point is nearest in the plane to a point of the model."""
        local = self.plane @ (point - self.centre)
        return float(self.arc[np.linalg.norm(self.points[:, :2] - local[:2], axis=1).argmin()])

    def directions(self, s: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the unit tangent, towards the subject's left end, and the outward normal in the plane."""
        angle = float(np.interp(s, self.arc, self.heading))
        tangent = np.array([np.cos(angle), np.sin(angle), 0])
        return tangent @ self.plane, np.array([-tangent[1], tangent[0], 0]) @ self.plane


def fit_arch_curve(necks: Float[np.ndarray, "T 3"]) -> ArchCurve:
    """Fit the curve to the teeth's necks.

    Args:
        necks: middles of the necks, from the subject's right to left.

    Returns:
        The curve: polynomials of the chord length, by least squares.
    """
    centre = (necks[0] + necks[-1]) / 2
    _, _, axes = np.linalg.svd(necks - necks.mean(0))
    up = axes[2] * (np.sign(axes[2, 1]) or 1.0)
    left = necks[-1] - necks[0]
    left = left - (left @ up) * up
    left /= np.linalg.norm(left)
    plane = np.stack([left, np.cross(left, up), up])
    local = (necks - centre) @ plane.T
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(local[:, :2], axis=0), axis=1))])
    u = 2 * chord / chord[-1] - 1
    fine = np.linspace(-1, 1, 4001)
    curve = np.stack([np.polyval(np.polyfit(u, local[:, k], degree), fine) for k, degree in enumerate(_DEGREES)], 1)
    ends = []
    for end, before in ((0, 20), (-1, -21)):
        direction = curve[end] - curve[before]
        ends.append(curve[end] + _BEYOND * direction / np.linalg.norm(direction[:2]))
    curve = np.concatenate([[ends[0]], curve, [ends[1]]])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve[:, :2], axis=0), axis=1))])
    half = len(necks) // 2
    middle = (local[half - 1] + local[half]) / 2
    arc -= arc[np.linalg.norm(curve[:, :2] - middle[:2], axis=1).argmin()]
    even = np.arange(arc[0], arc[-1], _STEP)
    points = np.stack([np.interp(even, arc, curve[:, axis]) for axis in range(3)], 1)
    tangent = np.gradient(points[:, :2], axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    heading -= 2 * np.pi * np.round(heading[len(heading) // 2] / (2 * np.pi))
    return ArchCurve(plane=plane, centre=centre, arc=even, points=points, heading=heading)
