"""The structure of a model's eyes: centre, sclera, optical axis, and every vertex' place on its surface of revolution.

Found from the template and the vertex groups alone, for any mesh of the official schema. The sclera is the sphere
through the back of the exterior shell, the cornea the sphere through the vertices that protrude from it, and the
optical axis joins their centres [GNM, Eyeball Model Formulation].
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.model import regions
from registration.model.gnm_npz import GNMData

FLIP = np.array([-1.0, 1.0, 1.0])  # a mirror image's coordinates
TOLERANCE = 0.25e-3  # metres, of the mesh's distance from a surface of revolution, and of left from right
_SCLERA_FROM = np.radians(60.0)  # from the direction of the iris: nothing but sclera, also with a rough axis
_CORNEA_SHARE = 0.25  # of the cornea's rise above the sclera, from which a vertex belongs to the corneal sphere
_MIN_RISE = 0.2e-3  # metres, of the cornea above the sclera
_MIN_VERTICES = 8  # of a sphere's fit: twice as many as it has unknowns
_SECTOR = np.radians(30.0)  # half the width of the sectors whose profiles are compared
_TURNS = np.radians([90.0, 180.0, 270.0])  # to those sectors: harmonics of first and second order differ most there


@dataclass(frozen=True, kw_only=True, eq=False)
class Eye:
    """One eye of the template. Metres, the model's frame."""

    vertices: Int[np.ndarray, "N"]  # indices into the model's vertices, in the order of `EyeStructure`
    centre: Float[np.ndarray, "3"]  # of the sclera
    frame: Float[np.ndarray, "3 3"]  # rows: towards the subject's left (right eye: right), up, along the optical axis
    deviation: float  # the largest distance of a vertex from a surface of revolution

    @property
    def axis(self) -> Float[np.ndarray, "3"]:
        """The optical axis, of length one, out of the face."""
        return self.frame[2]

    def to_model(self, displacements: Float[np.ndarray, "*K N 3"]) -> Float[np.ndarray, "*K N 3"]:
        """Return displacements of this eye's own frame in the model's frame."""
        return displacements @ self.frame

    def to_own(self, displacements: Float[np.ndarray, "*K N 3"]) -> Float[np.ndarray, "*K N 3"]:
        """Return displacements of the model's frame in this eye's own frame."""
        return displacements @ self.frame.T


@dataclass(frozen=True, kw_only=True, eq=False)
class EyeStructure:
    """Both eyes, in one own frame: origin in the centre, +Z along the optical axis, +Y up; N vertices of each eye.

    The frame of the right eye is the mirror image of the left one's, so that one displacement moves both eyes alike.
    """

    left: Eye
    right: Eye  # its vertices are the mirror images of the left eye's, in the same order
    positions: Float[np.ndarray, "N 3"]  # in the own frame, the mean of both eyes
    sclera_radius: float
    exterior: Bool[np.ndarray, "N"]  # the outer shell; the others are the inner one
    iris: Bool[np.ndarray, "N"]  # with the pupil
    pupil: Bool[np.ndarray, "N"]  # its edge and what is inside
    asymmetry: float  # the largest distance between a vertex of the left eye and its mirror image, own frames

    @cached_property
    def axis_distance(self) -> Float[np.ndarray, "N"]:
        """Distance from the optical axis, metres."""
        return np.hypot(self.positions[:, 0], self.positions[:, 1])

    @cached_property
    def polar_angle(self) -> Float[np.ndarray, "N"]:
        """Angle at the centre from the optical axis, radians."""
        return np.arctan2(self.axis_distance, self.positions[:, 2])

    @cached_property
    def radius(self) -> Float[np.ndarray, "N"]:
        """Distance from the centre, metres."""
        return np.linalg.norm(self.positions, axis=1)

    @cached_property
    def outward(self) -> Float[np.ndarray, "N 3"]:
        """Unit vectors away from the optical axis, at right angles to it; zero on it."""
        planar = self.positions * [1, 1, 0]
        distance = self.axis_distance[:, None]
        return np.divide(planar, distance, out=np.zeros_like(planar), where=distance > 0)


def find_eyes(data: GNMData) -> EyeStructure:
    """Find both eyes' structure.

    Args:
        data: a model whose vertex groups name the eyes, their shells, irises and pupils.

    Raises:
        InputError: a group is missing or empty, the two shells do not make up the eyes, the eyes are no mirror images
            of one another, or one is no surface of revolution: the message says by how many millimetres.
    """
    left, right = (np.flatnonzero(members) for members in regions.eyeballs(data))
    mirrored = data.mirror_indices[left]
    if not len(left) or not np.array_equal(np.sort(mirrored), right):
        raise _error(
            "The model's eyes are no mirror images",
            expected="mirror_indices that map the left eye's vertices to the right eye's, one to one",
            got=f"{len(left)} vertices in left_eye, {len(right)} in right_eye, {np.isin(mirrored, right).sum()} mapped",
        )
    template = data.template_vertex_positions.astype(np.float64)
    exterior, interior, iris, pupil = (regions.group(data, name) > 0.5 for name in _GROUPS)
    for vertices in (left, mirrored):
        _check_shells(exterior[vertices], interior[vertices], iris[vertices], pupil[vertices])
    found = [_fit(template[v] * flip, exterior[left], iris[left]) for v, flip in ((left, 1), (mirrored, FLIP))]
    axis = found[0].axis + found[1].axis
    frame = _frame(axis / np.linalg.norm(axis))
    own = [
        (template[v] * flip - fit.centre) @ frame.T
        for v, flip, fit in zip((left, mirrored), (1, FLIP), found, strict=True)
    ]
    asymmetry = float(np.linalg.norm(own[0] - own[1], axis=1).max())
    if asymmetry > TOLERANCE:
        raise _error(
            "The model's eyes differ from one another",
            expected=f"mirror images to {MM_PER_M * TOLERANCE:.2f} mm",
            got=f"{MM_PER_M * asymmetry:.3f} mm",
        )
    deviations = [_deviation(p, exterior[left], side) for p, side in zip(own, ("left", "right"), strict=True)]
    return EyeStructure(
        left=Eye(vertices=left, centre=found[0].centre, frame=frame, deviation=deviations[0]),
        right=Eye(vertices=mirrored, centre=found[1].centre * FLIP, frame=frame * FLIP, deviation=deviations[1]),
        positions=(own[0] + own[1]) / 2,
        sclera_radius=(found[0].radius + found[1].radius) / 2,
        exterior=exterior[left],
        iris=iris[left],
        pupil=pupil[left],
        asymmetry=asymmetry,
    )


_GROUPS = ("eye_exteriors", "eye_interiors", "irises", "pupils")


@dataclass(frozen=True)
class _Spheres:
    centre: Float[np.ndarray, "3"]  # of the sclera
    radius: float  # of the sclera
    axis: Float[np.ndarray, "3"]


def _check_shells(
    exterior: Bool[np.ndarray, "N"],
    interior: Bool[np.ndarray, "N"],
    iris: Bool[np.ndarray, "N"],
    pupil: Bool[np.ndarray, "N"],
) -> None:
    if (exterior == interior).any() or (iris & exterior).any() or (pupil & ~iris).any() or not pupil.any():
        raise _error(
            "The vertex groups of the eyes do not fit together",
            expected="every vertex in one of eye_exteriors and eye_interiors, pupils in irises in eye_interiors",
            got=f"{(exterior == interior).sum()} vertices in both shells or in none, {(iris & exterior).sum()} of the "
            f"iris outside, {(pupil & ~iris).sum()} of {pupil.sum()} of the pupil not in the iris",
        )


def _fit(points: Float[np.ndarray, "N 3"], exterior: Bool[np.ndarray, "N"], iris: Bool[np.ndarray, "N"]) -> _Spheres:
    """The sclera's sphere and the optical axis of one eye."""
    shell, centre = points[exterior], points[exterior].mean(0)
    for _ in range(3):  # the rough centre moves the angles, and with them the selection, by less and less
        forward = points[iris].mean(0) - centre
        relative = shell - centre
        cosine = relative @ forward / np.maximum(np.linalg.norm(relative, axis=1) * np.linalg.norm(forward), 1e-12)
        sclera = shell[cosine < np.cos(_SCLERA_FROM)]
        centre, radius = _sphere(sclera, "sclera")
    worst = np.abs(np.linalg.norm(sclera - centre, axis=1) - radius).max()
    rise = np.linalg.norm(shell - centre, axis=1) - radius
    if worst > TOLERANCE or rise.max() < _MIN_RISE:
        raise _error(
            "The model's eye is no sclera with a cornea",
            expected=f"a sphere behind to {MM_PER_M * TOLERANCE:.2f} mm, and a cornea that rises above it by at least "
            f"{MM_PER_M * _MIN_RISE:.1f} mm",
            got=f"{MM_PER_M * worst:.3f} mm from a sphere of {MM_PER_M * radius:.2f} mm, "
            f"a rise of {MM_PER_M * rise.max():.3f} mm",
        )
    cornea, _ = _sphere(shell[rise > _CORNEA_SHARE * rise.max()], "cornea")
    axis = cornea - centre
    return _Spheres(centre, radius, axis / np.linalg.norm(axis))


def _sphere(points: Float[np.ndarray, "N 3"], what: str) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius by algebraic least squares."""
    if len(points) < _MIN_VERTICES:
        expected = f"at least {_MIN_VERTICES} vertices of the {what} in eye_exteriors"
        raise _error("The model's eyes have too few vertices", expected=expected, got=len(points))
    middle = points.mean(0)
    relative = points - middle
    A = np.concatenate([2 * relative, np.ones((len(points), 1))], 1)
    solution, *_ = np.linalg.lstsq(A, (relative**2).sum(1), rcond=None)
    centre = solution[:3]
    return centre + middle, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))


def _frame(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    up = np.array([0.0, 1.0, 0.0]) - axis[1] * axis
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, axis), up, axis])


def _deviation(points: Float[np.ndarray, "N 3"], exterior: Bool[np.ndarray, "N"], side: str) -> float:
    """The largest difference between a vertex' distance from the centre and that of the surface a quarter or half turn
    away, at the same polar angle; metres. Raises InputError if it is larger than `TOLERANCE`."""
    worst, where = 0.0, ""
    for shell, members in (("exterior", exterior), ("interior", ~exterior)):
        own = points[members]
        radius = np.linalg.norm(own, axis=1)
        angle = np.arctan2(np.hypot(own[:, 0], own[:, 1]), own[:, 2])
        azimuth = np.arctan2(own[:, 1], own[:, 0])
        order = np.argsort(angle, kind="stable")
        for i in range(len(own)):
            for turn in _TURNS:
                away = np.abs((azimuth[order] - azimuth[i] - turn + np.pi) % (2 * np.pi) - np.pi) < _SECTOR
                profile = order[away]
                if len(profile) < 2 or not angle[profile[0]] <= angle[i] <= angle[profile[-1]]:
                    continue  # nearer to a pole than that sector's vertices
                difference = abs(radius[i] - np.interp(angle[i], angle[profile], radius[profile]))
                if difference > worst:
                    worst, where = float(difference), f"the {shell} at {np.degrees(angle[i]):.0f} degrees"
    if worst > TOLERANCE:
        raise _error(
            f"The model's {side} eye is no surface of revolution",
            expected=f"the same radius in all directions around the optical axis, to {MM_PER_M * TOLERANCE:.2f} mm",
            got=f"{MM_PER_M * worst:.3f} mm, on {where} from the axis",
        )
    return worst


def _error(what: str, *, expected: object, got: object) -> InputError:
    return InputError(
        what,
        where="template_vertex_positions, vertex_groups",
        expected=expected,
        got=got,
        fix="use a model with the official eyes, or regenerate only its other parts",
    )
