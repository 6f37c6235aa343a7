"""The eyes of a head model as a painter and a photographer need them: axis, radii, and which faces are cornea."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.model.gnm_npz import GNMData
from registration.model.regions import group

SIDES = ("left_eye", "right_eye")
_INSIDE = 0.5
_REACH = 1.25  # the cornea, in radii of the iris


@dataclass(frozen=True, kw_only=True)
class EyeFrame:
    """One eye of the template. Metres, model frame."""

    centre: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]  # unit, from the centre through the pupil
    radius: float  # of the eyeball
    iris_radius: float  # around the axis
    pupil_radius: float

    def polar(self, points: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height along the axis (m), distance from it (m) and angle around it, from the model's +X to its +Y."""
        d = points - self.centre
        height = d @ self.axis
        across = d - height[:, None] * self.axis
        x = np.array([1.0, 0, 0]) - self.axis[0] * self.axis
        x /= np.linalg.norm(x)
        return height, np.linalg.norm(across, axis=1), np.arctan2(across @ np.cross(self.axis, x), across @ x)


def eye_frame(data: GNMData, side: str) -> EyeFrame:
    """The frame of `left_eye` or `right_eye`, from the groups of eye, iris and pupil."""
    points = data.template_vertex_positions.astype(np.float64)
    eye = group(data, side) > _INSIDE
    iris, pupil = (eye & (group(data, name) > _INSIDE) for name in ("irises", "pupils"))
    ball = points[eye & (group(data, "scleras") > _INSIDE)]
    # Least squares: |p|^2 = 2 p.c + r^2 - |c|^2
    solution = np.linalg.lstsq(np.column_stack([2 * ball, np.ones(len(ball))]), (ball**2).sum(1), rcond=None)[0]
    centre, radius = solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
    axis = points[pupil if pupil.any() else iris].mean(0) - centre
    axis /= np.linalg.norm(axis)

    def widest(members: Bool[np.ndarray, "V"]) -> float:
        d = points[members] - centre
        return float(np.linalg.norm(d - (d @ axis)[:, None] * axis, axis=1).max(initial=0.0))

    iris_radius = widest(iris | pupil)
    pupil_radius = min(max(widest(pupil), 0.3 * iris_radius), 0.6 * iris_radius)  # a pupil may be a single vertex
    return EyeFrame(centre=centre, axis=axis, radius=radius, iris_radius=iris_radius, pupil_radius=pupil_radius)


def corneas(data: GNMData) -> Bool[np.ndarray, "F"]:
    """The faces that light passes: those of an eye's outer shell in front of an iris that lies on an inner shell.

    None for eyes of one shell, which carries the iris itself.
    """
    points = data.template_vertex_positions.astype(np.float64)
    painted = np.max([group(data, name) for name in ("irises", "pupils", "scleras")], axis=0) > _INSIDE
    outer = (group(data, "eye_exteriors") > _INSIDE) & ~painted
    clear = np.zeros(len(points), bool)
    for side in SIDES:
        own = np.flatnonzero(outer & (group(data, side) > _INSIDE))
        if len(own):
            frame = eye_frame(data, side)
            height, away, _ = frame.polar(points[own])
            clear[own] = (height > 0) & (away < _REACH * frame.iris_radius)
    # Any corner: the rim's faces would else hang over the iris. The inner shell's sclera lies right below them.
    return clear[data.triangles].any(1)
