"""The eyes of a head model as painter and photographer need them: axis, radii, albedo, and which faces are cornea."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.render.studio.canvas import smoothstep
from registration.render.studio.noise import SolidNoise

SIDES = ("left_eye", "right_eye")
_INSIDE = 0.5
_FRONT = 0.1  # in radii of the eyeball: the outer shell before this height is clear


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
    """The faces that light passes: the front of an eye's outer shell, where an inner shell carries sclera and iris.

    All of the front, because a rim near the iris would shade the inner shell right below it. None for eyes of one
    shell, which carries the iris itself.
    """
    points = data.template_vertex_positions.astype(np.float64)
    painted = np.max([group(data, name) for name in ("irises", "pupils", "scleras")], axis=0) > _INSIDE
    outer = (group(data, "eye_exteriors") > _INSIDE) & ~painted
    clear = np.zeros(len(points), bool)
    for side in SIDES:
        own = np.flatnonzero(outer & (group(data, side) > _INSIDE))
        if len(own):
            frame = eye_frame(data, side)
            clear[own] = frame.polar(points[own])[0] > _FRONT * frame.radius
    return clear[data.triangles].any(1)


def paint_eye(
    frame: EyeFrame, points: Float[np.ndarray, "T 3"], iris: tuple[float, float, float], seed: int
) -> Float[np.ndarray, "T 3"]:
    """Linear albedo of points on an eye (template, m), on either shell. A Mitsuba variant must be active."""
    height, away, angle = frame.polar(points.astype(np.float64))
    noise = SolidNoise(points)
    white = np.array([0.66, 0.62, 0.58]) * (1 + 0.03 * noise.smooth(0.004, 100 * seed + 40))[:, None]
    # Veins: where a noise crosses zero; they thin out towards the iris.
    crossing = np.abs(noise.smooth(0.0035, 100 * seed + 41, octaves=3))
    veins = smoothstep(0.16, 0.0, crossing) * smoothstep(1.1, 2.2, away / frame.iris_radius)
    white *= 1 - veins[:, None] * np.array([0.05, 0.38, 0.36])
    flush = smoothstep(1.5, 2.6, away / frame.iris_radius)[:, None]
    white *= 1 - flush * np.array([0.05, 0.16, 0.18])

    t = np.clip((away - frame.pupil_radius) / (frame.iris_radius - frame.pupil_radius), 0, 1)
    # Fibres run from the pupil to the rim: noise over the angle, drawn out along the radius.
    ring = np.stack([np.cos(angle), np.sin(angle), 0.35 * t], 1) * 0.02
    fibres = SolidNoise(ring)
    pattern = 0.20 * fibres.smooth(0.0022, 100 * seed + 42, octaves=3) + 0.16 * fibres.smooth(0.008, 100 * seed + 43)
    shade = (1 + pattern) * (1.15 - 0.45 * smoothstep(0.55, 1.0, t)) * (0.75 + 0.25 * smoothstep(0.0, 0.12, t))
    warm = smoothstep(0.42, 0.12, t + 0.06 * pattern)[:, None] * np.array([0.10, 0.035, -0.03])
    coloured = np.maximum(np.array(iris) + 0.6 * warm, 0.01) * np.maximum(shade, 0.2)[:, None]
    limbus = smoothstep(0.80, 1.0, t)[:, None]
    coloured *= 1 - 0.75 * limbus
    edge = 0.06 * frame.iris_radius
    inside = smoothstep(frame.iris_radius + 1.5 * edge, frame.iris_radius - edge, away) * (height > 0)
    pupil = smoothstep(frame.pupil_radius + edge, frame.pupil_radius - 0.4 * edge, away) * (height > 0)
    colour = white + inside[:, None] * (coloured - white)
    colour += pupil[:, None] * (0.006 - colour)
    return np.clip(colour, 0, 0.95).astype(np.float32)
