"""What the face protocol compares: a reference topology with its regions, the models on it, and registered scans.

As in [GNM, Evaluation dataset], meshes are registered to one GNM topology, the reference. Face and regions are its
vertex groups; a map carries face and registered meshes to the topology of any other model. Regions are looked up on the
registered mesh, by the point of it that is closest to a scan's point: they do not depend on the model.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import cKDTree

from coregister.evaluate.face_model import IDENTITY, Articulation, FaceModel
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.surface_samples import sample_surface
from registration.linear_models.data import LinearModelData
from registration.linear_models.gnm import from_gnm
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.storage.hashing import hash_arrays

FACE = "face"
_NEAR_M = 10e-3  # of the registered mesh: farther points are not of the face
_MOVES_M = 1e-7  # a component that moves the face less is none of the face's
_DEFORMS = 0.05  # standard deviation over the face of what a joint moves along: below, it turns the face as a whole


@runtime_checkable
class Carrier(Protocol):
    """A map from the reference to another topology, such as `registration.topology_map.topology_map.TopologyMap`."""

    @property
    def mask(self) -> Bool[np.ndarray, "V"]:
        """The vertices of the other topology that it is known for."""
        ...

    def carry(self, values: Shaped[np.ndarray, "..."], axis: int | None = None) -> Shaped[np.ndarray, "..."]:
        """Interpolate values of the reference's vertices, or more than half of a mask's."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceReference:
    """The topology of registered meshes, and regions of its face."""

    triangles: Int[np.ndarray, "F 3"]
    template: Float[np.ndarray, "V 3"]  # metres
    members: Mapping[str, Bool[np.ndarray, "V"]]  # "face" first, its areas, and the regions of the expression basis

    @classmethod
    def of_model(cls, data: GNMData) -> "FaceReference":
        """Return the topology of a GNM model."""
        areas = regions.common_face(data)
        for name, (_, mask) in regions.expression_regions(data).items():
            areas[name] = (mask > 0.5) & areas[FACE]
        return cls(
            triangles=data.triangles.astype(np.int64),
            template=data.template_vertex_positions.astype(np.float64),
            members=areas,
        )

    def labels(self) -> Bool[np.ndarray, "R F"]:
        """Return the regions of the triangles: wholly in the face; in another region by most of their corners."""
        corners = np.stack([members[self.triangles].sum(1) for members in self.members.values()])
        inside = corners >= 2
        inside[0] = corners[0] == 3
        return inside & inside[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceSample:
    """A registered scan that no model was built from. Metres; mesh and scan are in one frame, which may be any."""

    name: str  # unique
    subject: str
    category: str  # of its expression; "neutral" for neutrals
    vertices: Float[np.ndarray, "V 3"]  # the registered mesh, reference topology
    scan: Float[np.ndarray, "S 3"]
    scan_triangles: Int[np.ndarray, "G 3"]  # none: a cloud
    tags: Mapping[str, Any] = field(default_factory=dict)  # gender, age, ethnicity, ...

    def content(self) -> str:
        """Return the digest of all arrays."""
        return hash_arrays(self.vertices, self.scan, self.scan_triangles)


@dataclass(frozen=True, kw_only=True, eq=False)
class FacePoints:
    """Points of a scan's face: half of them to fit, half to measure at."""

    fit: Float[np.ndarray, "M 3"]
    measured: Float[np.ndarray, "N 3"]
    members: Bool[np.ndarray, "R N"]  # regions of the measured points
    nearest: Int[np.ndarray, "N"]  # the registered mesh's vertex that each measured point is at
    left_out: int  # sampled points near the face that the registration has elsewhere or farther than 10 mm


def face_points(sample: FaceSample, reference: FaceReference, count: int, seed: int) -> FacePoints:
    """Return points of the scan's face, uniform by area; of a cloud, among its points.

    A point is of the face where the closest point of the whole registered mesh is, eyeballs and mouth included: what
    the registration has on an eyeball is asked of no model.

    Args:
        sample: a registered scan.
        reference: its topology.
        count: points to fit, and to measure at; of a small cloud fewer.
        seed: of the choice.
    """
    rng = np.random.default_rng(seed)
    points = _sampled(sample, sample.vertices[reference.members[FACE]], 3 * count, rng)
    distance, face, barycentric = closest_points(points, sample.vertices, reference.triangles)
    nearest = reference.triangles[face, barycentric.argmax(1)]
    labels = reference.labels()[:, face]
    kept = labels[0] & (distance < _NEAR_M)
    points, labels, nearest = points[kept], labels[:, kept], nearest[kept]
    half = min(count, len(points) // 2)
    return FacePoints(
        fit=points[:half],
        measured=points[half : 2 * half],
        members=labels[:, half : 2 * half],
        nearest=nearest[half : 2 * half],
        left_out=int((~kept).sum()),
    )


def _sampled(
    sample: FaceSample, face: Float[np.ndarray, "Q 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """Random points of the scan near the registered face, in random order."""
    tree = cKDTree(face)
    if not len(sample.scan_triangles):
        near = np.flatnonzero(tree.query(sample.scan, distance_upper_bound=_NEAR_M)[0] < np.inf)
        return sample.scan[rng.permutation(near)[:count]].astype(np.float64)
    centres = sample.scan[sample.scan_triangles].mean(1)
    triangles = sample.scan_triangles[tree.query(centres, distance_upper_bound=_NEAR_M)[0] < np.inf]
    if not len(triangles):
        return np.zeros((0, 3))
    return barycentric_points(
        sample.scan.astype(np.float64), triangles, *sample_surface(sample.scan, triangles, count, rng)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedModel:
    """A model on the face, and where the reference's registered meshes say that its vertices are."""

    face: FaceModel
    carried: Carrier | None  # from the reference; None: it has the reference's topology

    def target(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "P 3"]:
        """Return where a registered mesh has the vertices of the model's face."""
        placed = vertices if self.carried is None else self.carried.carry(vertices, 0)
        return placed[self.face.rows].astype(np.float64)


def compared_gnm(name: str, data: GNMData, reference: FaceReference, carried: Carrier | None) -> ComparedModel:
    """Return a GNM model; arguments as `compared`."""
    parts = {region: members for region, (members, _) in regions.expression_regions(data).items()}
    return compared(name, from_gnm(data), reference, carried, parts, gnm_npz.content_hash(data))


def compared(
    name: str,
    data: LinearModelData,
    reference: FaceReference,
    carried: Carrier | None,
    regions_of_expression: Mapping[str, Int[np.ndarray, "_"]] | None = None,
    content: str = "",
) -> ComparedModel:
    """Return a model of any topology on the face.

    Args:
        name: for tables.
        data: the model.
        reference: topology of the registered meshes.
        carried: the map from the reference to the model's topology; None: they are the same.
        regions_of_expression: regions of the expression basis -> their components; None: one, "expression".
        content: digest of the model; "": that of its arrays.
    """
    face, known = reference.members[FACE], np.ones(len(data.template), bool)
    if carried is not None:
        face, known = carried.carry(face, 0), carried.mask
    face = face & known
    triangles = data.triangles[(face[data.triangles]).any(1) & known[data.triangles].all(1)]
    rows = np.unique(triangles)
    index = np.full(len(data.template), -1)
    index[rows] = np.arange(len(rows))
    basis = np.concatenate([data.identity_basis[:, rows], data.expression_basis[:, rows]]).astype(np.float64)
    identity = len(data.identity_basis)
    if regions_of_expression is None:
        regions_of_expression = {"expression": np.arange(len(data.expression_basis))}
    parts = {IDENTITY: np.arange(identity)} | {n: identity + m for n, m in regions_of_expression.items()}
    kept = np.zeros(len(basis), bool)
    kept[np.concatenate(list(parts.values()))] = True
    kept &= np.abs(basis[:, face[rows]]).max((1, 2), initial=0) > _MOVES_M
    place = np.cumsum(kept) - 1
    return ComparedModel(
        face=FaceModel(
            name=name,
            content=content or hash_arrays(data.template, data.identity_basis, data.expression_basis),
            rows=rows,
            rest=data.template[rows].astype(np.float64),
            basis=basis[kept],
            triangles=index[triangles],
            face=face[rows],
            components={n: place[m[kept[m]]] for n, m in parts.items()},
            articulation=_articulation(data, rows, face[rows], kept),
        ),
        carried=carried,
    )


def _articulation(
    data: LinearModelData, rows: Int[np.ndarray, "P"], face: Bool[np.ndarray, "P"], kept: Bool[np.ndarray, "K"]
) -> Articulation | None:
    """The joints, if any deforms the face."""
    weights = data.joints.weights[rows].T.astype(np.float64)
    along = weights / weights.sum(0)  # of each joint with all below it
    for joint in range(len(along) - 1, 0, -1):
        along[data.joints.parents[joint]] += along[joint]
    free = tuple(int(j) for j in range(1, len(along)) if along[j][face].std() > _DEFORMS)
    if not free:
        return None
    identity = len(data.identity_basis)
    first, second = kept[:identity], kept[identity:]
    correctives = data.joints.correctives
    if correctives is not None:
        correctives = correctives.reshape(len(correctives), -1, 3)[:, rows].reshape(len(correctives), -1)
    joints = replace(
        data.joints,
        identity_basis=data.joints.identity_basis[first],
        expression_basis=data.joints.expression_basis[second],
        weights=data.joints.weights[rows],
        correctives=correctives,
    )
    part = replace(
        data,
        triangles=data.triangles[:0],
        template=data.template[rows],
        identity_basis=data.identity_basis[first][:, rows],
        expression_basis=data.expression_basis[second][:, rows],
        joints=joints,
        groups={},
    )
    return Articulation(data=part, free=free)
