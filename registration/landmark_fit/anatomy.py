"""The anatomical term of a landmark fit: parts of the head do not lie in one another more deeply than in the template.

E = w / 2 * sum over points of (max(0, depth - depth in the template - margin) / sigma)^2

Points are vertices of eyelids against eyeballs; of lips and tongue against teeth, gums and palate; of lips against the
tongue; of either lip against the other. `registration.losses.self_intersection` is the same penalty for a registration.
"""

from copy import copy
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from registration.frames import MM_PER_M
from registration.geometry.geodesic import edge_distances
from registration.geometry.topology import edges
from registration.landmark_fit.contact import MIN_TRIANGLES, Contact, ContactDepths, Depths
from registration.landmark_fit.landmark_model import LandmarkModel
from registration.landmark_fit.reduction import Reduction
from registration.landmark_fit.state import Free, Layout
from registration.model import regions
from registration.model.gnm_npz import GNMData

# Lengths in mm of the template.
_SIGMA = 0.2
_MARGIN = 0.05  # added to the depth in the template
_LIDS, _MOUTH, _OF_JAWS = 8.0, 15.0, 18.0  # distance of points from eyeballs and jaws, and of jaws from the points
_LIP = 5.0  # of a lip's points from the other lip
_CORNER = 4.0  # along the skin, within which a lip's points belong to the corner of the mouth
_LIP_REACH = 2.0  # depth in the other lip: beyond, a point is on the other side of it and not in it
_KEPT = 4096  # frames
_ACCURACY_M = 5e-6  # of the parts' restricted bases, at unit coefficients


class Anatomy:
    """Penalizes penetrations of parts of the head in one frame.

    Independent of the head's pose and size: depths are those of a head of the model's size, the anchor at rest.

    Args:
        data: the model.
        reduction: of the expression coefficients.
        weight: of the term.
        offsets: of the bind pose, metres; None: zero.
        anchor: the joint that is at rest, as in the model of the landmarks.

    Raises:
        InputError: the model lacks a vertex group that names a part.
    """

    def __init__(
        self,
        data: GNMData,
        reduction: Reduction,
        weight: float = 1.0,
        offsets: Float[np.ndarray, "V 3"] | None = None,
        anchor: int = 0,
    ):
        pairs = contacts(data)
        used = np.zeros(len(data.template_vertex_positions), bool)
        for contact in pairs:
            used[contact.points] = True
            used[contact.triangles] = True
        self._parts: list[_Part] = []
        place = np.full(len(used), -1)
        first = 0
        for members in _rigid_parts(data):
            index = np.flatnonzero(used & members & (place < 0))
            if len(index):
                place[index] = np.arange(first, first + len(index))
                self._parts.append(_Part(data, index, first, reduction, offsets, anchor))
                first += len(index)
        self.index = np.argsort(np.where(used, place, len(used)))[:first]
        placed = [replace(c, points=place[c.points], triangles=place[c.triangles]) for c in pairs]
        rest = np.zeros((first, 3))
        rest[place[used]] = data.template_vertex_positions[used].astype(np.float64) * MM_PER_M
        self._depths = ContactDepths(placed, rest)
        self._factor = np.sqrt(weight) / _SIGMA
        self._tolerance = np.zeros(self._depths.count)
        deep = self._depths(rest, self._tolerance)
        self._tolerance[deep.query] = deep.depth
        self._tolerance += _MARGIN
        self._latest: tuple[bytes, dict[bytes, Depths]] = (b"", {})

    def softened(self, factor: float) -> "Anatomy":
        """Return the same term with standard deviations multiplied by a factor."""
        result = copy(self)
        result._factor = self._factor / factor
        return result

    def energy(
        self, identity: Float[np.ndarray, "R"], expression: Float[np.ndarray, "Q"], joints: Float[np.ndarray, "J 3 3"]
    ) -> float:
        """Half the sum of the squared weighted residuals.

        Args:
            identity: coefficients.
            expression: reduced coefficients.
            joints: rotations relative to the parents.
        """
        return 0.5 * float((self._residual(self._deep(identity, expression, joints)) ** 2).sum())

    def rows(
        self,
        identity: Float[np.ndarray, "R"],
        expression: Float[np.ndarray, "Q"],
        joints: Float[np.ndarray, "J 3 3"],
        layout: Layout,
        free: Free,
    ) -> list[tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M"]]]:
        """Weighted Jacobians by the free columns, and residuals.

        Args:
            identity: coefficients.
            expression: reduced coefficients.
            joints: rotations relative to the parents.
            layout: of the columns.
            free: columns that are estimated, those of the frame first.
        """
        deep = self._deep(identity, expression, joints)
        if not len(deep.query):
            return []
        local = np.zeros((len(deep.query), layout.local_count))
        shared = np.zeros((len(deep.query), layout.shared_count))
        # Weights of the coordinates of vertices in the residuals.
        vertex = np.column_stack([deep.point, deep.triangle])
        share = np.column_stack([np.full(len(vertex), -1.0), deep.weights]) * (self._factor * MM_PER_M)
        for part in self._parts:
            row, column = np.nonzero((vertex >= part.first) & (vertex < part.first + part.count))
            if not len(row):
                continue
            involved, own = np.unique(vertex[row, column], return_inverse=True)
            weights = np.zeros((len(vertex), 3, len(involved)))
            weights[row, :, own] = share[row, column, None] * deep.direction[row]
            by = part.derivatives(identity, expression, joints, involved - part.first, weights)
            shared[:, layout.shared("identity")] += by[0]
            local[:, layout.local("expression")] += by[1]
            local[:, layout.local("root")] += by[2][:, :3]
            local[:, layout.local("joints")] += by[2][:, 3:]
        jacobian = np.concatenate([local[:, free.local], shared[:, free.shared]], 1)
        return [(jacobian, self._residual(deep))]

    def excess_mm(
        self, identity: Float[np.ndarray, "R"], expression: Float[np.ndarray, "Q"], joints: Float[np.ndarray, "J 3 3"]
    ) -> Float[np.ndarray, "M"]:
        """Return by how much the points that are too deep are so.

        Args:
            identity: coefficients.
            expression: reduced coefficients.
            joints: rotations relative to the parents.
        """
        return self._residual(self._deep(identity, expression, joints)) / self._factor

    def vertices_mm(
        self, identity: Float[np.ndarray, "R"], expression: Float[np.ndarray, "Q"], joints: Float[np.ndarray, "J 3 3"]
    ) -> Float[np.ndarray, "S 3"]:
        """Return the vertices `index`, mm, the anchor at rest.

        Args:
            identity: coefficients.
            expression: reduced coefficients.
            joints: rotations relative to the parents.
        """
        return np.concatenate([part.points(identity, expression, joints) for part in self._parts]) * MM_PER_M

    def _residual(self, deep: Depths) -> Float[np.ndarray, "M"]:
        return self._factor * (deep.depth - self._tolerance[deep.query])

    def _deep(self, identity: np.ndarray, expression: np.ndarray, joints: np.ndarray) -> Depths:
        """The points that are too deep; of the latest identity those of all frames are kept, up to `_KEPT`."""
        subject, frame = identity.tobytes(), expression.tobytes() + joints.tobytes()
        if self._latest[0] != subject or len(self._latest[1]) > _KEPT:
            self._latest = (subject, {})
        found = self._latest[1].get(frame)
        if found is None:
            vertices = self.vertices_mm(identity, expression, joints)
            found = self._latest[1][frame] = self._depths(vertices, self._tolerance)
        return found


class _Part:
    """Vertices of one part, in bases restricted to the directions that move them."""

    def __init__(
        self,
        data: GNMData,
        index: np.ndarray,
        first: int,
        reduction: Reduction,
        offsets: np.ndarray | None,
        anchor: int,
    ):
        self.first, self.count = first, len(index)
        by_identity, of_joints, by_expression = (
            basis.astype(np.float64).reshape(len(basis), -1)
            for basis in (
                data.vertex_identity_basis[:, index],
                data.joint_identity_basis,
                data.expression_basis[:, index],
            )
        )
        self._identity = _directions(np.concatenate([by_identity, of_joints], 1).T)
        self._expression = _directions((reduction.basis.T @ by_expression).T)
        self._model = LandmarkModel(
            data,
            index[:, None],
            np.ones((len(index), 1)),
            identity_map=self._identity,
            expression_map=reduction.basis @ self._expression,
            expression_mean=reduction.mean,
            offsets=offsets,
            anchor=anchor,
        )

    def points(self, identity: np.ndarray, expression: np.ndarray, joints: np.ndarray) -> Float[np.ndarray, "P 3"]:
        return self._model(self._identity.T @ identity, self._expression.T @ expression, joints).points

    def derivatives(
        self,
        identity: np.ndarray,
        expression: np.ndarray,
        joints: np.ndarray,
        rows: Int[np.ndarray, "P"],
        weights: Float[np.ndarray, "M 3 P"],
    ) -> tuple[Float[np.ndarray, "M R"], Float[np.ndarray, "M Q"], Float[np.ndarray, "M C"]]:
        """Of weighted sums of some vertices' coordinates: by identity, expression and joints."""
        posed = self._model(
            self._identity.T @ identity,
            self._expression.T @ expression,
            joints,
            rows=rows,
            by_identity=True,
            by_expression=True,
            by_joints=True,
        )
        assert posed.by_identity is not None and posed.by_expression is not None and posed.by_joints is not None
        flat = weights.reshape(len(weights), -1)

        def summed(columns: np.ndarray) -> np.ndarray:
            return flat @ columns.reshape(flat.shape[1], -1)

        by_identity = summed(posed.by_identity) @ self._identity.T
        return by_identity, summed(posed.by_expression) @ self._expression.T, summed(posed.by_joints)


def _directions(basis: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "C R"]:
    """Orthonormal directions of the coefficients outside of which unit coefficients move nothing visibly."""
    _, vectors = np.linalg.eigh(basis.T @ basis)
    vectors = vectors[:, ::-1]
    rest = np.cumsum(((basis @ vectors) ** 2)[:, ::-1], 1)[:, ::-1].max(0)
    return np.ascontiguousarray(vectors[:, rest > _ACCURACY_M**2])


def _rigid_parts(data: GNMData) -> list[Bool[np.ndarray, "V"]]:
    """Disjoint groups of vertices that few coefficients move, then the rest."""
    jaws, lower, lids = _jaws(data), regions.lower_teeth(data), regions.lids(data) > 0
    return [*regions.eyeballs(data), jaws & ~lower, jaws & lower, regions.tongue(data), lids, np.ones(len(jaws), bool)]


def _jaws(data: GNMData) -> Bool[np.ndarray, "V"]:
    triangles = regions.solids(data)["teeth"]
    members = np.zeros(len(data.template_vertex_positions), bool)
    members[triangles] = True
    return members


def contacts(data: GNMData) -> list[Contact]:
    """Return the parts that must not lie in one another: lids and eyes, mouth and jaws, lips and tongue, either lip.

    Args:
        data: the model; its vertex groups name the parts.
    """
    rest = data.template_vertex_positions.astype(np.float64) * MM_PER_M
    mesh = data.triangles.astype(np.int64)
    exterior, tongue, jaws = regions.exterior(data), regions.tongue(data), _jaws(data)
    upper, lower = (lip & exterior for lip in regions.lips(data))
    mouth = upper | lower
    teeth = regions.lower_teeth(data)
    touching = (mouth & _near(rest, jaws, _MOUTH)) | tongue
    found = [(exterior & _near(rest, shell, _LIDS), shell, "rigid") for shell in regions.eyeball_shells(data)]
    for jaw in (jaws & ~teeth, jaws & teeth):
        found.append((touching, jaw & _near(rest, touching, _OF_JAWS), "rigid"))
    found.append((mouth, tongue, "solid"))
    along = edges(mesh).vertices
    for lip, other in ((upper & ~lower, lower), (lower & ~upper, upper)):
        # At the corner of the mouth either lip continues the other's surface.
        apart = edge_distances(rest, along, other, _CORNER) > _CORNER
        found.append((lip & apart & _near(rest, other, _LIP), other & _near(rest, lip, 2 * _LIP), ""))
    result = []
    for points, surface, kind in found:
        triangles = mesh[surface[mesh].all(1)]
        if points.any() and len(triangles) >= MIN_TRIANGLES:
            index = np.flatnonzero(points)
            contact = Contact(points=index, triangles=triangles, rigid=kind == "rigid", solid=kind == "solid")
            result.append(contact if kind else replace(contact, reach=_LIP_REACH))
    return result


def _near(rest: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"], distance: float) -> Bool[np.ndarray, "V"]:
    """Vertices within a distance of some members."""
    if not members.any():
        return np.zeros(len(rest), bool)
    return np.isfinite(cKDTree(rest[members]).query(rest, distance_upper_bound=distance)[0])
