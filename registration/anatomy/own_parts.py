"""Parts of a subject that no expression changes and no skin shows: the identity components of teeth and eyes alone.

A neutral with closed lips tells nothing of the teeth; a smile tells something of the upper front teeth. Each capture's
estimate counts by what its cameras saw: at a vertex, the displacement that it found is one measurement per view. Where
no capture saw a part, the components' prior decides.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from registration.geometry.rasterizer import RayCaster
from registration.model import gnm_numpy, regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Registration

_SIGMA_M = 1e-3  # standard deviation of the displacement that one view shows of a vertex
FIGURE = "own_parts"  # of a registration: what it found itself


def still_components(data: GNMData) -> Int[np.ndarray, "S"]:
    """Return the identity components that move neither skin nor joints: those of teeth and eyes alone."""
    skin = data.vertex_identity_basis[:, regions.skin(data)]
    return np.flatnonzero((skin == 0).all((1, 2)) & (data.joint_identity_basis == 0).all((1, 2)))


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnParts:
    """The components and the vertices that they move."""

    components: Int[np.ndarray, "S"]  # indices into the identity
    vertices: Int[np.ndarray, "N"]  # ascending
    basis: Float[np.ndarray, "S N 3"]

    @classmethod
    def of(cls, data: GNMData) -> "OwnParts":
        """Find them in a model; there may be none."""
        components = still_components(data)
        rows = data.vertex_identity_basis[components]
        vertices = np.flatnonzero((rows != 0).any((0, 2)))
        return cls(components=components, vertices=vertices, basis=rows[:, vertices].astype(np.float64))


@dataclass(frozen=True, kw_only=True, eq=False)
class PartEstimate:
    """What one capture says of its subject's own parts."""

    coefficients: Float[np.ndarray, "S"]
    views: Int[np.ndarray, "N"]  # that see each of the vertices


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


def fuse(parts: OwnParts, estimates: Sequence[PartEstimate]) -> Float[np.ndarray, "S"]:
    """Return the subject's coefficients: the most probable ones, given every capture's displacements where it saw them.

    Args:
        parts: of the model.
        estimates: of the captures; those that saw nothing do not count.
    """
    size = len(parts.components)
    information, right = np.eye(size), np.zeros(size)
    for estimate in estimates:
        seen = np.flatnonzero(estimate.views)
        rows = parts.basis[:, seen] * (np.sqrt(estimate.views[seen])[:, None] / _SIGMA_M)
        flat = rows.reshape(size, -1)
        own = flat @ flat.T
        information += own
        right += own @ estimate.coefficients
    return np.linalg.solve(information, right)


def with_parts(
    registration: Registration,
    data: GNMData,
    parts: OwnParts,
    coefficients: Float[np.ndarray, "S"],
    schemes: Mapping[str, LandmarkScheme],
) -> Registration:
    """Return a registration with these coefficients of its own parts: their vertices change, and landmarks on them."""
    identity = registration.identity.copy()
    identity[parts.components] = coefficients
    posed = gnm_numpy.evaluate(
        data,
        identity=identity.astype(np.float64),
        expression=registration.expression.astype(np.float64),
        rotations=registration.rotations.astype(np.float64),
        translation=registration.translation.astype(np.float64),
        scale=float(registration.scale),
        offsets=registration.offsets.astype(np.float64),
    )
    vertices = registration.vertices.copy()
    vertices[parts.vertices] = posed[parts.vertices]
    landmarks = {
        name: schemes[name].points(vertices).astype(points.dtype) if name in schemes else points
        for name, points in registration.landmarks.items()
    }
    return replace(registration, identity=identity, vertices=vertices, landmarks=landmarks)


def found_alone(
    registration: Registration, data: GNMData, parts: OwnParts, schemes: Mapping[str, LandmarkScheme]
) -> Registration:
    """Return a registration with the own parts that it found itself, if it has got those of all captures since."""
    entry = registration.figures.get(FIGURE)
    if entry is None or len(entry["alone"]) != len(parts.components):
        return registration
    return with_parts(registration, data, parts, np.asarray(entry["alone"], np.float32), schemes)
