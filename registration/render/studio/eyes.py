"""The eyes of a head model for rendering: axis, radii, albedo, and the transparent faces of the cornea."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.geometry.smoothstep import smoothstep
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.render.studio.noise import SolidNoise

SIDES = ("left_eye", "right_eye")
_MEMBER = 0.5  # minimum weight of a group's members
_FRONT = 0.1  # height in radii of the eyeball above which the outer shell is transparent


@dataclass(frozen=True, kw_only=True)
class EyeFrame:
    """Axis and radii of an eye of the template. Metres, model frame."""

    centre: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]  # unit, from the centre through the pupil
    radius: float  # of the eyeball
    iris_radius: float  # around the axis
    pupil_radius: float

    def cylindrical(self, points: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return height along the axis (m), distance from it (m), and angle around it from the model's +X to its +Y."""
        d = points - self.centre
        height = d @ self.axis
        radial = d - height[:, None] * self.axis
        x = np.array([1.0, 0, 0]) - self.axis[0] * self.axis
        x /= np.linalg.norm(x)
        return height, np.linalg.norm(radial, axis=1), np.arctan2(radial @ np.cross(self.axis, x), radial @ x)


def eye_frame(data: GNMData, side: str) -> EyeFrame:
    """Return the frame of `left_eye` or `right_eye`, from the vertex groups of eye, sclera, iris and pupil."""
    points = data.template_vertex_positions.astype(np.float64)
    eye = group(data, side) > _MEMBER
    iris, pupil = (eye & (group(data, name) > _MEMBER) for name in ("irises", "pupils"))
    ball = points[eye & (group(data, "scleras") > _MEMBER)]
    # Linear least squares of the sphere [Kåsa 1976]: |p|^2 = 2 p.c + r^2 - |c|^2
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
    """Return the transparent faces: the front of the outer shell of eyes whose inner shell carries sclera and iris.

    The whole front is transparent, because an opaque rim near the iris would shadow the inner shell below it. Eyes of a
    single shell, which carries the iris, have none.
    """
    points = data.template_vertex_positions.astype(np.float64)
    painted = np.max([group(data, name) for name in ("irises", "pupils", "scleras")], axis=0) > _MEMBER
    outer = (group(data, "eye_exteriors") > _MEMBER) & ~painted
    transparent = np.zeros(len(points), bool)
    for side in SIDES:
        rows = np.flatnonzero(outer & (group(data, side) > _MEMBER))
        if len(rows):
            frame = eye_frame(data, side)
            transparent[rows] = frame.cylindrical(points[rows])[0] > _FRONT * frame.radius
    return transparent[data.triangles].any(1)


def paint_eye(
    frame: EyeFrame, points: Float[np.ndarray, "T 3"], iris: tuple[float, float, float], seed: int
) -> Float[np.ndarray, "T 3"]:
    """Return the linear albedo of points on either shell of an eye. A Mitsuba variant must be active.

    Args:
        frame: of the eye.
        points: metres, template.
        iris: linear albedo of the iris.
        seed: of the noise.
    """
    height, distance, angle = frame.cylindrical(points.astype(np.float64))
    noise = SolidNoise(points)
    white = np.array([0.66, 0.62, 0.58]) * (1 + 0.03 * noise.smooth(0.004, 100 * seed + 40))[:, None]
    # Veins are the zero crossings of a noise; they fade towards the iris.
    crossing = np.abs(noise.smooth(0.0035, 100 * seed + 41, octaves=3))
    veins = smoothstep(0.16, 0.0, crossing) * smoothstep(1.1, 2.2, distance / frame.iris_radius)
    white *= 1 - veins[:, None] * np.array([0.05, 0.38, 0.36])
    flush = smoothstep(1.5, 2.6, distance / frame.iris_radius)[:, None]
    white *= 1 - flush * np.array([0.05, 0.16, 0.18])

    t = np.clip((distance - frame.pupil_radius) / (frame.iris_radius - frame.pupil_radius), 0, 1)
    # Fibres run from the pupil to the limbus: noise over the angle, stretched along the radius.
    ring = np.stack([np.cos(angle), np.sin(angle), 0.35 * t], 1) * 0.02
    fibres = SolidNoise(ring)
    pattern = 0.20 * fibres.smooth(0.0022, 100 * seed + 42, octaves=3) + 0.16 * fibres.smooth(0.008, 100 * seed + 43)
    shade = (1 + pattern) * (1.15 - 0.45 * smoothstep(0.55, 1.0, t)) * (0.75 + 0.25 * smoothstep(0.0, 0.12, t))
    warm = smoothstep(0.42, 0.12, t + 0.06 * pattern)[:, None] * np.array([0.10, 0.035, -0.03])
    coloured = np.maximum(np.array(iris) + 0.6 * warm, 0.01) * np.maximum(shade, 0.2)[:, None]
    limbus = smoothstep(0.80, 1.0, t)[:, None]
    coloured *= 1 - 0.75 * limbus
    edge = 0.06 * frame.iris_radius
    inside = smoothstep(frame.iris_radius + 1.5 * edge, frame.iris_radius - edge, distance) * (height > 0)
    pupil = smoothstep(frame.pupil_radius + edge, frame.pupil_radius - 0.4 * edge, distance) * (height > 0)
    colour = white + inside[:, None] * (coloured - white)
    colour += pupil[:, None] * (0.006 - colour)
    return np.clip(colour, 0, 0.95).astype(np.float32)
