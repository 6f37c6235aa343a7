"""Parts of a subject that no expression changes and no skin shows: the identity components of teeth and eyes alone, and
where the dental arches stand in the head.

The identity that fits a face puts the arches where those of similar faces stand; a subject's own stand elsewhere. And
a fit of the neutral explains some of the face's shape by an expression, which takes the lower arch along. Placements of
the arches are no components of the model: a registration has them in its offsets. docs/anatomy.md has the figures.

A neutral with closed lips tells nothing of the teeth; a smile tells something of the upper front teeth. Each capture's
estimate counts by what its cameras saw: at a vertex, the displacement that it found is one measurement per view. Where
no capture saw a part, the priors of components and placements decide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.geometry.rasterizer import RayCaster
from registration.geometry.rigid import motion_fields
from registration.model import gnm_numpy, regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Registration

_SIGMA_M = 3e-3  # standard deviation of the displacement that one view shows of a vertex; those of a tooth err together
_ARCHES = ("upper_teeth_and_gums", "lower_teeth_and_gums")  # vertex groups
# Standard deviations about and along each axis, radians and metres (docs/anatomy.md, as measured, or a little more).
_BOTH = (np.radians(1.0), 2e-3)  # both arches against where the identity puts them
_LOWER = (np.radians(1.5), 1.5e-3)  # the lower one against the upper, where identity and expression put it
_REST = (np.radians(0.5), 0.2e-3)  # the same in the neutral, where the identity alone puts it
_MOTION = (np.radians(0.1), 0.1e-3)  # its motion from the neutral's, and
_MOTION_SHARE = 0.02  # this share of the motion itself
_AXES = 6  # of the motion of an arch
FIGURE = "own_parts"  # of a registration: what it found itself


def still_components(data: GNMData) -> Int[np.ndarray, "S"]:
    """Return the identity components that move neither skin nor joints: those of teeth and eyes alone."""
    skin = data.vertex_identity_basis[:, regions.skin(data)]
    return np.flatnonzero((skin == 0).all((1, 2)) & (data.joint_identity_basis == 0).all((1, 2)))


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnParts:
    """The components, the placements of the dental arches, and the vertices that they move.

    A vector of C coefficients holds those of S components, then those of P placements; all have unit variance.
    """

    components: Int[np.ndarray, "S"]  # indices into the identity
    vertices: Int[np.ndarray, "N"]  # ascending
    basis: Float[np.ndarray, "C N 3"]  # displacements in the bind pose, metres

    @classmethod
    def of(cls, data: GNMData) -> "OwnParts":
        """Find them in a model; there may be none. Arches are placed only if components move them."""
        components = still_components(data)
        rows = data.vertex_identity_basis[components]
        rows = np.concatenate([rows, _placements(data, (rows != 0).any((0, 2)))])
        vertices = np.flatnonzero((rows != 0).any((0, 2)))
        return cls(components=components, vertices=vertices, basis=rows[:, vertices].astype(np.float64))

    @property
    def placements(self) -> Float[np.ndarray, "P N 3"]:
        """The displacements by the placements of unit coefficient, metres."""
        return self.basis[len(self.components) :]

    def coefficients(self, registration: Registration) -> Float[np.ndarray, "C"]:
        """Return those of a registration: components from its identity, placements from its offsets."""
        offsets = registration.offsets[self.vertices].astype(np.float64)
        placed = _least_squares(self.placements, offsets)
        return np.concatenate([registration.identity[self.components], placed])

    def jaw_motion(self, data: GNMData, expression: Float[np.ndarray, "E"]) -> Float[np.ndarray, "Q"]:
        """Return the placement of the lower arch alone that is nearest to its motion by an expression."""
        lower = self.placements[_AXES:]
        there = (lower != 0).any((0, 2))
        basis = data.expression_basis[:, self.vertices[there]].astype(np.float64)
        moved = np.tensordot(expression.astype(np.float64), basis, 1)
        return _least_squares(lower[:, there], moved)


def _least_squares(rows: Float[np.ndarray, "P N 3"], displacement: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "P"]:
    return np.linalg.lstsq(rows.reshape(len(rows), displacement.size).T, displacement.ravel(), rcond=None)[0]


def _placements(data: GNMData, moved: Bool[np.ndarray, "V"]) -> Float[np.ndarray, "P V 3"]:
    """Small rigid motions, one standard deviation each: six of both arches, six of the lower one.

    Linear rotations about the centre of the teeth that they move, and shifts, by the model's axes.
    """
    upper, lower = (regions.group(data, name) > 0.5 for name in _ARCHES)
    if not (moved & upper).any() or not (moved & lower).any():
        return np.zeros((0, *data.template_vertex_positions.shape))
    template, rows = data.template_vertex_positions.astype(np.float64), []
    for members, spread in ((upper | lower, _BOTH), (lower, _LOWER)):
        centre = template[members & regions.teeth(data)].mean(0)
        rows.append(np.repeat(spread, 3)[:, None, None] * members[:, None] * motion_fields(template - centre))
    return np.concatenate(rows)


@dataclass(frozen=True, kw_only=True, eq=False)
class PartEstimate:
    """What one capture says of its subject's own parts."""

    coefficients: Float[np.ndarray, "C"]
    views: Int[np.ndarray, "N"]  # that see each of the vertices
    jaw: Float[np.ndarray, "Q"]  # motion of the lower arch by its expression, `OwnParts.jaw_motion`


def views_that_see(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    cameras: Sequence[Camera],
    points: Int[np.ndarray, "N"],
) -> Int[np.ndarray, "N"]:
    """Count, for some vertices of a registered mesh, the cameras that see them; world, metres."""
    caster = RayCaster(vertices, triangles)
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        seen += caster.visible(vertices[points], camera)
    return seen


def fuse(parts: OwnParts, estimates: Sequence[PartEstimate]) -> Float[np.ndarray, "K C"]:
    """Return the most probable coefficients in each capture, given every capture's displacements where it saw them.

    They are the same in all captures, but for the placement of the lower arch against the upper: this corrects the jaw.
    In the neutral it stands as the identity alone puts it, whatever the neutral's expression; in another capture it has
    moved from there as the two expressions say. Both hold to a standard deviation.

    Args:
        parts: of the model.
        estimates: of the captures, the neutral's first; those that saw nothing do not count.
    """
    size, jaw = len(parts.basis), len(estimates[0].jaw)
    # Unknowns: the subject's coefficients with the neutral's jaw; then how much each other jaw differs from that one.
    total = size + (len(estimates) - 1) * jaw
    mean, spread = np.zeros(total), np.ones(total)
    own = np.tile(np.eye(size, total), (len(estimates), 1, 1))  # coefficients of each capture from the unknowns
    if jaw:
        unit = np.repeat(_LOWER, 3)
        mean[size - jaw : size], spread[size - jaw : size] = -estimates[0].jaw, np.repeat(_REST, 3) / unit
        for number, estimate in enumerate(estimates[1:]):
            columns = slice(size + number * jaw, size + (number + 1) * jaw)
            own[number + 1, size - jaw :, columns] = np.eye(jaw)
            motion = (unit * (estimate.jaw - estimates[0].jaw)).reshape(2, 3)  # rotation, shift
            uncertain = np.array(_MOTION) + _MOTION_SHARE * np.linalg.norm(motion, axis=1)
            spread[columns] = np.repeat(uncertain, 3) / unit
    information = np.diag(spread**-2)
    right = information @ mean
    for estimate, chosen in zip(estimates, own, strict=True):
        seen = np.flatnonzero(estimate.views)
        rows = parts.basis[:, seen] * (np.sqrt(estimate.views[seen])[:, None] / _SIGMA_M)
        flat = rows.reshape(size, -1)
        known = chosen.T @ (flat @ flat.T)
        information += known @ chosen
        right += known @ estimate.coefficients
    return own @ np.linalg.solve(information, right)


def with_parts(
    registration: Registration,
    data: GNMData,
    parts: OwnParts,
    coefficients: Float[np.ndarray, "C"],
    schemes: Mapping[str, LandmarkScheme],
) -> Registration:
    """Return a registration with these coefficients of its own parts: their vertices change, and landmarks on them."""
    count = len(parts.components)
    identity, offsets = registration.identity.copy(), registration.offsets.copy()
    identity[parts.components] = coefficients[:count]
    change = np.asarray(coefficients, np.float64)[count:] - parts.coefficients(registration)[count:]
    offsets[parts.vertices] += np.tensordot(change, parts.placements, 1).astype(offsets.dtype)
    posed = gnm_numpy.evaluate(
        data,
        identity=identity.astype(np.float64),
        expression=registration.expression.astype(np.float64),
        rotations=registration.rotations.astype(np.float64),
        translation=registration.translation.astype(np.float64),
        scale=float(registration.scale),
        offsets=offsets.astype(np.float64),
    )
    vertices = registration.vertices.copy()
    vertices[parts.vertices] = posed[parts.vertices]
    landmarks = {
        name: schemes[name].points(vertices).astype(points.dtype) if name in schemes else points
        for name, points in registration.landmarks.items()
    }
    return replace(registration, identity=identity, offsets=offsets, vertices=vertices, landmarks=landmarks)


def found_alone(
    registration: Registration, data: GNMData, parts: OwnParts, schemes: Mapping[str, LandmarkScheme]
) -> Registration:
    """Return a registration with the own parts that it found itself, if it has got those of all captures since."""
    entry = registration.figures.get(FIGURE)
    if entry is None or len(entry["alone"]) != len(parts.components):
        return registration
    placed = np.zeros(len(parts.placements))  # so it is in records without placements, from before there were any
    if len(entry.get("placed", [])) == len(placed):
        placed = entry["placed"] / _units(len(placed))
    return with_parts(registration, data, parts, np.concatenate([entry["alone"], placed]), schemes)


def record(parts: OwnParts, coefficients: Float[np.ndarray, "C"]) -> dict[str, list[float]]:
    """Return what `found_alone` reads of a registration's figures: coefficients, and placements, radians and metres."""
    count = len(parts.components)
    placed = coefficients[count:] * _units(len(parts.placements))
    return {"alone": coefficients[:count].tolist(), "placed": placed.tolist()}


def _units(count: int) -> Float[np.ndarray, "P"]:
    """Rotations (radians) and shifts (metres) of unit coefficients: both arches', the lower one's."""
    return np.repeat([*_BOTH, *_LOWER], 3)[:count]
