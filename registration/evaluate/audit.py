"""Where the parts of a registered head run through one another, told by winding numbers (docs/formats.md, "Figures").

It judges whatever a fit did to keep parts apart, so it shares nothing with a loss: parts are the mesh itself, not hulls
or spheres. A vertex is inside a part where the part, with its openings closed, winds around it more than half a time,
and as deep as the part's surface is away. The template's own parts overlap, which no registration can help: what counts
is the excess over the template's depth, vertex by vertex and pair by pair.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.evaluate.console_table import print_audit
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.self_overlap import SelfOverlap
from registration.geometry.topology import connected_parts
from registration.geometry.winding import Winding, closed
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.storage.registration_folder import load_registration, update_figures

TOLERANCE_MM = 0.3
BEYOND = f"vertices_beyond_{TOLERANCE_MM}mm"
_INSIDE = 0.5  # winding number


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One part in another: the vertices that are inside, here or in the template. 0 mm is outside."""

    name: str
    vertices: Int[np.ndarray, "N"]
    depth_mm: Float[np.ndarray, "N"]
    baseline_mm: Float[np.ndarray, "N"]  # the same vertex' depth in the template, at the mesh's scale

    @property
    def excess_mm(self) -> Float[np.ndarray, "N"]:
        return self.depth_mm - self.baseline_mm

    @property
    def beyond(self) -> Int[np.ndarray, "M"]:
        """The vertices that are deeper than in the template by more than the tolerance."""
        return self.vertices[self.excess_mm > TOLERANCE_MM]

    @property
    def figures(self) -> dict[str, Any]:
        return {
            "template_vertices": int((self.baseline_mm > 0).sum()),
            "template_max_mm": float(self.baseline_mm.max(initial=0)),
            BEYOND: len(self.beyond),
            "max_excess_mm": float(self.excess_mm.max(initial=0)),
        }


@dataclass(frozen=True, kw_only=True)
class Audit:
    """All pairs of parts, also those that do not meet."""

    pairs: tuple[Pair, ...]

    @property
    def beyond(self) -> Int[np.ndarray, "M"]:
        """The vertices beyond the tolerance in any pair, each once."""
        return np.unique(np.concatenate([pair.beyond for pair in self.pairs]))

    @property
    def figures(self) -> dict[str, Any]:
        """For a manifest: the number of vertices beyond the tolerance, and each pair's figures."""
        return {BEYOND: len(self.beyond), "pairs": {pair.name: pair.figures for pair in self.pairs}}


def audit(vertices: Float[np.ndarray, "V 3"], data: GNMData, scale: float = 1.0) -> Audit:
    """Find what of a posed mesh of this model lies inside what it should not.

    `vertices`: metres, any frame, model order; `scale`: the registration's, for the template is compared at the same
    size. Tested are the outer skin and the tongue; eye sockets, gums and the mouth's lining are not. A process'
    first audit with a model audits its template too.

    Raises:
        InputError: the vertices are not this model's, or not finite.
    """
    template = np.asarray(data.template_vertex_positions)
    if vertices.shape != template.shape or not np.isfinite(vertices).all():
        raise InputError(
            "The mesh cannot be audited",
            where="vertices",
            expected=f"finite numbers, {template.shape} as the model's template",
            got=f"{vertices.shape}, {int((~np.isfinite(vertices)).any(-1).sum())} not finite",
            fix="give a registration that did not fail, with the model it was made with",
        )
    parts, baseline = _template(data)
    found = parts.depths(np.asarray(vertices, np.float64))
    pairs = []
    for name, depth in found.items():
        own = scale * baseline[name]
        members = np.flatnonzero((depth > 0) | (own > 0))
        pairs.append(Pair(name=name, vertices=members, depth_mm=depth[members], baseline_mm=own[members]))
    return Audit(pairs=tuple(pairs))


def audit_folder(registration_dir: Path, model: Path) -> Audit:
    """Audit a registration folder with the model it was made with, print the table, add the figures to its manifest.

    Raises:
        InputError: the folder or the model cannot be read, or the model has another topology.
    """
    registration, data = load_registration(registration_dir), gnm_npz.read(model)
    if not np.array_equal(registration.triangles, data.triangles):
        raise InputError(
            "Registration and model have different topologies",
            where=model,
            expected=f"the triangles of {registration_dir}",
            got="others",
            fix="give the model that the registration was made with",
        )
    result = audit(registration.vertices, data, float(registration.scale))
    update_figures(registration_dir, {"intersections": result.figures})
    print_audit(result.figures, title=f"{registration_dir}: {registration.status}")
    return result


_audited: dict[str, tuple["_Parts", Mapping[str, Float[np.ndarray, "V"]]]] = {}  # the last model alone, by content


def _template(data: GNMData) -> tuple["_Parts", Mapping[str, Float[np.ndarray, "V"]]]:
    """A model's parts, and the depths in its template by pair: the same for all captures that a process registers."""
    content = gnm_npz.content_hash(data)
    if content not in _audited:
        parts = _Parts(data)
        _audited.clear()
        _audited[content] = parts, parts.depths(parts.rest)
    return _audited[content]


class _Parts:
    """What of a model is tested, and in what. F triangles of the skin."""

    def __init__(self, data: GNMData):
        self.rest = np.asarray(data.template_vertex_positions, np.float64)
        self.exterior, self.tongue = regions.exterior(data), regions.tongue(data)
        self.teeth, self.ears = regions.teeth(data), regions.ears(data)
        names, shares = regions.vertex_classes(data)
        self.upper, self.lower = (shares[:, names.index(name)] > 0.5 for name in ("upper_lip", "lower_lip"))
        solids = regions.solids(data)
        self.skin = solids.pop("skin")
        self.overlap = SelfOverlap(self.rest, self.skin)
        self.outer = self.exterior[self.skin].all(1)
        # Eyeballs have their iris in a shell of its own, jaws are two.
        self.shells = {name: _connected(triangles) for name, triangles in solids.items()}

    def depths(self, vertices: Float[np.ndarray, "V 3"]) -> dict[str, Float[np.ndarray, "V"]]:
        """Millimetres by pair, 0 outside."""
        found = {}
        for side in ("left eye", "right eye"):
            found[f"lids in {side}"] = self._in_solid(vertices, self.exterior, side)[0]
        found["lips in tongue"] = self._in_solid(vertices, self.exterior, "tongue")[0]
        for name, tested in (("lips", self.exterior), ("tongue", self.tongue)):
            depth, in_tooth = self._in_solid(vertices, tested, "teeth")
            found[f"{name} in teeth"] = np.where(in_tooth, depth, 0.0)
            found[f"{name} in gums"] = np.where(in_tooth, 0.0, depth)
        inside = self.overlap.inside(vertices, np.flatnonzero(self.exterior | self.tongue))
        found["tongue in skin"] = self._tongue_in_skin(vertices, inside[self.tongue[inside]])
        return found | self._skin_in_skin(vertices, inside[self.exterior[inside]])

    def _in_solid(
        self, vertices: Float[np.ndarray, "V 3"], tested: Bool[np.ndarray, "V"], solid: str
    ) -> tuple[Float[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
        """Depth in the shell that holds the vertex deepest, and whether its surface is a tooth's there."""
        depth, in_tooth = np.zeros(len(vertices)), np.zeros(len(vertices), bool)
        for shell in self.shells[solid]:
            inside = _inside(vertices, tested, shell)
            if not len(inside):
                continue
            away, face, _ = closest_points(vertices[inside], vertices, shell)
            deeper = away * MM_PER_M > depth[inside]
            depth[inside[deeper]] = away[deeper] * MM_PER_M
            in_tooth[inside[deeper]] = self.teeth[shell[face[deeper]]].any(1)
        return depth, in_tooth

    def _tongue_in_skin(
        self, vertices: Float[np.ndarray, "V 3"], inside: Int[np.ndarray, "N"]
    ) -> Float[np.ndarray, "V"]:
        """The tongue's root lies behind the mouth's lining: only where the outer skin is nearer does it count."""
        depth = np.zeros(len(vertices))
        if len(inside):
            away, face, _ = closest_points(vertices[inside], vertices, self.skin)
            depth[inside] = np.where(self.outer[face], away * MM_PER_M, 0.0)
        return depth

    def _skin_in_skin(
        self, vertices: Float[np.ndarray, "V 3"], inside: Int[np.ndarray, "N"]
    ) -> dict[str, Float[np.ndarray, "V"]]:
        """A lip's vertex is in the other lip unless it came in elsewhere: the lips overlap in the template too.

        An ear's row is every crossing that an ear takes part in, with itself too. What came in through a lining, as a
        lid's rim through the eye's socket, is left out.
        """
        names = ("upper lip in lower lip", "lower lip in upper lip", "ears in skin", "skin in itself")
        found = {name: np.zeros(len(vertices)) for name in names}

        def enter(name: str, members: Int[np.ndarray, "N"], away: Float[np.ndarray, "N"]) -> None:
            found[name][members] = away * MM_PER_M

        of_lips = (self.upper | self.lower)[self.skin].any(1)
        for name, lip, other in zip(names, (self.upper, self.lower), (self.lower, self.upper), strict=False):
            members = inside[lip[inside]]
            across = _distance(vertices, members, self.skin[other[self.skin].all(1)])
            away, _, sure = self.overlap.ways_out(vertices, members, np.flatnonzero(self.outer & ~of_lips), across)
            elsewhere = sure & (away < across) | np.isinf(across)
            enter(name, members[~elsewhere], across[~elsewhere])
            enter(names[-1], members[elsewhere], away[elsewhere])
        members = inside[~(self.upper | self.lower)[inside]]
        unbounded = np.full(len(members), np.inf)
        away, face, _ = self.overlap.ways_out(vertices, members, np.arange(len(self.skin)), unbounded)
        ear = self.ears[members] | self.ears[self.skin[face]].all(1)
        for name, here in (("ears in skin", ear), ("skin in itself", ~ear)):
            enter(name, members[here], np.where(self.outer[face], away, 0.0)[here])
        return found


def _connected(triangles: Int[np.ndarray, "F 3"]) -> list[Int[np.ndarray, "_ 3"]]:
    part = connected_parts(triangles)
    return [triangles[part == number] for number in np.unique(part)]


def _inside(
    vertices: Float[np.ndarray, "V 3"], tested: Bool[np.ndarray, "V"], triangles: Int[np.ndarray, "_ 3"]
) -> Int[np.ndarray, "M"]:
    """Which of the tested vertices lie inside the closed mesh of others."""
    members = np.flatnonzero(tested)
    return members[Winding(*closed(vertices, triangles)).numbers(vertices[members]) > _INSIDE]


def _distance(
    vertices: Float[np.ndarray, "V 3"], members: Int[np.ndarray, "N"], surface: Int[np.ndarray, "_ 3"]
) -> Float[np.ndarray, "N"]:
    if not len(members) or not len(surface):
        return np.full(len(members), np.inf)
    return closest_points(vertices[members], vertices, surface)[0]
