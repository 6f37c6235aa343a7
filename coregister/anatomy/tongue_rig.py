"""A rig of the tongue: smooth deformations of its template [GNM, Tongue Modeling and Articulation].

The centre line is bent and stretched, and its cross-sections turn with it and change their shape; the attachment does
not move. docs/anatomy.md, "Tongue".
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.anatomy.tongue_structure import TongueStructure, interpolate
from registration.frames import MM_PER_M
from registration.geometry.smoothstep import smoothstep
from registration.geometry.winding import closed

PARTS = ("body", "tip")
# Each control exists for the body and for the tip. Angles in degrees, lengths in millimetres, ratios.
KINDS = {
    "curl": "turns the end up, degrees",
    "bend": "turns the end to the subject's left, degrees",
    "twist": "turns the end about the tongue's axis, the left edge down, degrees",
    "roll": "raises both edges, degrees between the edge and the middle",
    "groove": "lowers the middle of the upper surface and raises its sides, mm",
    "protrusion": "lengthens the tongue, mm",
    "shift": "moves the end to the subject's left, mm",
    "raise": "moves the end up, mm",
    "width": "widens and flattens, or narrows and thickens, ratio",
}
CONTROLS = tuple(f"{kind}_{part}" for kind in KINDS for part in PARTS)
# The share along the tongue over which a control of a part grows from nothing to all.
_RANGE = {"body": (0.12, 0.75), "tip": (0.5, 1.0)}
_STEPS = 241  # of the integration along the centre line
_GROOVE_WIDTH = 0.35  # of the half width, standard deviation


@dataclass(frozen=True, kw_only=True, eq=False)
class TongueRig:
    """The rig of one tongue. Controls are vectors in the order of `CONTROLS`; zero is the template."""

    structure: TongueStructure

    @property
    def forward(self) -> Float[np.ndarray, "3"]:
        return self.structure.axis

    @cached_property
    def up(self) -> Float[np.ndarray, "3"]:
        return np.cross(self.forward, (1.0, 0.0, 0.0))

    def pose(self, controls: Float[np.ndarray, "C"], hinge: float = 0.0) -> Float[np.ndarray, "N 3"]:
        """Return the posed tongue, metres, the model's frame.

        Args:
            controls: values of `CONTROLS`.
            hinge: moves the border between body and tip towards the tip, as a share of the tongue.
        """
        return self.pose_points(self.structure.rest, self.structure.share, controls, hinge)

    def pose_points(
        self,
        points: Float[np.ndarray, "P 3"],
        share: Float[np.ndarray, "P"],
        controls: Float[np.ndarray, "C"],
        hinge: float = 0.0,
    ) -> Float[np.ndarray, "P 3"]:
        """Pose points of the tongue, or near it, that belong to the cross-sections at these shares."""
        c = dict(zip(CONTROLS, np.asarray(controls, np.float64), strict=True))
        offset = points - interpolate(self.structure.stations, self.structure.centre, share)
        u, h, a = offset[:, 0], offset @ self.up, offset @ self.forward
        u, h = self._sections(u, h, share, c, hinge)
        shaped = u[:, None] * (1.0, 0.0, 0.0) + h[:, None] * self.up + a[:, None] * self.forward
        moved = self._sum(c, "shift", share, hinge)[:, None] / MM_PER_M * np.array([1.0, 0.0, 0.0])
        moved = moved + self._sum(c, "raise", share, hinge)[:, None] / MM_PER_M * self.up
        turned = self._turns(c, share, hinge).apply(shaped)
        # Differences from rest, so that zero controls give the points themselves.
        return points + interpolate(self._ends, self._line_moves(c, hinge), share) + (turned - offset) + moved

    def least_radius(self, controls: Float[np.ndarray, "C"], hinge: float = 0.0) -> float:
        """Return the smallest radius by which the controls bend the centre line, metres."""
        c = dict(zip(CONTROLS, np.asarray(controls, np.float64), strict=True))
        ends = self._ends
        angles = np.radians([self._sum(c, kind, ends, hinge) for kind in ("curl", "bend")])
        steps = np.diff(self.structure.arc_at(ends)) * self._stretch(c, (ends[1:] + ends[:-1]) / 2, hinge)
        return float(1 / max((np.linalg.norm(np.diff(angles), axis=0) / steps).max(), 1e-9))

    def volume_ratio(self, posed: Float[np.ndarray, "N 3"]) -> float:
        """Return the volume of a posed tongue over that of the template; an open rim is closed alike in both."""
        return _volume(posed, self.structure) / self._volume

    @cached_property
    def _volume(self) -> float:
        return _volume(self.structure.rest, self.structure)

    def _sum(
        self, c: dict[str, float], kind: str, share: Float[np.ndarray, "P"], hinge: float
    ) -> Float[np.ndarray, "P"]:
        """The value of a kind of control along the tongue: body and tip, each grown so far."""
        return c[f"{kind}_body"] * _grown("body", share, hinge) + c[f"{kind}_tip"] * _grown("tip", share, hinge)

    def _turns(self, c: dict[str, float], share: Float[np.ndarray, "P"], hinge: float) -> Rotation:
        values = {kind: np.radians(self._sum(c, kind, share, hinge))[:, None] for kind in ("curl", "bend", "twist")}
        twist = Rotation.from_rotvec(values["twist"] * -self.forward)
        curl = Rotation.from_rotvec(values["curl"] * np.array([-1.0, 0.0, 0.0]))
        bend = Rotation.from_rotvec(values["bend"] * self.up)
        return bend * curl * twist

    def _line_moves(self, c: dict[str, float], hinge: float) -> Float[np.ndarray, "S 3"]:
        """Displacements of the centre line at `_ends`: each of its steps turns and lengthens."""
        structure, ends = self.structure, self._ends
        steps = np.diff(interpolate(structure.stations, structure.centre, ends), axis=0)
        longer = np.diff(self._sum(c, "protrusion", ends, hinge)) / MM_PER_M
        turned = self._turns(c, (ends[1:] + ends[:-1]) / 2, hinge).apply(steps + longer[:, None] * self.forward)
        return np.concatenate([np.zeros((1, 3)), np.cumsum(turned - steps, axis=0)])

    @cached_property
    def _ends(self) -> Float[np.ndarray, "S"]:
        return np.linspace(0, 1, _STEPS)

    def _stretch(self, c: dict[str, float], share: Float[np.ndarray, "P"], hinge: float) -> Float[np.ndarray, "P"]:
        """How much longer the centre line is in each place, as a ratio, along the tongue's axis."""
        low, high = np.clip(share - 0.01, 0, 1), np.clip(share + 0.01, 0, 1)
        longer = self._sum(c, "protrusion", high, hinge) - self._sum(c, "protrusion", low, hinge)
        arc = self.structure.arc_at(high) - self.structure.arc_at(low)
        return np.clip(1 + longer / MM_PER_M / arc, 0.3, None)

    def _sections(
        self,
        u: Float[np.ndarray, "P"],
        h: Float[np.ndarray, "P"],
        share: Float[np.ndarray, "P"],
        c: dict[str, float],
        hinge: float,
    ) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
        """The cross-sections' own shape; their area changes with the length, so that the volume stays."""
        structure = self.structure
        wide = structure.half_width
        # A groove with raised sides: it takes from the middle as much as it gives to the sides.
        profile = np.exp(-0.5 * (u / (_GROOVE_WIDTH * wide)) ** 2)
        mean = _GROOVE_WIDTH * np.sqrt(np.pi / 2)
        upper = smoothstep(-1.0, 1.0, h / structure.half_height)
        h = h - self._sum(c, "groove", share, hinge) / MM_PER_M * (profile - mean) * upper
        thinner = 1 / np.sqrt(self._stretch(c, share, hinge))
        wider = np.exp(self._sum(c, "width", share, hinge))
        u, h = u * thinner * wider, h * thinner / wider
        bow = np.radians(self._sum(c, "roll", share, hinge)) / wide  # 1 / radius of the bowed cross-section
        angle = bow * u
        rise = np.where(np.abs(angle) > 1e-4, (1 - np.cos(angle)) / np.where(angle == 0, 1, angle), angle / 2)
        return u * np.sinc(angle / np.pi) - h * np.sin(angle), h * np.cos(angle) + u * rise


def _grown(part: str, share: Float[np.ndarray, "P"], hinge: float) -> Float[np.ndarray, "P"]:
    low, high = _RANGE[part]
    return smoothstep(*((low, high + hinge) if part == "body" else (low + hinge, high)), share)


def _volume(points: Float[np.ndarray, "N 3"], structure: TongueStructure) -> float:
    vertices, triangles = closed(points, structure.triangles)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)
