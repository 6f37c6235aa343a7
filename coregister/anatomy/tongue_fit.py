"""Fit of the rig to recorded points, within the mouth and within limits on curvature and volume
[GNM, Tongue Modeling and Articulation].
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares

from coregister.anatomy.tongue_keypoints import TONGUE_POINTS, TongueRecording
from coregister.anatomy.tongue_mouth import Contacts, JawOpening, Mouth, incisors
from coregister.anatomy.tongue_rig import CONTROLS, KINDS, PARTS, TongueRig
from registration.frames import MM_PER_M
from registration.model.gnm_npz import GNMData

# Where on the upper surface the points are, as a share of the length behind the tip; the last two at the edges.
_BEHIND_TIP = {
    "tongue_tip": 0.15,
    "tongue_blade": 0.38,
    "tongue_dorsum": 0.62,
    "tongue_left": 0.38,
    "tongue_right": 0.38,
}
_DATA_MM = 0.5  # standard deviation of a recorded coordinate
_SMOOTHING_S = 0.01  # of the recorded points: movements of speech are slower
# Standard deviation of each control about a tongue at rest, in the rig's units.
_PRIOR = {"curl": 25, "bend": 18, "twist": 10, "roll": 12, "groove": 0.8, "protrusion": 6, "shift": 3, "raise": 5}
_PRIOR |= {"width": 0.1}
_LEAST_RADIUS_MM = 8.0  # of the bent centre line
_VOLUME_CHANGE = 0.1
_PENETRATION_MM = 0.2  # as of drawn poses: deeper than the tongue as the jaw carries it
_CONTACT_MM = 0.1  # standard deviation of a vertex behind the plane that it ought to lie before
_CONTACT_ROUNDS = 4
_GAP_STEP_MM = 0.5  # between mouths that are told apart
_TIGHTENINGS = 6  # each halves the controls' standard deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedTongues:
    """T fitted poses."""

    times: Int[np.ndarray, "T"]  # indices into the recording
    displacements: Float[np.ndarray, "T N 3"]  # of the tongue's vertices, relative to where the jaw carries it; metres
    controls: Float[np.ndarray, "T C"]
    residual_mm: Float[np.ndarray, "T"]  # root mean square distance of the points
    limited: Bool[np.ndarray, "T"]  # held back by the limits on curvature, volume or penetration


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyPointFit:
    """The rig of a model's tongue with the recorded points on it."""

    data: GNMData
    rig: TongueRig

    @cached_property
    def vertices(self) -> dict[str, int]:
        """The vertex of the tongue at each recorded point, by the point's name."""
        structure = self.rig.structure
        found = {}
        for name, behind in _BEHIND_TIP.items():
            side = {"tongue_left": 0.75, "tongue_right": -0.75}.get(name, 0.0)
            away = np.abs(structure.share - (1 - behind))
            edge = np.abs(structure.lateral[away <= max(0.05, away.min())]).max()
            miss = np.hypot(structure.arc - (1 - behind) * structure.length, structure.lateral - side * edge)
            found[name] = int(np.where(structure.dorsum, miss, np.inf).argmin())
        return found

    @cached_property
    def _origin(self) -> Float[np.ndarray, "3"]:
        """The edge of the upper incisors."""
        return self.data.template_vertex_positions[incisors(self.data, upper=True)].mean(0).astype(np.float64)

    @cached_property
    def _jaw(self) -> JawOpening:
        return JawOpening.of(self.data)

    def points_of(self, posed: Float[np.ndarray, "N 3"], gap: float = 0.0) -> dict[str, Float[np.ndarray, "3"]]:
        """Return the recorded points of a posed tongue, millimetres from the upper incisors.

        Args:
            posed: the tongue's vertices in a closed mouth, metres.
            gap: by which the incisors are further apart than in the template, metres.
        """
        moved = posed + self._carried(gap)
        return {name: (moved[vertex] - self._origin) * MM_PER_M for name, vertex in self.vertices.items()}

    def fit(self, recording: TongueRecording, most: int) -> FittedTongues:
        """Fit the rig to the recording, time by time from the one before, by damped least squares in float64.

        The points are smoothed in time first. The jaw is as open as the lower incisors say, beyond their smallest gap;
        without them it is closed. Vertices that lie in teeth, palate, lips or cheeks are pulled out of them. Where
        they stay more than 0.2 mm deeper than as carried by the jaw, the centre line bends by a radius of less than
        8 mm, or the volume changes by more than 10 %, the fit is repeated with controls held closer to rest.

        Args:
            recording: key points, of which some times may be incomplete.
            most: the largest number of times to fit, evenly chosen from the complete ones.
        """
        complete = np.flatnonzero(recording.complete)
        times = complete[np.unique(np.linspace(0, len(complete) - 1, min(most, len(complete))).round().astype(int))]
        smooth = recording.smoothed(times, _SMOOTHING_S)
        gaps = _gaps(smooth, recording)
        controls, start = [], np.zeros(len(CONTROLS))
        limited = np.zeros(len(times), bool)
        for n in range(len(times)):
            measured = {name: smooth.points[name][n] for name in TONGUE_POINTS if name in smooth.points}
            start, limited[n] = self._fit_one(measured, float(gaps[n]), start)
            controls.append(start)
        posed = np.stack([self.rig.pose(values) for values in controls])
        residual = [
            self._residual_mm(tongue, recording, time, float(gap))
            for tongue, time, gap in zip(posed, times.tolist(), gaps, strict=True)
        ]
        return FittedTongues(
            times=times,
            displacements=posed - self.rig.structure.rest,
            controls=np.stack(controls),
            residual_mm=np.array(residual),
            limited=limited,
        )

    def _carried(self, gap: float) -> Float[np.ndarray, "N 3"]:
        structure = self.rig.structure
        return self._jaw.displacement(self._jaw.coefficients(gap))[structure.vertices] if gap else 0 * structure.rest

    def _fit_one(
        self, measured: Mapping[str, Float[np.ndarray, "3"]], gap: float, start: Float[np.ndarray, "C"]
    ) -> tuple[Float[np.ndarray, "C"], bool]:
        names = [name for name, place in measured.items() if np.isfinite(place).all()]
        rows = np.array([self.vertices[name] for name in names])
        target = np.stack([measured[name] for name in names]) / MM_PER_M + self._origin - self._carried(gap)[rows]
        deviations = np.array([_PRIOR[kind] for kind in KINDS for _ in PARTS], float)
        mouth, contacts = self.mouth(gap), Contacts.none()
        moved = mouth.carried - self.rig.structure.rest
        for tightening in range(_TIGHTENINGS + 1):
            for _ in range(_CONTACT_ROUNDS):
                solution = self._solve(start, deviations * 0.5**tightening, (rows, target), contacts.shifted(-moved))
                deep = mouth.deepest(self.rig.pose(solution) + moved, _PENETRATION_MM)
                if not len(deep.rows):
                    break
                contacts, start = contacts.with_more(deep), solution
            if not len(deep.rows) and self._within_limits(solution):
                return solution, tightening > 0
            start = np.zeros_like(start)
        return np.zeros_like(start), True

    def _solve(
        self,
        start: Float[np.ndarray, "C"],
        scale: Float[np.ndarray, "C"],
        recorded: tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]],
        contacts: Contacts,
    ) -> Float[np.ndarray, "C"]:
        """Fit controls of these standard deviations to recorded points, vertices and places, before some planes."""
        structure, count = self.rig.structure, len(recorded[0])
        rows = np.concatenate([recorded[0], contacts.rows])
        rest, share = structure.rest[rows], structure.share[rows]

        def residuals(z: Float[np.ndarray, "C"]) -> Float[np.ndarray, "R"]:
            placed = self.rig.pose_points(rest, share, z * scale) * MM_PER_M
            miss = (placed[:count] - recorded[1] * MM_PER_M) / _DATA_MM
            level = np.einsum("nc,nc->n", contacts.normals, placed[count:])
            behind = np.maximum(contacts.levels * MM_PER_M - level, 0) / _CONTACT_MM
            return np.concatenate([miss.ravel(), behind, z])

        found = least_squares(residuals, start / scale, method="lm", ftol=1e-5, xtol=1e-5, max_nfev=400)
        return np.asarray(found.x * scale)

    def mouth(self, gap: float) -> Mouth:
        """Return the mouth with a gap between the incisors, beyond the template's, to half a millimetre; metres."""
        step = round(gap * MM_PER_M / _GAP_STEP_MM)
        if step not in self._mouths:
            moved = self._jaw.displacement(self._jaw.coefficients(step * _GAP_STEP_MM / MM_PER_M))
            self._mouths[step] = Mouth(self.data, self.data.template_vertex_positions + moved)
        return self._mouths[step]

    @cached_property
    def _mouths(self) -> dict[int, Mouth]:
        return {}

    def _within_limits(self, controls: Float[np.ndarray, "C"]) -> bool:
        if abs(self.rig.volume_ratio(self.rig.pose(controls)) - 1) > _VOLUME_CHANGE:
            return False
        return self.rig.least_radius(controls) * MM_PER_M >= _LEAST_RADIUS_MM

    def _residual_mm(self, posed: Float[np.ndarray, "N 3"], recording: TongueRecording, time: int, gap: float) -> float:
        points = self.points_of(posed, gap)
        misses = [points[name] - recording.points[name][time] for name in points if name in recording.points]
        return float(np.sqrt(np.nanmean(np.sum(np.square(misses), axis=1))))


def _gaps(some: TongueRecording, whole: TongueRecording) -> Float[np.ndarray, "T"]:
    """How much farther the lower incisors are below the upper ones than at their closest in the recording, metres."""
    lower = whole.points.get("lower_incisors")
    if lower is None or not np.isfinite(lower[:, 1]).any():
        return np.zeros(len(some.time_s))
    closest = np.nanpercentile(-lower[:, 1], 1)
    return np.nan_to_num(np.clip(-some.points["lower_incisors"][:, 1] - closest, 0, None)) / MM_PER_M
