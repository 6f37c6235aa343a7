"""Assembly of the first model's parts, and how each part follows a deformation of MakeHuman's base mesh.

The order of the components is the official file's: skin, left eye, right eye, upper teeth and gums, lower teeth and
gums, tongue. Every rule is linear in the displacement of the base mesh, so a basis of targets becomes a basis of the
model. Sources: [GNM, Internal Anatomy], [GNM, Initial Placement of Teeth and Tongue].
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coregister.anatomy import eye_sections
from coregister.first_model import dental_arch, eyes, skin, teeth
from coregister.first_model.dental_arch import Arch
from coregister.first_model.makehuman import MakeHuman
from coregister.first_model.part import MeshPart
from coregister.first_model.population import SyntheticPerson
from coregister.first_model.skin import Skin
from registration.geometry.quads import Subdivision, subdivide

COMPONENTS = ("skin", "left_eye", "right_eye", "upper_teeth_and_gums", "lower_teeth_and_gums", "tongue")
JOINTS = ("neck", "head", "left_eye", "right_eye")
# Lengths in metres.
_EYES_Y, _EYES_Z = 0.3031, 0.0989  # position of the eyes in the template of the official model
_LID_GAP = 0.15e-3  # between an eyeball and the skin on it
_LID_FALLOFF = 7e-3  # distance along which a lid follows its rim
_LID_DISTANCE = 2.0e-3  # skin this close to an eyeball's front rests on it
_SETBACK = 0.6e-3  # of the eye's front behind MakeHuman's larger eyeball, so that the cornea does not lift the lids
_TONGUE_CLEARANCE = np.array([8.2e-3, 0, 10.7e-3])  # from the curve of the teeth to the tongue's sides and tip
_HELPER_WEIGHT = 0.02  # of MakeHuman's own eyeball relative to all lid vertices, in the placement of an eye


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadAssembly:
    """The first model's template and its deformation rules. V vertices of the model, B of the base mesh; metres."""

    source: MakeHuman
    base: Float[np.ndarray, "B 3"]  # the mean person's base mesh, model frame
    skin: Skin
    parts: Mapping[str, MeshPart]  # by component, in the model's frame
    tongue: Subdivision
    eye_centres: Float[np.ndarray, "2 3"]  # left, right

    @cached_property
    def slices(self) -> dict[str, slice]:
        """The vertex range of each component."""
        ends = np.cumsum([len(part.vertices) for part in self.parts.values()]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.parts, [0, *ends], ends, strict=False)}

    @cached_property
    def template(self) -> Float[np.ndarray, "V 3"]:
        """All vertices of the neutral mean person."""
        return np.concatenate([part.vertices for part in self.parts.values()])

    @cached_property
    def mirror(self) -> Int[np.ndarray, "V"]:
        """The mirror image of every vertex; the two eyes are mirror images of each other."""
        opposite = {"left_eye": "right_eye", "right_eye": "left_eye"}
        return np.concatenate(
            [self.slices[opposite.get(name, name)].start + p.mirror for name, p in self.parts.items()]
        )

    @cached_property
    def joints(self) -> Float[np.ndarray, "J 3"]:
        """Positions of neck, head, left eye and right eye at rest."""
        positions = [self.base[self.source.group(name)].mean(0) for name in ("joint-neck", "joint-head")]
        return np.concatenate([np.array(positions) * (0, 1, 1), self.eye_centres])

    def identity_displacement(
        self, delta: Float[np.ndarray, "B 3"]
    ) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Return the displacements of vertices and joints for another person, metres.

        Eyeballs are translated with their lids; teeth follow the best affine map of MakeHuman's tooth helpers.

        Args:
            delta: displacement of the base mesh from the mean person, metres.
        """
        skin_delta = self.skin.follow(delta)
        deltas = {"skin": skin_delta}
        eye_translations = []
        for side, name in enumerate(("left_eye", "right_eye")):
            translation = self._eye_translation(side, skin_delta, delta)
            eye_translations.append(translation)
            deltas[name] = np.broadcast_to(translation, self.parts[name].vertices.shape)
        for name, helper in (
            ("upper_teeth_and_gums", "helper-upper-teeth"),
            ("lower_teeth_and_gums", "helper-lower-teeth"),
        ):
            deltas[name] = self._affine_displacement(helper, delta, self.parts[name].vertices)
        deltas["tongue"] = self._helper_tongue(delta)
        joints = [delta[self.source.group(name)].mean(0) for name in ("joint-neck", "joint-head")]
        return np.concatenate([deltas[name] for name in self.parts]), np.array([*joints, *eye_translations])

    def expression_displacement(self, delta: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "V 3"]:
        """Return the displacement of a face unit, metres.

        The lower teeth and the tongue follow the jaw by a linearized rigid motion; upper teeth and eyeballs are fixed,
        and lids slide on the eyeballs. The tongue's own motion is `tongue_displacement`.

        Args:
            delta: displacement of the base mesh, metres.
        """
        result = np.zeros_like(self.template)
        skin_delta = self.skin.follow(delta)
        rest = self.parts["skin"].vertices
        result[self.slices["skin"]] = push_out_of_eyes(rest + skin_delta, self.eye_centres) - rest
        for name in ("lower_teeth_and_gums", "tongue"):
            result[self.slices[name]] = self._twist_displacement("helper-lower-teeth", delta, self.parts[name].vertices)
        return result

    def tongue_displacement(self, delta: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "V 3"]:
        """Return the displacement of the tongue alone, zero elsewhere, for a displacement of the base mesh; metres."""
        result = np.zeros_like(self.template)
        result[self.slices["tongue"]] = self._helper_tongue(delta)
        return result

    def align(
        self, vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Align a head rigidly with the template by its stable skin [Kabsch 1976].

        Args:
            vertices: of the head, metres.
            joints: of the head, metres.

        Returns:
            The transformed vertices and joints; the scale is unchanged.
        """
        stable = np.flatnonzero(self.stable_skin)  # the skin's vertices come first
        a, b = vertices[stable], self.template[stable]
        rotation, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        return rotation.apply(vertices - a.mean(0)) + b.mean(0), rotation.apply(joints - a.mean(0)) + b.mean(0)

    def assemble(
        self, person: SyntheticPerson, targets: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Build a person's neutral head, aligned with the template.

        The eyes look ahead whatever the head's shape: eyeballs are translated, never turned [GNM, Head Identity].

        Args:
            person: weights of MakeHuman's targets.
            targets: displacement of the base mesh (B, 3) by target name, metres; all of the person's targets.

        Returns:
            Vertices and joints, metres.
        """
        base = self.source.vertices + sum(weight * targets[name] for name, weight in person.weights.items())
        delta, joint_delta = self.identity_displacement(base - self.base)
        vertices, joints = self.align(self.template + delta, self.joints + joint_delta)
        for name, centre, rest in zip(("left_eye", "right_eye"), joints[2:], self.eye_centres, strict=True):
            vertices[self.slices[name]] = self.parts[name].vertices + (centre - rest)
        skin = self.slices["skin"]
        vertices[skin] = push_out_of_eyes(self._lids_on_eyes(vertices[skin], joints[2:]), joints[2:])
        return vertices, joints

    @cached_property
    def stable_skin(self) -> Bool[np.ndarray, "N"]:
        """The skin's vertices that alignment uses: exterior, above the chin, without the ears."""
        part = self.parts["skin"]
        chin = part.vertices[part.groups["chin_region"], 1].mean()
        return part.groups["skin_exterior"] & ~part.groups["ears"] & (part.vertices[:, 1] > chin)

    @cached_property
    def _lids(self) -> list[Int[np.ndarray, "N"]]:
        """Per eye: the skin's vertices on the eyeball's front."""
        lids = []
        for centre in self.eye_centres:
            relative = self.parts["skin"].vertices - centre
            near = np.linalg.norm(relative, axis=1) < eye_sections.SCLERA_RADIUS + _LID_DISTANCE
            lids.append(np.flatnonzero(near & (relative[:, 2] > 0) & self.parts["skin"].groups["skin_exterior"]))
        return lids

    def _lids_on_eyes(
        self, vertices: Float[np.ndarray, "N 3"], centres: Float[np.ndarray, "2 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Return the skin with the rims of the lids on the eyeballs, whose size is the same for everyone.

        Rims move along rays from the eye's centre; the skin around follows them and is fixed beyond `_LID_FALLOFF`.
        """
        result = vertices.copy()
        for centre, (rim, followers, nearest, weight) in zip(centres, self._lid_rims, strict=True):
            relative = vertices - centre
            lift = _LID_GAP - _height_above_eye(relative[rim])
            outward = relative[followers] / np.linalg.norm(relative[followers], axis=1, keepdims=True)
            result[followers] += (weight * lift[nearest])[:, None] * outward
        return result

    @cached_property
    def _lid_rims(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Per eye: the rim of the lids, the skin that follows it, the rim vertex that each follows, and its weight."""
        rest, rims = self.parts["skin"].vertices, []
        for lids, centre in zip(self._lids, self.eye_centres, strict=True):
            rim = lids[_height_above_eye(rest[lids] - centre) < 2 * _LID_GAP]
            distance, nearest = cKDTree(rest[rim]).query(rest)
            followers = np.flatnonzero(distance < _LID_FALLOFF)
            weight = (1 - (distance[followers] / _LID_FALLOFF) ** 2) ** 2
            rims.append((rim, followers, nearest[followers], weight))
        return rims

    def _eye_translation(
        self, side: int, skin_delta: Float[np.ndarray, "N 3"], delta: Float[np.ndarray, "B 3"]
    ) -> Float[np.ndarray, "3"]:
        """Return the eyeball translation that changes the lids' distances to it least [GNM, Head Identity]."""
        lids, helper = self._lids[side], self.source.group(("helper-l-eye", "helper-r-eye")[side])
        outward = self.parts["skin"].vertices[lids] - self.eye_centres[side]
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        prior = np.sqrt(_HELPER_WEIGHT * len(lids)) * np.eye(3)
        right = np.concatenate([(outward * skin_delta[lids]).sum(1), prior @ delta[helper].mean(0)])
        return np.asarray(np.linalg.lstsq(np.concatenate([outward, prior]), right, rcond=None)[0])

    def _affine_displacement(
        self, helper: str, delta: np.ndarray, points: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Return displacements of points by the least-squares affine map of a helper's displacements."""
        rows = self.source.group(helper)
        centre = self.base[rows].mean(0)
        affine, *_ = np.linalg.lstsq(_homogeneous(self.base[rows] - centre), delta[rows], rcond=None)
        return np.asarray(_homogeneous(points - centre) @ affine)

    def _twist_displacement(
        self, helper: str, delta: np.ndarray, points: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Return displacements w x p + t of points, with the least-squares twist (w, t) of a helper's displacements.

        A twist is linear in the displacement, unlike a rotation. See docs/algorithms.md, "Placement of teeth and
        tongue".
        """
        rows = self.source.group(helper)
        centre = self.base[rows].mean(0)
        relative = self.base[rows] - centre
        t = delta[rows].mean(0)
        w, *_ = np.linalg.lstsq(-_cross_matrices(relative).reshape(-1, 3), (delta[rows] - t).ravel(), rcond=None)
        return np.cross(w, points - centre) + t

    def _helper_tongue(self, delta: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """Return MakeHuman's own displacement of the tongue."""
        return np.asarray(self.tongue.weights @ delta[self.source.group("helper-tongue")])


def build_assembly(source: MakeHuman, person: SyntheticPerson) -> HeadAssembly:
    """Build the template: a person's head with procedural eyes and teeth, in the model's frame.

    Args:
        source: MakeHuman's head.
        person: the template's person.
    """
    base = source.vertices + sum(weight * source.target(name) for name, weight in person.weights.items())
    base = skin.symmetrize(base, source.mirror)
    eyeballs = [base[source.group(name)] for name in ("helper-l-eye", "helper-r-eye")]
    base = base + np.array([0, _EYES_Y, _EYES_Z]) - np.concatenate(eyeballs).mean(0) * (0, 1, 1)
    head_skin = skin.build_skin(source)
    centre = _eye_centre(base[source.group("helper-l-eye")])
    centres = np.stack([centre, centre * (-1, 1, 1)])
    surface = skin.symmetrize(head_skin.follow(base), head_skin.part.mirror)
    surface = push_out_of_eyes(surface, centres)
    ball = eyes.eyeball()
    arch = dental_arch.fit_arch(base[source.group("helper-upper-teeth")], base[source.group("helper-lower-teeth")])
    tongue, subdivision = _tongue_part(source, base, arch)
    parts = {
        "skin": _with_vertices(head_skin.part, surface),
        "left_eye": _with_vertices(ball, ball.vertices + centres[0], "left_eye"),
        "right_eye": _with_vertices(ball, ball.vertices + centres[1], "right_eye"),
        "upper_teeth_and_gums": teeth.upper_teeth(arch),
        "lower_teeth_and_gums": teeth.lower_teeth(arch),
        "tongue": tongue,
    }
    return HeadAssembly(source=source, base=base, skin=head_skin, parts=parts, tongue=subdivision, eye_centres=centres)


def _eye_centre(helper: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Return the centre that puts the front of our smaller eyeball just behind that of MakeHuman's."""
    centre = helper.mean(0)
    front = helper[:, 2].max()
    return np.array([centre[0], centre[1], front - eye_sections.SCLERA_RADIUS - _SETBACK])


def push_out_of_eyes(vertices: Float[np.ndarray, "V 3"], centres: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "V 3"]:
    """Return vertices with those inside an eyeball moved out of it along rays from its centre; metres."""
    result = vertices.copy()
    for centre in centres:
        relative = result - centre
        depth = np.maximum(_LID_GAP - _height_above_eye(relative), 0)
        result += relative * (depth / np.maximum(np.linalg.norm(relative, axis=1), 1e-9))[:, None]
    return result


def _height_above_eye(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Return the distance outside an eyeball that looks along +Z, along rays from its centre, the origin; metres."""
    distance = np.linalg.norm(points, axis=1)
    angle = np.arccos(np.clip(points[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    return distance - eye_sections.radius_at(
        angle, np.array(eye_sections.LIMBUS_RADIUS), np.array(eye_sections.CORNEA_RADIUS)
    )


def _tongue_part(source: MakeHuman, base: Float[np.ndarray, "B 3"], arch: Arch) -> tuple[MeshPart, Subdivision]:
    """Return MakeHuman's tongue, detached, subdivided and scaled to fit inside the teeth, with its own uv chart."""
    rows, coarse = np.unique(source.quads["helper-tongue"], return_inverse=True)
    fine = subdivide(coarse.reshape(-1, 4), np.searchsorted(rows, source.mirror[rows]))
    corners = source.uvs[source.uv_quads["helper-tongue"]]
    low, high = corners.min((0, 1)), corners.max((0, 1))
    vertices = skin.symmetrize(np.asarray(fine.weights @ base[rows]), fine.mirror)
    root, tip = vertices.min(0) * (0, 1, 1), vertices.max(0)
    scale = (np.array([arch.half_width, 0, arch.front]) - _TONGUE_CLEARANCE - root) / (tip - root)
    part = MeshPart(
        vertices=root + (vertices - root) * (min(1.0, scale[0]), 1, min(1.0, scale[2])),
        quads=fine.quads,
        quad_uvs=skin.fine_corners((corners - low) / (high - low)),
        groups={"tongue": np.ones(len(vertices), bool)},
        mirror=fine.mirror,
    )
    return part, fine


def _with_vertices(part: MeshPart, vertices: Float[np.ndarray, "V 3"], *groups: str) -> MeshPart:
    """Return the part with other vertices, all of them also members of `groups`."""
    return replace(part, vertices=vertices, groups={**part.groups, **{n: np.ones(len(vertices), bool) for n in groups}})


def _homogeneous(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    return np.concatenate([points, np.ones((len(points), 1))], 1)


def _cross_matrices(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Return the matrix [p]_x of each point: [p]_x w = p x w."""
    x, y, z = points.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], 1)
