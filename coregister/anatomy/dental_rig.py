"""A rig on a model's own teeth: every tooth moves, turns and scales in its own frame, the gums follow.

A tooth stands at an arc length of its arch's curve and moves along it with the curve's direction, so that a longer arch
or a wider neighbour carries it around the bend. Neighbours keep in contact: the arc lengths are solved for the gaps
between them, from the midline outwards. The gums are a smooth function of the displacements of the teeth's necks
(polyharmonic, with the biharmonic kernel |r| of three dimensions). Where teeth are pieces of their own, what of them is
inside the gum moves with it, so that no neck comes out of it. Metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from registration.anatomy.tooth_structure import DentalArch, Tooth
from registration.geometry.closest_point import closest_points

_CONTACT_STEPS = 4  # of the arc length: each removes nearly the whole error of the gap
_CONTACT_REACH = 0.6  # cosine: contact directions lie so near to the line between both teeth
_MIN_GAP = 5e-5  # between neighbours; narrower ones of the template, and overlaps, are opened to it
_PIVOT = 0.6  # of a crown's height from the neck: where it turns
_SMOOTHING_MM = 3.0  # of the gum that is a piece of its own, so that its large triangles do not fold between teeth
_WORN = 0.5  # of a crown's height from the neck: what lies beyond wears


@dataclass(frozen=True, kw_only=True, eq=False)
class ToothPose:
    """How S samples of one tooth differ from the template; lengths in metres along m, b, h of the tooth."""

    turn: Float[np.ndarray, "S 3"]  # rotation vector about m, b, h, radians
    shift: Float[np.ndarray, "S 3"]
    scale: Float[np.ndarray, "S 3"]  # width, depth, height
    wear: Float[np.ndarray, "S"]  # by which the biting edge is shorter
    kept: Float[np.ndarray, "S 3"]  # factors of the finished tooth's size, which leave its place to it: 1, or a remnant


@dataclass(frozen=True, kw_only=True, eq=False)
class ArchPose:
    """How S samples of one arch differ from the template."""

    width: Float[np.ndarray, "S"]  # factor
    length: Float[np.ndarray, "S"]  # factor
    shift: Float[np.ndarray, "S 3"]  # of all teeth and the gum: left, forwards, upwards in the arch's plane, metres
    teeth: Sequence[ToothPose]  # in the arch's order
    gaps: Float[np.ndarray, "S T"]  # added to the template's gap behind each tooth, counted from the midline


@dataclass(frozen=True, kw_only=True, eq=False)
class _RiggedTooth:
    tooth: Tooth
    local: Float[np.ndarray, "N 3"]  # vertices along m, b, h from the tooth's origin
    worn: Float[np.ndarray, "N"]  # share of the wear, 0 at the middle of the crown, 1 at its biting edge
    pivot: float  # along h: where it turns
    edge: float  # along h: its biting edge, which stays where it is if the tooth is higher
    arc: float  # where it stands in the template
    offset: Float[np.ndarray, "3"]  # of its origin from the curve: along, outwards, upwards
    axes: Float[np.ndarray, "3 3"]  # rows m, b, h in these directions


@dataclass(frozen=True, kw_only=True, eq=False)
class _Contact:
    """Two neighbours: the direction from the inner to the outer one in which the template's gap is widest."""

    inner: int
    outer: int
    direction: Float[np.ndarray, "3"]  # along, outwards, upwards at the middle between both
    gap: float


@dataclass(eq=False)
class RiggedArch:
    """The rig of one arch."""

    arch: DentalArch
    template: Float[np.ndarray, "V 3"]  # of the whole model
    teeth: list[_RiggedTooth] = field(init=False)
    contacts: list[_Contact] = field(init=False)

    def __post_init__(self) -> None:
        self.teeth = [self._rigged(tooth) for tooth in self.arch.teeth]
        half = len(self.teeth) // 2
        pairs = [(k, k - 1) for k in range(half - 1, 0, -1)] + [(k, k + 1) for k in range(half, 2 * half - 1)]
        self.contacts = [self._contact(inner, outer) for inner, outer in pairs]
        own_pieces = not all(tooth.crown.all() for tooth in self.arch.teeth)
        smoothing = _SMOOTHING_MM if own_pieces else 0.0
        self._follow = _following(self._necks(self.template), self.template[self.arch.gum], smoothing)
        self._roots = [
            _on_gum(self.template[t.vertices[~t.crown]], self.template, self.arch)
            if not t.crown.all()
            else np.zeros((0, len(self.arch.gum)))
            for t in self.arch.teeth
        ]

    def vertices(self, pose: ArchPose) -> tuple[list[Float[np.ndarray, "S N 3"]], Float[np.ndarray, "S G 3"]]:
        """Return the vertices of every tooth, in the arch's order, and of the gum."""
        arcs = self._arcs(pose)
        teeth = [self._placed(k, pose, arcs[:, k]) for k in range(len(self.teeth))]
        necks = [self._neck(tooth.tooth, points) for tooth, points in zip(self.teeth, teeth, strict=True)]
        moved = np.concatenate(necks, 1) - self._necks(self.template)
        follow = np.einsum("gl,slc->sgc", self._follow, moved)
        for points, rig, root in zip(teeth, self.teeth, self._roots, strict=True):
            buried = ~rig.tooth.crown
            points[:, buried] = self.template[rig.tooth.vertices[buried]] + np.einsum("ng,sgc->snc", root, follow)
        return teeth, self.template[self.arch.gum] + follow

    def _rigged(self, tooth: Tooth) -> _RiggedTooth:
        curve = self.arch.curve
        local = (self.template[tooth.vertices] - tooth.origin) @ tooth.axes.T
        reach = float(local[:, 2].max())
        arc = curve.locate(tooth.origin)
        point, heading = curve.at(np.array(arc))
        frame = _frames(heading)
        return _RiggedTooth(
            tooth=tooth,
            local=local,
            pivot=_PIVOT * reach,
            edge=reach,
            worn=np.clip((local[:, 2] / reach - _WORN) / (1 - _WORN), 0, 1) ** 2,
            arc=arc,
            offset=frame @ (curve.plane @ (tooth.origin - curve.centre) - point),
            axes=tooth.axes @ curve.plane.T @ frame.T,
        )

    def _placed(
        self, k: int, pose: ArchPose, arc: Float[np.ndarray, "S"], rows: Int[np.ndarray, "M"] | None = None
    ) -> Float[np.ndarray, "S M 3"]:
        """Vertices of a tooth in the model's frame: some rows of the complete tooth, or all of what is kept of it."""
        rig, tooth, curve = self.teeth[k], pose.teeth[k], self.arch.curve
        local, worn = (rig.local, rig.worn) if rows is None else (rig.local[rows], rig.worn[rows])
        local = (local - [0, 0, rig.edge]) * tooth.scale[:, None]
        local[..., 2] += rig.edge - rig.pivot - tooth.wear[:, None] * worn
        if rows is None:
            neck = -rig.pivot  # of an unscaled tooth
            local = (local - [0, 0, neck]) * tooth.kept[:, None] + [0, 0, neck]
        local = local @ _rotations(tooth.turn).transpose(0, 2, 1) + tooth.shift[:, None]
        local[..., 2] += rig.pivot
        point, frame = self._curve(pose, arc)
        along = rig.offset + local @ rig.axes
        return (point[:, None] + along @ frame) @ curve.plane + curve.centre

    def _curve(
        self, pose: ArchPose, arc: Float[np.ndarray, "S"]
    ) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3 3"]]:
        """Points of the posed curve in its plane, and the frames there: rows along, outwards, upwards."""
        point, heading = self.arch.curve.at(arc)
        stretch = np.stack([pose.width, pose.length], 1)
        heading = np.arctan2(stretch[:, 1] * np.sin(heading), stretch[:, 0] * np.cos(heading))
        point = np.concatenate([point[:, :2] * stretch, point[:, 2:]], 1) + pose.shift
        return point, _frames(heading)

    def _direction(self, pose: ArchPose, contact: _Contact, arcs: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
        _, frame = self._curve(pose, arcs.mean(1))
        return np.einsum("k,skc->sc", contact.direction, frame) @ self.arch.curve.plane

    def _arcs(self, pose: ArchPose) -> Float[np.ndarray, "S T"]:
        """Solve the arc lengths: the central incisors beside the midline, then each tooth behind the one before it."""
        count, half = len(pose.width), len(self.teeth) // 2
        arcs = np.tile([rig.arc for rig in self.teeth], (count, 1))
        middle = np.zeros((count, 2))
        centre = self._curve(pose, middle[:, 0])[0] @ self.arch.curve.plane + self.arch.curve.centre
        between = self._contact(half - 1, half)
        away = self._direction(pose, between, middle)
        for k, sign in ((half - 1, -1), (half, 1)):
            wanted = (max(between.gap, _MIN_GAP) + pose.gaps[:, k]) / 2
            for _ in range(_CONTACT_STEPS):
                points = self._crown(k, pose, arcs[:, k]) - centre[:, None]
                gap = (sign * np.einsum("snc,sc->sn", points, away)).min(1)
                arcs[:, k] += sign * (wanted - gap)
        for contact in self.contacts:
            inner, outer = contact.inner, contact.outer
            placed, sign = self._crown(inner, pose, arcs[:, inner]), 1 if outer > inner else -1
            wanted = max(contact.gap, _MIN_GAP) + pose.gaps[:, outer]
            arcs[:, outer] = arcs[:, inner] + (self.teeth[outer].arc - self.teeth[inner].arc)
            for _ in range(_CONTACT_STEPS):
                direction = self._direction(pose, contact, arcs[:, [inner, outer]])
                moving = self._crown(outer, pose, arcs[:, outer])
                gap = _gaps(placed, moving, direction)
                arcs[:, outer] += sign * (wanted - gap)
        return arcs

    def _crown(self, k: int, pose: ArchPose, arc: Float[np.ndarray, "S"]) -> Float[np.ndarray, "S M 3"]:
        return self._placed(k, pose, arc, np.flatnonzero(self.teeth[k].tooth.crown))

    def _contact(self, inner: int, outer: int) -> _Contact:
        first, second = self.teeth[inner], self.teeth[outer]
        points = [self.template[rig.tooth.vertices[rig.tooth.crown]] for rig in (first, second)]
        line = second.tooth.origin - first.tooth.origin
        directions = _even_directions(4000)
        directions = directions[directions @ line > _CONTACT_REACH * np.linalg.norm(line)]
        gaps = (directions @ points[1].T).min(1) - (directions @ points[0].T).max(1)
        best = int(gaps.argmax())
        _, heading = self.arch.curve.at(np.array((first.arc + second.arc) / 2))
        direction = _frames(heading) @ self.arch.curve.plane @ directions[best]
        return _Contact(inner=inner, outer=outer, direction=direction, gap=float(gaps[best]))

    @staticmethod
    def _neck(tooth: Tooth, points: Float[np.ndarray, "S N 3"]) -> Float[np.ndarray, "S L 3"]:
        rows = np.searchsorted(tooth.vertices, tooth.neck)
        weight = tooth.neck_weights[:, None]
        return (1 - weight) * points[:, rows[:, 0]] + weight * points[:, rows[:, 1]]

    def _necks(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "L 3"]:
        return np.concatenate([tooth.neck_line(vertices) for tooth in self.arch.teeth])


def _gaps(
    inner: Float[np.ndarray, "S N 3"], outer: Float[np.ndarray, "S M 3"], direction: Float[np.ndarray, "S 3"]
) -> Float[np.ndarray, "S"]:
    """The width of the slab across `direction` that separates two point sets; negative if they overlap in it."""
    return np.einsum("snc,sc->sn", outer, direction).min(1) - np.einsum("snc,sc->sn", inner, direction).max(1)


def _frames(heading: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 3 3"]:
    """Rows along, outwards and upwards in the arch's plane (left, forwards, upwards)."""
    c, s, o, i = np.cos(heading), np.sin(heading), np.zeros_like(heading), np.ones_like(heading)
    return np.stack([np.stack([c, s, o], -1), np.stack([-s, c, o], -1), np.stack([o, o, i], -1)], -2)


def _even_directions(count: int) -> Float[np.ndarray, "N 3"]:
    """Unit vectors in all directions, on a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)


def _rotations(vectors: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3 3"]:
    return Rotation.from_rotvec(vectors).as_matrix()


def _on_gum(
    points: Float[np.ndarray, "P 3"], template: Float[np.ndarray, "V 3"], arch: DentalArch
) -> Float[np.ndarray, "P G"]:
    """The weights of the gum's vertices at the nearest points of its surface; the gum has triangles of its own."""
    _, face, weight = closest_points(points, template, arch.gum_triangles)
    weights = np.zeros((len(points), len(arch.gum)))
    corners = np.searchsorted(arch.gum, arch.gum_triangles[face])
    np.add.at(weights, (np.arange(len(points))[:, None], corners), weight)
    return weights


def _following(
    necks: Float[np.ndarray, "L 3"], gum: Float[np.ndarray, "G 3"], smoothing: float
) -> Float[np.ndarray, "G L"]:
    """The matrix that carries displacements of the necks to the gum: a smoothing spline of |r| with an affine part.

    Args:
        necks: their points, metres.
        gum: points at which the displacement is wanted.
        smoothing: 0: the spline takes the given values at the necks; larger: smoother. Millimetres.
    """
    unit = 1e-3  # numbers of similar size in the system
    centre = necks.mean(0)
    points, targets = (necks - centre) / unit, (gum - centre) / unit
    count = len(points)
    affine = np.concatenate([np.ones((count, 1)), points], 1)
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = smoothing * np.eye(count) - np.linalg.norm(points[:, None] - points, axis=-1)
    system[:count, count:], system[count:, :count] = affine, affine.T
    right = np.zeros((count + 4, count))
    right[:count] = np.eye(count)
    weights = np.linalg.lstsq(system, right, rcond=1e-12)[0]  # two teeth may share a point of their necks
    kernel = -np.linalg.norm(targets[:, None] - points, axis=-1)
    return np.concatenate([kernel, np.ones((len(targets), 1)), targets], 1) @ weights
