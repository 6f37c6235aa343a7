"""Penetration audit: where parts of a registered head lie inside one another, by winding numbers [Jacobson 2013].

The audit assesses whatever a fit did to keep parts apart. It therefore shares nothing with a loss: the parts are the
mesh itself, not hulls or spheres. A vertex is inside a part if the part, its openings closed, has a winding number
above 0.5 at the vertex; its depth is the distance to the part's surface. The template's own parts overlap, which no
registration can avoid. What counts is the excess over the depth in the template, vertex by vertex and pair by pair
(docs/formats.md, "Figures").
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from registration.errors import InputError
from registration.evaluate.names import BEYOND_KEY, TOLERANCE_MM
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.self_overlap import SelfOverlap
from registration.geometry.topology import connected_parts
from registration.geometry.winding import Winding, closed
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

_INSIDE = 0.5  # winding number


@dataclass(frozen=True, kw_only=True)
class PartPair:
    """One part in another: the vertices that are inside, in the mesh or in the template. A depth of 0 mm is outside."""

    name: str
    vertices: Int[np.ndarray, "N"]
    depth_mm: Float[np.ndarray, "N"]
    baseline_mm: Float[np.ndarray, "N"]  # depth of the same vertex in the template, at the mesh's scale

    @property
    def excess_mm(self) -> Float[np.ndarray, "N"]:
        """Return the depth minus the depth in the template."""
        return self.depth_mm - self.baseline_mm

    @property
    def beyond(self) -> Int[np.ndarray, "M"]:
        """Return the vertices whose excess is larger than the tolerance."""
        return self.vertices[self.excess_mm > TOLERANCE_MM]

    @property
    def metrics(self) -> dict[str, Any]:
        """Return the pair's entry of the manifest."""
        return {
            "template_vertices": int((self.baseline_mm > 0).sum()),
            "template_max_mm": float(self.baseline_mm.max(initial=0)),
            BEYOND_KEY: len(self.beyond),
            "max_excess_mm": float(self.excess_mm.max(initial=0)),
        }


@dataclass(frozen=True, kw_only=True)
class PenetrationAudit:
    """All pairs of parts, including those that do not intersect."""

    pairs: tuple[PartPair, ...]

    @property
    def beyond(self) -> Int[np.ndarray, "M"]:
        """Return the vertices whose excess is larger than the tolerance in any pair, each once."""
        return np.unique(np.concatenate([pair.beyond for pair in self.pairs]))

    @property
    def metrics(self) -> dict[str, Any]:
        """Return the entry of the manifest: the number of vertices beyond the tolerance, and each pair's metrics."""
        return {BEYOND_KEY: len(self.beyond), "pairs": {pair.name: pair.metrics for pair in self.pairs}}


def audit_penetration(vertices: Float[np.ndarray, "V 3"], data: GNMData, scale: float = 1.0) -> PenetrationAudit:
    """Measure how deep parts of a posed mesh lie inside one another, beyond the depth in the template.

    The vertices of the outer skin and of the tongue are tested; eye sockets, gums and the oral lining are not. The
    first audit of a process with a model also audits its template.

    Args:
        vertices: metres, any frame, in the model's topology.
        data: the model.
        scale: of the registration; the template is compared at the same size.

    Returns:
        Depths and excesses in millimetres.

    Raises:
        InputError: the vertices are not in the model's topology, or not finite.
    """
    template = np.asarray(data.template_vertex_positions)
    if vertices.shape != template.shape or not np.isfinite(vertices).all():
        raise InputError(
            "The mesh cannot be audited",
            where="vertices",
            expected=f"finite numbers, {template.shape} as the model's template",
            got=f"{vertices.shape}, {int((~np.isfinite(vertices)).any(-1).sum())} not finite",
            fix="give a registration that did not fail, and the model it was computed with",
        )
    parts, template_depths = _template_parts(data)
    pairs = []
    for name, depth in parts.depths(np.asarray(vertices, np.float64)).items():
        baseline = scale * template_depths[name]
        members = np.flatnonzero((depth > 0) | (baseline > 0))
        pairs.append(PartPair(name=name, vertices=members, depth_mm=depth[members], baseline_mm=baseline[members]))
    return PenetrationAudit(pairs=tuple(pairs))


# By the model's content hash; only the last model, which all captures of a process usually share.
_audited_template: dict[str, tuple["_PartSurfaces", Mapping[str, Float[np.ndarray, "V"]]]] = {}
_last_model: list[GNMData] = []  # whose template that is: the hash takes a tenth of an audit


def _template_parts(data: GNMData) -> tuple["_PartSurfaces", Mapping[str, Float[np.ndarray, "V"]]]:
    """Return a model's parts, and the depths in its template by pair, in millimetres."""
    if _audited_template and _last_model and _last_model[0] is data:
        return next(iter(_audited_template.values()))
    content = gnm_npz.content_hash(data)
    if content not in _audited_template:
        parts = _PartSurfaces(data)
        _audited_template.clear()
        _audited_template[content] = parts, parts.depths(parts.rest)
    _last_model[:] = [data]
    return _audited_template[content]


class _PartSurfaces:
    """The parts of a model: the vertices that are tested, and the closed surfaces in which they are tested."""

    def __init__(self, data: GNMData):
        self.rest = np.asarray(data.template_vertex_positions, np.float64)
        self.exterior, self.tongue = regions.exterior(data), regions.tongue(data)
        self.teeth, self.ears = regions.teeth(data), regions.ears(data)
        names, coverage = regions.vertex_classes(data)
        self.upper_lip, self.lower_lip = (coverage[:, names.index(name)] > 0.5 for name in ("upper_lip", "lower_lip"))
        solids = regions.solids(data)
        self.skin = solids.pop("skin")
        self.overlap = SelfOverlap(self.rest, self.skin)
        self.exterior_faces = self.exterior[self.skin].all(1)  # of the skin's triangles
        # Several shells: an eyeball's iris is a separate shell, and there are two jaws.
        self.shells = {name: _connected(triangles) for name, triangles in solids.items()}

    def depths(self, vertices: Float[np.ndarray, "V 3"]) -> dict[str, Float[np.ndarray, "V"]]:
        """Return the depth of each vertex in millimetres, by pair; 0 outside."""
        depths = {}
        for side in ("left eye", "right eye"):
            depths[f"lids in {side}"] = self._depth_in_solid(vertices, self.exterior, side)[0]
        depths["lips in tongue"] = self._depth_in_solid(vertices, self.exterior, "tongue")[0]
        for name, tested in (("lips", self.exterior), ("tongue", self.tongue)):
            depth, in_tooth = self._depth_in_solid(vertices, tested, "teeth")
            depths[f"{name} in teeth"] = np.where(in_tooth, depth, 0.0)
            depths[f"{name} in gums"] = np.where(in_tooth, 0.0, depth)
        inside = self.overlap.inside(vertices, np.flatnonzero(self.exterior | self.tongue))
        depths["tongue in skin"] = self._tongue_in_skin(vertices, inside[self.tongue[inside]])
        return depths | self._skin_in_skin(vertices, inside[self.exterior[inside]])

    def _depth_in_solid(
        self, vertices: Float[np.ndarray, "V 3"], tested: Bool[np.ndarray, "V"], solid: str
    ) -> tuple[Float[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
        """Return the largest depth in any shell of the solid, and whether the surface nearest there is a tooth's."""
        depth, in_tooth = np.zeros(len(vertices)), np.zeros(len(vertices), bool)
        for shell in self.shells[solid]:
            inside = _inside(vertices, tested, shell)
            if not len(inside):
                continue
            distance, face, _ = closest_points(vertices[inside], vertices, shell)
            deeper = distance * MM_PER_M > depth[inside]
            depth[inside[deeper]] = distance[deeper] * MM_PER_M
            in_tooth[inside[deeper]] = self.teeth[shell[face[deeper]]].any(1)
        return depth, in_tooth

    def _tongue_in_skin(
        self, vertices: Float[np.ndarray, "V 3"], inside: Int[np.ndarray, "N"]
    ) -> Float[np.ndarray, "V"]:
        """Return the depth where the outer skin is nearer than the oral lining, behind which the tongue's root lies."""
        depth = np.zeros(len(vertices))
        if len(inside):
            distance, face, _ = closest_points(vertices[inside], vertices, self.skin)
            depth[inside] = np.where(self.exterior_faces[face], distance * MM_PER_M, 0.0)
        return depth

    def _skin_in_skin(
        self, vertices: Float[np.ndarray, "V 3"], inside: Int[np.ndarray, "N"]
    ) -> dict[str, Float[np.ndarray, "V"]]:
        """Return the depths of the skin's self-intersections: lip in lip, ears, anything else.

        A lip's vertex counts as inside the other lip unless it entered the skin elsewhere, because the lips overlap in
        the template too. "ears in skin" is any self-intersection that involves an ear. A vertex that entered through an
        inner surface, such as an eyelid's rim through the eye socket, does not count.

        At the bottom of a crease the penetrated face begins at the vertex, which is then not behind it, and a distant
        one is found. But the way to a vertex that is not inside leads through the penetrated surface: no depth is
        larger than the distance to the nearest of these.
        """
        names = ("upper lip in lower lip", "lower lip in upper lip", "ears in skin", "skin in itself")
        depths = {name: np.zeros(len(vertices)) for name in names}

        def set_depths(name: str, members: Int[np.ndarray, "N"], distance: Float[np.ndarray, "N"]) -> None:
            depths[name][members] = distance * MM_PER_M

        outside = np.setdiff1d(np.flatnonzero(self.exterior), inside)
        largest = np.full(len(vertices), np.inf)
        if len(inside) and len(outside):
            largest[inside] = cKDTree(vertices[outside]).query(vertices[inside])[0]
        lips = self.upper_lip | self.lower_lip
        other_faces = np.flatnonzero(self.exterior_faces & ~lips[self.skin].any(1))
        pairs = (self.upper_lip, self.lower_lip), (self.lower_lip, self.upper_lip)
        for name, (lip, other_lip) in zip(names, pairs, strict=False):
            members = inside[lip[inside]]
            to_lip = _distance(vertices, members, self.skin[other_lip[self.skin].all(1)])
            distance, _, penetrated = self.overlap.penetrated_faces(vertices, members, other_faces, to_lip)
            elsewhere = penetrated & (distance < to_lip) | np.isinf(to_lip)
            set_depths(name, members[~elsewhere], to_lip[~elsewhere])
            set_depths(names[-1], members[elsewhere], np.minimum(distance, largest[members])[elsewhere])
        members = inside[~lips[inside]]
        unbounded = np.full(len(members), np.inf)
        distance, face, _ = self.overlap.penetrated_faces(vertices, members, np.arange(len(self.skin)), unbounded)
        in_ear = self.ears[members] | self.ears[self.skin[face]].all(1)
        distance = np.where(self.exterior_faces[face], np.minimum(distance, largest[members]), 0.0)
        for name, rows in (("ears in skin", in_ear), ("skin in itself", ~in_ear)):
            set_depths(name, members[rows], distance[rows])
        return depths


def _connected(triangles: Int[np.ndarray, "F 3"]) -> list[Int[np.ndarray, "_ 3"]]:
    part = connected_parts(triangles)
    return [triangles[part == number] for number in np.unique(part)]


def _inside(
    vertices: Float[np.ndarray, "V 3"], tested: Bool[np.ndarray, "V"], triangles: Int[np.ndarray, "_ 3"]
) -> Int[np.ndarray, "M"]:
    """Return the tested vertices that lie inside the triangles' surface, its openings closed."""
    surface, faces = closed(vertices, triangles)
    corners = surface[faces]
    # A closed surface does not wind around a point outside its bounding box, where almost all vertices are.
    low, high = corners.min((0, 1)), corners.max((0, 1))
    members = np.flatnonzero(tested)
    members = members[((vertices[members] >= low) & (vertices[members] <= high)).all(1)]
    if not len(members):
        return members
    return members[Winding(surface, faces).numbers(vertices[members]) > _INSIDE]


def _distance(
    vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"], surface: Int[np.ndarray, "_ 3"]
) -> Float[np.ndarray, "N"]:
    """Return the distance of the members to the surface, in the vertices' unit; infinity without triangles."""
    if not len(members) or not len(surface):
        return np.full(len(members), np.inf)
    return closest_points(vertices[members], vertices, surface)[0]
