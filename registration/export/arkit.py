"""ARKit's 52 blend shapes of any GNM model: motions of places on the head, solved in its expression basis.

Each shape is the most probable expression of the model (its coefficients are independent and normal) that moves the
places of `arkit_targets` as it should and leaves the rest of the skin where it is: regularized linear least squares.
The basis is the model's with its mirror image, and right shapes are defined as left ones on the mirrored head.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from registration.export.arkit_anatomy import Anatomy
from registration.export.arkit_targets import OPPOSITE, Target, closing, left_targets, middle_targets, sideways_targets
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

NAMES = tuple(
    """
eyeBlinkLeft eyeLookDownLeft eyeLookInLeft eyeLookOutLeft eyeLookUpLeft eyeSquintLeft eyeWideLeft
eyeBlinkRight eyeLookDownRight eyeLookInRight eyeLookOutRight eyeLookUpRight eyeSquintRight eyeWideRight
jawForward jawLeft jawRight jawOpen
mouthClose mouthFunnel mouthPucker mouthLeft mouthRight mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight
mouthDimpleLeft mouthDimpleRight mouthStretchLeft mouthStretchRight mouthRollLower mouthRollUpper mouthShrugLower
mouthShrugUpper mouthPressLeft mouthPressRight mouthLowerDownLeft mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight
browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight
cheekPuff cheekSquintLeft cheekSquintRight noseSneerLeft noseSneerRight tongueOut
""".split()
)
LEAST_COVERAGE = 0.5  # of a shape's motion; a shape of which the basis has less is not exported
_FIT = 3e-4  # m, standard deviation of a place's motion
_REST = 4e-4  # m, of the skin that stays
_EVERY = 3  # of the skin that stays, one vertex in so many is compared
_SPREAD = 4.0  # standard deviations of the model's coefficients: ARKit's shapes are extreme


@dataclass(frozen=True, kw_only=True, eq=False)
class ArkitShape:
    """A solved shape."""

    displacement: Float[np.ndarray, "V 3"]  # metres, at weight 1
    coverage: float  # fraction of the wanted motion, in squares, that the basis makes; at most 1
    residual_mm: float  # rms of what is missing at the places that should move or stay
    elsewhere_mm: float  # rms motion of the skin that should stay


@dataclass(frozen=True, kw_only=True, eq=False)
class ArkitShapes:
    """The shapes of a head."""

    shapes: Mapping[str, ArkitShape]  # in the order of NAMES; those of sufficient coverage
    missing: Mapping[str, ArkitShape]  # that the basis cannot express

    @property
    def displacements(self) -> dict[str, Float[np.ndarray, "V 3"]]:
        """By name, metres at weight 1."""
        return {name: shape.displacement for name, shape in self.shapes.items()}


def arkit_shapes(data: GNMData, points: Float[np.ndarray, "V 3"]) -> ArkitShapes:
    """Solve the 52 shapes on a head.

    Args:
        data: the model, whose expression basis is used.
        points: a head of its topology without expression, in its frame, metres.

    Raises:
        InputError: as `Anatomy.of`.
    """
    points = points.astype(np.float64)
    mirror = data.mirror_indices.astype(np.int64)
    head, mirrored = Anatomy.of(data, points), Anatomy.of(data, points[mirror] * (-1, 1, 1))
    solver = _Solver(data, head)
    left, right = ({**left_targets(side), **sideways_targets(side)} for side in (head, mirrored))
    solved = {f"{name}Left": solver.shape(target) for name, target in left.items()}
    solved |= {f"{name}Right": solver.shape(target.mirrored(mirror)) for name, target in right.items()}
    solved |= {name: solver.shape(target) for name, target in middle_targets(head).items()}
    solved["mouthClose"] = solver.shape(closing(head, solved["jawOpen"].displacement))
    able = {name: shape for name in NAMES if (shape := solved[name]).coverage >= LEAST_COVERAGE}
    return ArkitShapes(shapes=able, missing={name: solved[name] for name in NAMES if name not in able})


class _Solver:
    def __init__(self, data: GNMData, head: Anatomy):
        self._head, self._data = head, data
        self._modes = regions.expression_modes(data)
        self._bases: dict[tuple[str, ...], np.ndarray] = {}
        self._area = vertex_areas(head.points, data.triangles)
        self._skin = regions.skin(data)

    def shape(self, target: Target) -> ArkitShape:
        """Solve a shape."""
        return self._judged(self._solve(target), target)

    def _solve(self, target: Target) -> Float[np.ndarray, "V 3"]:
        """The displacement of the most probable coefficients, with the eyeball's own."""
        modes = self._basis(target.modes)
        wanted, weight = self._demands(target)
        rows = np.flatnonzero(weight)
        basis = modes[:, rows].astype(np.float64).reshape(len(modes), -1)
        weighted = basis * np.repeat(weight[rows], 3)
        normal = weighted @ basis.T + np.eye(len(modes)) / _SPREAD**2
        coefficients = np.linalg.solve(normal, weighted @ wanted[rows].reshape(-1))
        moved = np.tensordot(coefficients.astype(np.float32), modes, 1).astype(np.float64)
        return moved if target.gaze is None else moved + target.gaze

    def _basis(self, names: tuple[str, ...]) -> Float[np.ndarray, "K V 3"]:
        """The components of some regions and the mirror images of those opposite, float32.

        Together they have the mean covariance of both sides, so that a symmetric head gets symmetric shapes.
        """
        if names not in self._bases:
            chosen, opposite = (
                np.concatenate([self._modes.get(name, np.zeros(0, np.int64)) for name in side])
                for side in (names, [OPPOSITE.get(name, name) for name in names])
            )
            own, image = (self._data.expression_basis[side].astype(np.float32) for side in (chosen, opposite))
            image = image[:, self._head.mirror] * np.array([-1, 1, 1], np.float32)
            self._bases[names] = np.concatenate([own, image]) / np.float32(np.sqrt(2))
        return self._bases[names]

    def _demands(self, target: Target) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V"]]:
        """The wanted displacement of the vertices and its precision, 1 / m^2; 0 where nothing is demanded."""
        wanted = np.zeros_like(self._head.points)
        weight = np.zeros(len(wanted))
        for motion in target.motions:
            wanted[motion.rows] = motion.moves
            weight[motion.rows] = motion.share * self._shares(motion.rows) / _FIT**2
        rest = self._rest(target)
        weight[rest] = self._shares(rest) / _REST**2
        return wanted, weight

    def _shares(self, rows: np.ndarray) -> Float[np.ndarray, "N"]:
        area = np.maximum(self._area[rows], 1e-12)
        return np.asarray(area / max(area.sum(), 1e-30))

    def _rest(self, target: Target) -> np.ndarray:
        """The skin that stays: beyond the reach of all that moves."""
        moving = np.concatenate([motion.rows[np.abs(motion.moves).max(1) > 1e-4] for motion in target.motions])
        distance = cKDTree(self._head.points[moving]).query(self._head.points)[0]
        demanded = np.zeros(len(distance), bool)
        demanded[np.concatenate([motion.rows for motion in target.motions])] = True
        pair = np.minimum(np.arange(len(distance)), self._head.mirror)  # the same vertices on both sides
        return np.flatnonzero((distance > target.reach) & self._skin & ~demanded & (pair % _EVERY == 0))

    def _judged(self, moved: Float[np.ndarray, "V 3"], target: Target) -> ArkitShape:
        wanted, weight = self._demands(target)
        rest = self._rest(target)
        weight[rest] = 0
        skin = moved if target.gaze is None else moved - target.gaze
        share = weight / weight.sum()
        missing = share @ ((skin - wanted) ** 2).sum(1)
        asked = share @ (wanted**2).sum(1)
        still = self._shares(rest) @ (skin[rest] ** 2).sum(1) if len(rest) else 0.0
        return ArkitShape(
            displacement=moved,
            coverage=float(1 - missing / asked),
            residual_mm=float(1e3 * np.sqrt(missing)),
            elsewhere_mm=float(1e3 * np.sqrt(still)),
        )
