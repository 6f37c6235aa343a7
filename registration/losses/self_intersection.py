"""What keeps the parts of a head out of one another: lids and eyeballs, lips, teeth, tongue, ears and the head.

A vertex is penalised by the square of how much deeper it lies in the other part than in the template, beyond a margin:
contact is the normal state of lids and lips, and the template runs through itself in places. An eyeball is the union of
two spheres; everything else is a surface that vertices get behind. Eye sockets and the mouth's lining are left out: in
the model they lie inside their neighbours.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from registration.frames import MM_PER_M
from registration.geometry.contacts import Flesh, Solids, Watched, depths
from registration.geometry.spheres import fit_sphere, on_main_sphere
from registration.geometry.topology import connected_parts, edges
from registration.model import regions
from registration.model.gnm_npz import GNMData

# Lengths in mm of the template's size.
_MARGIN = 0.05  # so much deeper than at rest costs nothing
_OUTSIDE, _INSIDE = 3.0, 8.0  # vertices so far in front of and behind a surface are watched
_BEHIND_EARS = 25.0  # the part of the head that ears can get to
_AROUND = 5.0  # skin around that and around lips, by which it is told what lies inside
_LINING = 6.0  # of the mouth, as far as it belongs to a lip
_LIDS = 6.0  # from the eyeball
_LEAST_CORNEA = 8  # vertices; fewer are no second sphere
OF_THE_TONGUE = ("tongue-teeth", "tongue-lips", "tongue-palate", "tongue-gums")


class SelfIntersection:
    """How much deeper than in the template the parts of a posed head run into one another.

    Works in the mesh's own geometry: any rigid pose and any scale of the head. What may touch what is looked up by
    `refresh`, before the first call and then every ten steps or so.
    """

    def __init__(self, data: GNMData, device: torch.device):
        """Finds the parts, and how deep they overlap at rest.

        Raises InputError if the model lacks a vertex group that names a part.
        """
        self._device = device
        self._skin = np.flatnonzero(regions.exterior(data))
        template = torch.as_tensor(data.template_vertex_positions, dtype=torch.float32, device=device)
        self._size = _spread(template[self._skin])
        rest = data.template_vertex_positions.astype(np.float64) * MM_PER_M
        self._eyeballs = [_Eyeball(data, shell, rest, device) for shell in regions.eyeball_shells(data)]
        self._surfaces = _surfaces(data, rest)
        self.pairs = ("lids-eyeballs", *dict.fromkeys(name for name, _ in self._surfaces))
        # Every point of every contact has a slot, which says how deep it may lie.
        points = [eyeball.points for eyeball in self._eyeballs] + [surface.points for _, surface in self._surfaces]
        self._slots = np.cumsum([0, *(len(index) for index in points)])
        self._own = torch.zeros(self._slots[-1], device=device)  # that of the template
        self._allowed = self._own
        self.accept(template)
        self._own = self._allowed = self._allowed + _MARGIN

    def accept(self, vertices: Float[Tensor, "V 3"], pairs: Sequence[str] | None = None) -> None:
        """From now on what is no deeper than in this head or in the template costs nothing, in some pairs or in all.

        `vertices` are posed, in metres. What was accepted before is forgotten.
        """
        self._allowed = self._own
        self.refresh(vertices)
        slot, pair, _, depth = self._depths(vertices.detach())
        chosen = [number for number, name in enumerate(self.pairs) if pairs is None or name in pairs]
        taken = torch.isin(pair, torch.tensor(chosen, device=self._device))
        self._allowed = self._own.scatter_reduce(0, slot[taken], depth[taken], "amax")

    def refresh(self, vertices: Float[Tensor, "V 3"]) -> None:
        """Look up the head's size and what is near enough to touch. `vertices` are posed, in metres."""
        vertices = vertices.detach()
        self._scale = _spread(vertices[self._skin]) / self._size
        self._origin = vertices[self._skin].mean(0)
        local = self._local(vertices).cpu().numpy()
        allowed = np.split(self._allowed.cpu().numpy(), self._slots[1:-1])[len(self._eyeballs) :]
        found = [surface.watched(local, most) for (_, surface), most in zip(self._surfaces, allowed, strict=True)]
        self._index, self._watched = Watched.joined(found).to(self._device).compact()
        of = np.repeat(np.arange(len(found)), [len(rows.place) for rows in found])
        first = self._slots[len(self._eyeballs) + of]
        pair = np.array([self.pairs.index(name) for name, _ in self._surfaces])[of]
        self._slot = self._watched.place + torch.as_tensor(first, device=self._device)
        self._pair = torch.as_tensor(pair, device=self._device)

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Tensor]:
        """The penalty of each pair of parts: squares of excess depths summed over vertices; scalars, mm^2.

        `vertices` are posed, in metres. Differentiable in both parts; value and gradient are zero for the template.
        """
        slot, pair, _, depth = self._depths(vertices)
        excess = torch.relu(depth - self._allowed[slot])
        total = excess.new_zeros(len(self.pairs)).index_add(0, pair, excess.square())
        return dict(zip(self.pairs, self._scale**2 * total, strict=True))

    @torch.no_grad()
    def excess_mm(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, "V"]]:
        """For each pair of parts, by how much each vertex of the mesh lies too deep in the other part, mm."""
        slot, pair, points, depth = self._depths(vertices)
        excess = self._scale * torch.relu(depth - self._allowed[slot])
        found = excess.new_zeros(len(self.pairs), len(vertices))
        found.view(-1).scatter_reduce_(0, pair * len(vertices) + points, excess, "amax")
        return dict(zip(self.pairs, found, strict=True))

    def _local(self, vertices: Float[Tensor, "U 3"]) -> Float[Tensor, "U 3"]:
        return (vertices - self._origin) * (MM_PER_M / self._scale)

    def _depths(
        self, vertices: Float[Tensor, "V 3"]
    ) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"], Float[Tensor, "M"]]:
        """Slot, pair, vertex and depth (mm of the template's size) of all that is deeper than allowed, and of lids."""
        near = self._local(vertices.index_select(0, self._index))
        now = depths(near, self._watched)
        deep = (now.depth > self._allowed[self._slot]).nonzero()[:, 0]
        points = self._watched.points
        found = [(self._slot[deep], self._pair[deep], self._index[points[deep]], now.again(near, points, deep))]
        for eyeball, start in zip(self._eyeballs, self._slots, strict=False):
            depth = eyeball.depths(self._local(vertices.index_select(0, eyeball.index)))
            slot = torch.arange(start, start + len(depth), device=self._device)
            found.append((slot, torch.zeros_like(slot), eyeball.index[: len(depth)], depth))
        slot, pair, points, depth = (torch.cat(columns) for columns in zip(*found, strict=True))
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
        spheres = [index[main], index[bulge]] if bulge.sum() >= _LEAST_CORNEA else [index[main]]
        self.points = np.flatnonzero(regions.exterior(data) & _near(rest, shell, _LIDS))
        self.index = torch.as_tensor(np.concatenate([self.points, *spheres]), device=device)
        self._sizes = [len(part) for part in (self.points, *spheres)]

    def depths(self, vertices: Float[Tensor, "U 3"]) -> Float[Tensor, "P"]:
        """How deep each point lies in the eyeball; negative outside. Differentiable in the vertices at `index`."""
        lids, *spheres = vertices.split(self._sizes)
        found = []
        for sphere in spheres:
            centre, radius = fit_sphere(sphere)
            found.append(radius - (lids - centre).norm(dim=-1))
        return torch.stack(found).amax(0)


def _surfaces(data: GNMData, rest: Float[np.ndarray, "V 3"]) -> list[tuple[str, Solids]]:
    """Vertices and the parts that they can get into, each with the name of its pair."""
    mesh, skin = data.triangles.astype(np.int64), regions.solids(data)["skin"]
    upper, lower = regions.lips(data)
    inner_upper, inner_lower = _linings(data, rest)
    ears, teeth, tongue = regions.ears(data), _teeth(data), regions.tongue(data)
    head = regions.exterior(data) & ~ears & _near(rest, ears, _BEHIND_EARS)

    def part(members: np.ndarray) -> list[np.ndarray]:
        return [mesh[members[mesh].all(1)]]

    def into(points: np.ndarray, parts: list[np.ndarray], flesh: Flesh | None = None) -> Solids:
        return Solids(np.flatnonzero(points), parts, inside=_INSIDE, outside=_OUTSIDE, flesh=flesh)

    around_mouth, around_ears = (
        Flesh(skin[_near(rest, members, _AROUND)[skin].all(1)])
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


def _linings(data: GNMData, rest: Float[np.ndarray, "V 3"]) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """What the mouth's lining adds to the upper and the lower lip, so that neither ends where they touch.

    Lips overlap at rest, so what belongs to which is told by the way along the surface.
    """
    lining = regions.mouth_lining(data)
    ends = edges(data.triangles.astype(np.int64)).vertices
    length = np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1)
    graph = coo_matrix((length, ends.T), (len(rest), len(rest))).tocsr()
    to_upper, to_lower = (
        dijkstra(graph, directed=False, indices=np.flatnonzero(lip), min_only=True, limit=_LINING)
        if lip.any()
        else np.full(len(rest), np.inf)
        for lip in regions.lips(data)
    )
    lining &= np.isfinite(np.minimum(to_upper, to_lower))
    return lining & (to_upper <= to_lower), lining & (to_lower <= to_upper)


def _teeth(data: GNMData) -> list[Int[np.ndarray, "_ 3"]]:
    """The triangles of each tooth; what joins teeth is gum."""
    own = data.triangles[regions.teeth(data)[data.triangles].all(1)].astype(np.int64)
    part = connected_parts(own) if len(own) else np.empty(0, int)
    return [own[part == number] for number in np.unique(part)]


def _near(rest: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"], distance: float) -> Bool[np.ndarray, "V"]:
    """What lies within a distance of some vertices."""
    if not members.any():
        return np.zeros(len(rest), bool)
    return np.isfinite(cKDTree(rest[members]).query(rest, distance_upper_bound=distance)[0])


def _spread(points: Float[Tensor, "P 3"]) -> float:
    """Root mean square distance from the centre."""
    return float((points - points.mean(0)).square().sum(-1).mean().sqrt())
