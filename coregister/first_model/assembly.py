"""The parts of the first model put together, and how each follows a deformation of MakeHuman's base mesh.

Component order is the official file's: skin, left eye, right eye, upper teeth and gums, lower teeth and gums, tongue.
Every rule is linear in the base mesh' displacement, so a basis of targets becomes a basis of the model.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coregister.first_model import eyes, skin, teeth
from coregister.first_model.makehuman import MakeHuman
from coregister.first_model.part import Part
from coregister.first_model.population import Person
from coregister.first_model.skin import Skin
from coregister.first_model.teeth import Arch
from registration.geometry.quads import Subdivision, subdivide

COMPONENTS = ("skin", "left_eye", "right_eye", "upper_teeth_and_gums", "lower_teeth_and_gums", "tongue")
JOINTS = ("neck", "head", "left_eye", "right_eye")
_LID_GAP = 0.15e-3  # metres between an eyeball and the skin that lies on it
_LID_FADE = 7e-3  # metres along which a lid follows its rim
_LID_REACH = 2.0e-3  # skin this near to an eyeball's front rests on it
_SETBACK = 0.6e-3  # the eye's front behind that of MakeHuman's larger ball, so that the cornea does not lift the lids
_TONGUE_ROOM = np.array([8.2e-3, 0, 10.7e-3])  # metres from the line on which the teeth stand to its sides and tip
_HELPER_SHARE = 0.02  # weight of MakeHuman's own eye against one lid vertex, in placing an eye


@dataclass(frozen=True, kw_only=True, eq=False)
class Anatomy:
    """The first model's template and the rules by which everything follows. V vertices, B of the base mesh."""

    source: MakeHuman
    base: Float[np.ndarray, "B 3"]  # the base mesh of the mean person, metres, model frame
    skin: Skin
    parts: Mapping[str, Part]  # by component; `vertices` in the model's frame
    tongue: Subdivision
    eye_centres: Float[np.ndarray, "2 3"]  # left, right

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each component's vertices lie."""
        ends = np.cumsum([len(part.vertices) for part in self.parts.values()]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.parts, [0, *ends], ends, strict=False)}

    @cached_property
    def template(self) -> Float[np.ndarray, "V 3"]:
        """All vertices at rest, metres."""
        return np.concatenate([part.vertices for part in self.parts.values()])

    @cached_property
    def mirror(self) -> Int[np.ndarray, "V"]:
        """Every vertex' mirror image; the eyes are each other's."""
        twin = {"left_eye": "right_eye", "right_eye": "left_eye"}
        return np.concatenate([self.slices[twin.get(name, name)].start + p.mirror for name, p in self.parts.items()])

    @cached_property
    def joints(self) -> Float[np.ndarray, "J 3"]:
        """Neck, head, left eye, right eye at rest, metres."""
        places = [self.base[self.source.group(name)].mean(0) for name in ("joint-neck", "joint-head")]
        return np.concatenate([np.array(places) * (0, 1, 1), self.eye_centres])

    def identity(self, delta: Float[np.ndarray, "B 3"]) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Another person: the base mesh' displacement to displacements of vertices and joints, metres.

        Eyeballs move with their lids and keep their shape; teeth follow their helpers by the affine map that fits best.
        """
        moved_skin = self.skin.follow(delta)
        moves = {"skin": moved_skin}
        shifts = []
        for side, name in enumerate(("left_eye", "right_eye")):
            shift = self._lids_shift(side, moved_skin, delta)
            shifts.append(shift)
            moves[name] = np.broadcast_to(shift, self.parts[name].vertices.shape)
        for name, helper in (
            ("upper_teeth_and_gums", "helper-upper-teeth"),
            ("lower_teeth_and_gums", "helper-lower-teeth"),
        ):
            moves[name] = self._affine(helper, delta, self.parts[name].vertices)
        moves["tongue"] = self._tongue(delta)
        joints = [delta[self.source.group(name)].mean(0) for name in ("joint-neck", "joint-head")]
        return np.concatenate([moves[name] for name in self.parts]), np.array([*joints, *shifts])

    def expression(self, delta: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "V 3"]:
        """A face unit: the skin moves and the lower teeth with the tongue turn with the jaw, linearly (w x + t).

        Upper teeth and eyeballs stay; the tongue's own motion is `tongue_motion`. Lids slide on the eyeball.
        """
        result = np.zeros_like(self.template)
        bent = self.skin.follow(delta)
        rest = self.parts["skin"].vertices
        result[self.slices["skin"]] = off_eyes(rest + bent, self.eye_centres) - rest
        for name in ("lower_teeth_and_gums", "tongue"):
            result[self.slices[name]] = self._turned("helper-lower-teeth", delta, self.parts[name].vertices)
        return result

    def tongue_motion(self, delta: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "V 3"]:
        """What a target does to the tongue alone."""
        result = np.zeros_like(self.template)
        result[self.slices["tongue"]] = self._tongue(delta)
        return result

    def aligned(
        self, vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """The same head turned and moved, never scaled, so that face and skull lie on the template's (Kabsch 1976)."""
        stable = np.flatnonzero(self.stable_skin)  # the skin's vertices come first
        a, b = vertices[stable], self.template[stable]
        turn, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        return turn.apply(vertices - a.mean(0)) + b.mean(0), turn.apply(joints - a.mean(0)) + b.mean(0)

    def person(
        self, person: Person, moves: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """A neutral head, aligned, metres: vertices and joints. `moves`: target -> displacement of the base mesh."""
        base = self.source.vertices + sum(weight * moves[name] for name, weight in person.weights.items())
        moved, moved_joints = self.identity(base - self.base)
        vertices, joints = self.template + moved, self.joints + moved_joints
        skin = self.slices["skin"]
        vertices[skin] = off_eyes(self._lids_closed(vertices[skin], joints[2:]), joints[2:])
        return self.aligned(vertices, joints)

    @cached_property
    def stable_skin(self) -> Bool[np.ndarray, "N"]:
        """The skin's vertices on face and skull: seen from outside, above the chin, without the ears."""
        part = self.parts["skin"]
        chin = part.vertices[part.groups["chin_region"], 1].mean()
        return part.groups["skin_exterior"] & ~part.groups["ears"] & (part.vertices[:, 1] > chin)

    @cached_property
    def _lids(self) -> list[Int[np.ndarray, "N"]]:
        """Skin that rests on each eyeball's front."""
        found = []
        for centre in self.eye_centres:
            away = self.parts["skin"].vertices - centre
            near = np.linalg.norm(away, axis=1) < eyes.SCLERA_RADIUS + _LID_REACH
            found.append(np.flatnonzero(near & (away[:, 2] > 0) & self.parts["skin"].groups["skin_exterior"]))
        return found

    def _lids_closed(
        self, vertices: Float[np.ndarray, "N 3"], centres: Float[np.ndarray, "2 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """The skin with the rims of the lids on the eyeballs, whose size is the same for everyone, and the lids after.

        Along the rays from the eye's centre; what a rim is moved by fades out within `_LID_FADE`.
        """
        result = vertices.copy()
        for centre, (rim, moved, nearest, share) in zip(centres, self._rims, strict=True):
            away = vertices - centre
            lift = _LID_GAP - _above_eye(away[rim])
            outward = away[moved] / np.linalg.norm(away[moved], axis=1, keepdims=True)
            result[moved] += (share * lift[nearest])[:, None] * outward
        return result

    @cached_property
    def _rims(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Per eye: the lids' rim, the skin that follows it, which vertex of the rim each follows, and how much."""
        rest, found = self.parts["skin"].vertices, []
        for lids, centre in zip(self._lids, self.eye_centres, strict=True):
            rim = lids[_above_eye(rest[lids] - centre) < 2 * _LID_GAP]
            distance, nearest = cKDTree(rest[rim]).query(rest)
            moved = np.flatnonzero(distance < _LID_FADE)
            found.append((rim, moved, nearest[moved], (1 - (distance[moved] / _LID_FADE) ** 2) ** 2))
        return found

    def _lids_shift(
        self, side: int, moved_skin: Float[np.ndarray, "N 3"], delta: Float[np.ndarray, "B 3"]
    ) -> Float[np.ndarray, "3"]:
        """The translation that changes the lids' distances to the eyeball least [GNM, Head Identity]."""
        lids, helper = self._lids[side], self.source.group(("helper-l-eye", "helper-r-eye")[side])
        outward = self.parts["skin"].vertices[lids] - self.eye_centres[side]
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        own = np.sqrt(_HELPER_SHARE * len(lids)) * np.eye(3)
        wanted = np.concatenate([(outward * moved_skin[lids]).sum(1), own @ delta[helper].mean(0)])
        return np.asarray(np.linalg.lstsq(np.concatenate([outward, own]), wanted, rcond=None)[0])

    def _affine(self, helper: str, delta: np.ndarray, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Displacements at `points` by the affine map that fits the helper's own best."""
        rows = self.source.group(helper)
        middle = self.base[rows].mean(0)
        map_, *_ = np.linalg.lstsq(_homogeneous(self.base[rows] - middle), delta[rows], rcond=None)
        return np.asarray(_homogeneous(points - middle) @ map_)

    def _turned(self, helper: str, delta: np.ndarray, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """The helper's motion as w x + t, an infinitesimal rotation, which is linear.

        See docs/algorithms.md, "Placement of teeth and tongue".
        """
        rows = self.source.group(helper)
        middle = self.base[rows].mean(0)
        own = self.base[rows] - middle
        t = delta[rows].mean(0)
        w, *_ = np.linalg.lstsq(-_cross_matrices(own).reshape(-1, 3), (delta[rows] - t).ravel(), rcond=None)
        return np.cross(w, points - middle) + t

    def _tongue(self, delta: np.ndarray) -> Float[np.ndarray, "N 3"]:
        return np.asarray(self.tongue.weights @ delta[self.source.group("helper-tongue")])


def make(source: MakeHuman, person: Person) -> Anatomy:
    """The template: this person's head with procedural eyes and teeth in it, eyes where GNM's frame has them."""
    base = source.vertices + sum(weight * source.target(name) for name, weight in person.weights.items())
    base = (base + base[source.mirror] * (-1, 1, 1)) / 2
    balls = [base[source.group(name)] for name in ("helper-l-eye", "helper-r-eye")]
    base = base + np.array([0, _EYES[0], _EYES[1]]) - np.concatenate(balls).mean(0) * (0, 1, 1)
    made = skin.make(source)
    centre = _eye_centre(base[source.group("helper-l-eye")])
    centres = np.stack([centre, centre * (-1, 1, 1)])
    surface = made.follow(base)
    surface = off_eyes((surface + surface[made.part.mirror] * (-1, 1, 1)) / 2, centres)
    ball = eyes.eyeball()
    where = teeth.arch(base[source.group("helper-upper-teeth")], base[source.group("helper-lower-teeth")])
    tongue, subdivision = _tongue_part(source, base, where)
    parts = {
        "skin": _moved(made.part, surface),
        "left_eye": _moved(ball, ball.vertices + centres[0], "left_eye"),
        "right_eye": _moved(ball, ball.vertices + centres[1], "right_eye"),
        "upper_teeth_and_gums": teeth.upper(where),
        "lower_teeth_and_gums": teeth.lower(where),
        "tongue": tongue,
    }
    return Anatomy(source=source, base=base, skin=made, parts=parts, tongue=subdivision, eye_centres=centres)


_EYES = (0.3031, 0.0989)  # metres, y and z of the eyes in GNM's template


def _eye_centre(helper: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Where our smaller ball stands for its front to lie just behind that of MakeHuman's."""
    middle = helper.mean(0)
    front = helper[:, 2].max()
    return np.array([middle[0], middle[1], front - eyes.SCLERA_RADIUS - _SETBACK])


def off_eyes(vertices: Float[np.ndarray, "V 3"], centres: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "V 3"]:
    """The skin's vertices with those inside an eyeball pushed out of it, along the rays from its centre."""
    result = vertices.copy()
    for centre in centres:
        away = result - centre
        lack = np.maximum(_LID_GAP - _above_eye(away), 0)
        result += away * (lack / np.maximum(np.linalg.norm(away, axis=1), 1e-9))[:, None]
    return result


def _above_eye(away: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """How far points, relative to an eye's centre, lie outside the ball that looks along +Z; metres, along the ray."""
    distance = np.linalg.norm(away, axis=1)
    angle = np.arccos(np.clip(away[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    return distance - eyes.radius_at(angle, np.array(eyes.LIMBUS_RADIUS), np.array(eyes.CORNEA_RADIUS))


def _tongue_part(source: MakeHuman, base: Float[np.ndarray, "B 3"], where: Arch) -> tuple[Part, Subdivision]:
    """MakeHuman's tongue, subdivided, attached to nothing, made to lie within the teeth; its own uvs."""
    rows, coarse = np.unique(source.quads["helper-tongue"], return_inverse=True)
    fine = subdivide(coarse.reshape(-1, 4), np.searchsorted(rows, source.mirror[rows]))
    corners = source.uvs[source.uv_quads["helper-tongue"]]
    low, high = corners.min((0, 1)), corners.max((0, 1))
    vertices = np.asarray(fine.weights @ base[rows])
    vertices = (vertices + vertices[fine.mirror] * (-1, 1, 1)) / 2
    root, tip = vertices.min(0) * (0, 1, 1), vertices.max(0)
    share = (np.array([where.half_width, 0, where.front]) - _TONGUE_ROOM - root) / (tip - root)
    part = Part(
        vertices=root + (vertices - root) * (min(1.0, share[0]), 1, min(1.0, share[2])),
        quads=fine.quads,
        quad_uvs=skin.fine_corners((corners - low) / (high - low)),
        groups={"tongue": np.ones(len(vertices), bool)},
        mirror=fine.mirror,
    )
    return part, fine


def _moved(part: Part, vertices: Float[np.ndarray, "V 3"], *names: str) -> Part:
    """The part elsewhere, all of it also in groups of these names."""
    everything = {name: np.ones(len(vertices), bool) for name in names}
    groups = {**part.groups, **everything}
    return Part(vertices=vertices, quads=part.quads, quad_uvs=part.quad_uvs, groups=groups, mirror=part.mirror)


def _homogeneous(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    return np.concatenate([points, np.ones((len(points), 1))], 1)


def _cross_matrices(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """[p]_x of each point: [p]_x w = p x w."""
    x, y, z = points.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], 1)
