"""Self-intersection penalty between head parts: eyelids and eyeballs, lips, teeth, tongue, ears and the head.

For a pair of parts the loss is

    a * sum over vertices v of relu(depth(v) - tolerance(v))^2   [mm^2]

depth(v) is how deep v lies in the other part; tolerance(v) is its depth in the template plus a margin: eyelids and lips
are normally in contact, and the template has intersections. a is the mean area of the pair's vertices in the template,
relative to that of all pairs: images and the regularization of offsets count by area, too, against which the lids' many
small faces would otherwise be pushed off the eyeballs and rolled outwards. An eyeball is the union of two spheres;
every other part is a surface with an inside. Eye sockets and the oral lining are excluded: in the model they lie inside
their neighbours.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from registration.frames import MM_PER_M
from registration.geometry.contacts import ContactCandidates, ContactSearch, Interior, depths
from registration.geometry.geodesic import edge_distances
from registration.geometry.spheres import fit_sphere, on_main_sphere
from registration.geometry.topology import connected_parts, edges, vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

# Lengths in mm, for a head of the template's size.
_MARGIN = 0.05  # added to the depth in the template
_OUTSIDE, _INSIDE = 3.0, 8.0  # distance of candidate vertices in front of and behind a surface
_BEHIND_EARS = 25.0  # distance from the ears of the part of the head that they can touch
_INTERIOR_DISTANCE = 5.0  # of the skin around ears and lips that bounds the interior there
_LINING = 6.0  # distance along the surface from a lip of the oral lining that belongs to it
_LIDS = 6.0  # distance of eyelid vertices from the eyeball
_MIN_CORNEA = 8  # vertices of a second sphere
OF_THE_TONGUE = ("tongue-teeth", "tongue-lips", "tongue-palate", "tongue-gums")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidates:
    """The vertices that may touch another part in one pose of the head."""

    scale: float  # size of the head relative to the template
    origin: Float[Tensor, "3"]  # of the skin, world, metres
    index: Int[Tensor, "U"]  # the vertices that take part
    contacts: ContactCandidates  # in rows of `index`
    slot: Int[Tensor, "M"]  # of each candidate, into the tolerances
    pair: Int[Tensor, "M"]  # of each candidate, into `SelfIntersectionPenalty.pairs`


class SelfIntersectionPenalty:
    """Penalty on parts of a posed head that intersect more deeply than in the template.

    Independent of the rigid pose and the scale of the head. The vertices that may touch are determined by
    `update_candidates`: before the first call with another head, and then about every ten steps.

    Args:
        data: the model.
        device: of the vertices.

    Attributes:
        pairs: their names.
        weights: a of each pair.

    Raises:
        InputError: the model lacks a vertex group that names a part.
    """

    def __init__(self, data: GNMData, device: torch.device):
        self._device = device
        self._skin = np.flatnonzero(regions.exterior(data))
        template = torch.as_tensor(data.template_vertex_positions, dtype=torch.float32, device=device)
        self._size = _rms_radius(template[self._skin])
        rest = data.template_vertex_positions.astype(np.float64) * MM_PER_M
        self._eyeballs = [_Eyeball(data, shell, rest, device) for shell in regions.eyeball_shells(data)]
        self._surfaces = _surfaces(data, rest)
        self.pairs = ("lids-eyeballs", *dict.fromkeys(name for name, _ in self._surfaces))
        # Every vertex of every contact has a slot in the tolerances.
        points = [eyeball.points for eyeball in self._eyeballs] + [surface.points for _, surface in self._surfaces]
        self._slots = np.cumsum([0, *(len(index) for index in points)])
        names = ["lids-eyeballs"] * len(self._eyeballs) + [name for name, _ in self._surfaces]
        weights = _area_weights(vertex_areas(rest, data.triangles), self.pairs, names, points)
        self.weights = torch.as_tensor(weights, dtype=torch.float32, device=device)
        none = torch.zeros(self._slots[-1], device=device)
        self._candidates = self._find_candidates(template, none)
        self._template_tolerance = self._depths_at_least(none, template, self.pairs) + _MARGIN
        self._tolerance = self._template_tolerance

    def set_rest_depths(self, vertices: Float[Tensor, "V 3"], pairs: Sequence[str] | None = None) -> None:
        """Set the tolerances to the depths in a head or in the template, whichever are larger.

        Replaces what an earlier call has set.

        Args:
            vertices: world, metres.
            pairs: those that the head's depths are for; None: all. The others have the template's.
        """
        least = self._template_tolerance
        self._candidates = self._find_candidates(vertices, least)
        self._tolerance = self._depths_at_least(least, vertices, self.pairs if pairs is None else pairs)

    def update_candidates(self, vertices: Float[Tensor, "V 3"]) -> None:
        """Determine the head's size and the vertices that may touch another part.

        Args:
            vertices: world, metres.
        """
        self._candidates = self._find_candidates(vertices, self._tolerance)

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, ""]]:
        """Return the penalty of each pair of parts.

        Args:
            vertices: world, metres.

        Returns:
            Pair -> weighted sum over vertices of squared excess depths, mm^2. Differentiable in both parts; value and
            gradient are zero for the template.
        """
        slot, pair, _, depth = self._depths(vertices, self._candidates, self._tolerance)
        excess = torch.relu(depth - self._tolerance[slot])
        total = excess.new_zeros(len(self.pairs)).index_add(0, pair, excess.square())
        return dict(zip(self.pairs, self._candidates.scale**2 * self.weights * total, strict=True))

    @torch.no_grad()
    def excess_mm(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, "V"]]:
        """Return how much too deep each vertex lies in the other part.

        Args:
            vertices: world, metres.

        Returns:
            Pair -> excess depth of every vertex of the mesh, mm of this head.
        """
        slot, pair, points, depth = self._depths(vertices, self._candidates, self._tolerance)
        excess = self._candidates.scale * torch.relu(depth - self._tolerance[slot])
        by_pair = excess.new_zeros(len(self.pairs), len(vertices))
        by_pair.view(-1).scatter_reduce_(0, pair * len(vertices) + points, excess, "amax")
        return dict(zip(self.pairs, by_pair, strict=True))

    def _depths_at_least(
        self, least: Float[Tensor, "Z"], vertices: Float[Tensor, "V 3"], pairs: Sequence[str]
    ) -> Float[Tensor, "Z"]:
        """The depths of some pairs in a head, mm of the template's size, or `least` where that is more."""
        slot, pair, _, depth = self._depths(vertices.detach(), self._candidates, least)
        chosen = [number for number, name in enumerate(self.pairs) if name in pairs]
        taken = torch.isin(pair, torch.tensor(chosen, device=self._device))
        return least.scatter_reduce(0, slot[taken], depth[taken], "amax")

    def _find_candidates(self, vertices: Float[Tensor, "V 3"], tolerance: Float[Tensor, "Z"]) -> _Candidates:
        vertices = vertices.detach()
        skin = vertices[self._skin]
        scale, origin = _rms_radius(skin) / self._size, skin.mean(0)
        local = ((vertices - origin) * (MM_PER_M / scale)).cpu().numpy()
        tolerances = np.split(tolerance.cpu().numpy(), self._slots[1:-1])[len(self._eyeballs) :]
        searches = [search for _, search in self._surfaces]
        contacts = [search.candidates(local, allowed) for search, allowed in zip(searches, tolerances, strict=True)]
        index, joined = ContactCandidates.concatenate(contacts).to(self._device).compact()
        surface = np.repeat(np.arange(len(contacts)), [len(rows.query) for rows in contacts])
        first = self._slots[len(self._eyeballs) + surface]
        pair = np.array([self.pairs.index(name) for name, _ in self._surfaces])[surface]
        return _Candidates(
            scale=scale,
            origin=origin,
            index=index,
            contacts=joined,
            slot=joined.query + torch.as_tensor(first, device=self._device),
            pair=torch.as_tensor(pair, device=self._device),
        )

    def _depths(
        self, vertices: Float[Tensor, "V 3"], candidates: _Candidates, tolerance: Float[Tensor, "Z"]
    ) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"], Float[Tensor, "M"]]:
        """Slot, pair, vertex and depth (mm of the template's size) of eyelids and of all deeper than tolerated."""

        def local(index: Int[Tensor, "U"]) -> Float[Tensor, "U 3"]:
            return (vertices.index_select(0, index) - candidates.origin) * (MM_PER_M / candidates.scale)

        near = local(candidates.index)
        current = depths(near, candidates.contacts)
        deep = (current.depth > tolerance[candidates.slot]).nonzero()[:, 0]
        points = candidates.contacts.points
        differentiable = current.differentiable(near, points, deep)
        parts = [(candidates.slot[deep], candidates.pair[deep], candidates.index[points[deep]], differentiable)]
        for eyeball, start in zip(self._eyeballs, self._slots, strict=False):
            depth = eyeball.depths(local(eyeball.index))
            slot = torch.arange(start, start + len(depth), device=self._device)
            parts.append((slot, torch.zeros_like(slot), eyeball.index[: len(depth)], depth))
        slot, pair, points, depth = (torch.cat(columns) for columns in zip(*parts, strict=True))
        return slot, pair, points, depth


class _Eyeball:
    """The skin around one eyeball, against the union of the spheres of sclera and cornea."""

    def __init__(
        self, data: GNMData, shell: Bool[np.ndarray, "V"], rest: Float[np.ndarray, "V 3"], device: torch.device
    ):
        index = np.flatnonzero(shell)
        main = on_main_sphere(rest[index])
        centre, radius = (value.numpy() for value in fit_sphere(torch.as_tensor(rest[index[main]])))
        bulge = ~main & (np.linalg.norm(rest[index] - centre, axis=1) > radius)
        spheres = [index[main], index[bulge]] if bulge.sum() >= _MIN_CORNEA else [index[main]]
        self.points = np.flatnonzero(regions.exterior(data) & _near(rest, shell, _LIDS))
        self.index = torch.as_tensor(np.concatenate([self.points, *spheres]), device=device)
        self._sizes = [len(part) for part in (self.points, *spheres)]

    def depths(self, vertices: Float[Tensor, "U 3"]) -> Float[Tensor, "P"]:
        """How deep each point lies in the eyeball; negative outside. Differentiable in the vertices at `index`."""
        lids, *spheres = vertices.split(self._sizes)
        in_spheres = []
        for sphere in spheres:
            centre, radius = fit_sphere(sphere)
            in_spheres.append(radius - (lids - centre).norm(dim=-1))
        return torch.stack(in_spheres).amax(0)


def _surfaces(data: GNMData, rest: Float[np.ndarray, "V 3"]) -> list[tuple[str, ContactSearch]]:
    """Vertices and the parts that they can penetrate, each with the name of its pair."""
    mesh, skin = data.triangles.astype(np.int64), regions.solids(data)["skin"]
    upper, lower = regions.lips(data)
    inner_upper, inner_lower = _linings(data, rest)
    ears, teeth, tongue = regions.ears(data), _teeth(data), regions.tongue(data)
    head = regions.exterior(data) & ~ears & _near(rest, ears, _BEHIND_EARS)

    def part(members: np.ndarray) -> list[np.ndarray]:
        return [mesh[members[mesh].all(1)]]

    def into(points: np.ndarray, parts: list[np.ndarray], interior: Interior | None = None) -> ContactSearch:
        return ContactSearch(np.flatnonzero(points), parts, inside=_INSIDE, outside=_OUTSIDE, interior=interior)

    around_mouth, around_ears = (
        Interior(skin[_near(rest, members, _INTERIOR_DISTANCE)[skin].all(1)])
        for members in (upper | lower | regions.mouth_lining(data), ears | head)
    )
    return [
        ("lips-teeth", into(upper | lower, teeth)),
        ("upper-lower lip", into(upper, part(lower | inner_lower), around_mouth)),
        ("upper-lower lip", into(lower, part(upper | inner_upper), around_mouth)),
        ("tongue-teeth", into(tongue, teeth)),
        ("tongue-teeth", into(regions.teeth(data), part(tongue))),
        ("tongue-lips", into(upper | lower, part(tongue))),
        ("tongue-palate", into(regions.palate(data), part(tongue))),
        ("tongue-gums", into(tongue, [triangles for jaw in regions.gums(data) for triangles in part(jaw)])),
        ("ears-head", into(ears, part(head), around_ears)),
        ("ears-head", into(head, part(ears), around_ears)),
    ]


def _area_weights(
    areas: Float[np.ndarray, "V"], pairs: Sequence[str], names: Sequence[str], points: Sequence[Int[np.ndarray, "_"]]
) -> Float[np.ndarray, "Q"]:
    """The mean area of each pair's vertices relative to that of all; zero for a pair without vertices.

    Args:
        areas: of the vertices.
        pairs: the Q names.
        names: of the pair of each list of vertices.
        points: the lists.
    """
    weights = np.zeros(len(pairs))
    for number, pair in enumerate(pairs):
        members = np.unique(np.concatenate([own for name, own in zip(names, points, strict=True) if name == pair]))
        weights[number] = areas[members].mean() if len(members) else 0.0
    return weights / areas[np.concatenate(points)].mean()


def _linings(data: GNMData, rest: Float[np.ndarray, "V 3"]) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """The oral lining that extends the upper and the lower lip, so that neither ends where they touch.

    Lips overlap in the template; the distance along the surface decides which vertex belongs to which.
    """
    lining = regions.mouth_lining(data)
    along = edges(data.triangles.astype(np.int64)).vertices
    to_upper, to_lower = (edge_distances(rest, along, lip, _LINING) for lip in regions.lips(data))
    lining &= np.isfinite(np.minimum(to_upper, to_lower))
    return lining & (to_upper <= to_lower), lining & (to_lower <= to_upper)


def _teeth(data: GNMData) -> list[Int[np.ndarray, "_ 3"]]:
    """The triangles of each tooth."""
    teeth = data.triangles[regions.teeth(data)[data.triangles].all(1)].astype(np.int64)
    part = connected_parts(teeth) if len(teeth) else np.empty(0, int)
    return [teeth[part == number] for number in np.unique(part)]


def _near(rest: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"], distance: float) -> Bool[np.ndarray, "V"]:
    """Vertices within a distance (mm) of some members."""
    if not members.any():
        return np.zeros(len(rest), bool)
    return np.isfinite(cKDTree(rest[members]).query(rest, distance_upper_bound=distance)[0])


def _rms_radius(points: Float[Tensor, "P 3"]) -> float:
    """Root mean square distance from the centroid."""
    return float((points - points.mean(0)).square().sum(-1).mean().sqrt())
