"""What keeps the parts of a head out of one another: lids and eyeballs, lips, teeth, tongue, ears and the head.

A vertex is penalised by the square of how much deeper it lies in the other part than in the template, beyond a margin:
contact is the normal state of lids and lips, and the template runs through itself in places. An eyeball is the union of
two spheres, a tooth or a slice of the tongue is convex, and lips and ears are behind the triangle that they face.
Eye sockets, the mouth's lining and the lower gums are left out: the model's own lie inside their neighbours.
"""

from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from registration.frames import MM_PER_M
from registration.geometry.contacts import Facing, plane_depths
from registration.geometry.hulls import ConvexParts
from registration.geometry.quads import triangles_of
from registration.geometry.spheres import fit_sphere, on_main_sphere
from registration.geometry.topology import connected_parts
from registration.model import regions
from registration.model.gnm_npz import GNMData

# Lengths in mm of the template's size.
_MARGIN = 0.05  # so much deeper than at rest costs nothing
_LID_REACH = 6.0  # skin so near to an eyeball in the template can get into it
_HULL_REACH = 3.0  # vertices so near to a convex part are watched until the next refresh
_FACING_REACH = 4.0
_APART = 10.0  # along the skin, for its contacts with itself
_NEIGHBOURS = 25.0  # skin further away than this in the template never gets in touch
_LEAST_CORNEA = 8  # vertices; fewer are no second sphere
_SLICES = 6  # of the tongue, lengthwise
# The floor of the mouth: a normal's upward share, and where the tongue's underside lies over it.
_UPWARDS, _UNDER, _BELOW = 0.3, 3.0, 1.0

# For some of a contact's points, their places in `points`, and how deep they lie, mm.
Depths = tuple[Int[Tensor, "M"], Float[Tensor, "M"]]


class SelfIntersection:
    """How much deeper than in the template the parts of a posed head run into one another.

    Works in the mesh's own geometry: any rigid pose and any scale of the head. What may touch what is looked up by
    `refresh`, every ten steps or so; between two refreshes the penalties are continuous in the vertices.
    """

    def __init__(self, data: GNMData, device: torch.device):
        """Reads the template's contacts. Raises InputError if the model lacks a vertex group that names a part."""
        self._skin = np.flatnonzero(regions.exterior(data))
        template = data.template_vertex_positions.astype(np.float64)
        self._size = _spread(template[self._skin])
        self._origin = torch.zeros(3, device=device)
        self._scale = 1.0
        rest = template * MM_PER_M
        parts = _Parts(data, rest, device)
        for hulls in parts.hulls:
            hulls.refresh(rest)
        self._hulls = parts.hulls
        self._contacts = {
            name: [_Allowing(contact, rest, device) for contact in contacts]
            for name, contacts in parts.contacts.items()
        }

    def refresh(self, vertices: Float[Tensor, "V 3"]) -> None:
        """Look up the head's size, the parts' hulls, and what is near enough to touch; posed vertices, metres."""
        points = vertices.detach().cpu().numpy().astype(np.float64)
        origin = points[self._skin].mean(0)
        self._scale = float(_spread(points[self._skin]) / self._size)
        self._origin = torch.as_tensor(origin, dtype=vertices.dtype, device=vertices.device)
        local = (points - origin) * (MM_PER_M / self._scale)
        for hulls in self._hulls:
            hulls.refresh(local)
        for contacts in self._contacts.values():
            for contact in contacts:
                contact.refresh(local)

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Tensor]:
        """The penalty of each pair of parts: squares of excess depths (mm^2) summed over vertices; scalars.

        `vertices` are posed, in metres. Differentiable in both parts; value and gradient are zero for the template.
        """
        return {
            name: self._scale**2 * torch.stack([excess.square().sum() for _, excess in excesses]).sum()
            for name, excesses in self._excesses(vertices).items()
        }

    @torch.no_grad()
    def excess_mm(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, "V"]]:
        """For each pair and each vertex of the mesh by how much it is too deep in the other part, mm."""
        found = {}
        for name, excesses in self._excesses(vertices).items():
            found[name] = torch.zeros(len(vertices), dtype=vertices.dtype, device=vertices.device)
            for index, excess in excesses:
                found[name].scatter_reduce_(0, index, self._scale * excess, "amax")
        return found

    def _excesses(self, vertices: Tensor) -> dict[str, list[Depths]]:
        local = (vertices - self._origin) * (MM_PER_M / self._scale)
        return {name: [contact.excess(local) for contact in contacts] for name, contacts in self._contacts.items()}


class _Contact(Protocol):
    """Points against one or several other parts; vertices are in mm of the template's size."""

    points: Int[Tensor, "P"]

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None: ...

    def depths(self, vertices: Float[Tensor, "V 3"]) -> Depths: ...


class _Allowing:
    """A contact with what it allows each point: its depth at rest, and the margin."""

    def __init__(self, contact: _Contact, rest: Float[np.ndarray, "V 3"], device: torch.device):
        self._contact = contact
        self.refresh(rest)
        place, depth = contact.depths(torch.as_tensor(rest, dtype=torch.float32, device=device))
        deepest = torch.zeros(len(contact.points), device=device).scatter_reduce_(0, place, depth, "amax")
        self._allowed = deepest + _MARGIN

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        self._contact.refresh(vertices)

    def excess(self, vertices: Float[Tensor, "V 3"]) -> Depths:
        """Vertices, not places, and how much too deep they are; zero or more."""
        place, depth = self._contact.depths(vertices)
        return self._contact.points[place], torch.relu(depth - self._allowed[place])


class _InEyeball:
    """Skin in one eyeball: the union of the spheres of sclera and cornea, found anew from its vertices."""

    def __init__(self, points: Tensor, sclera: Tensor, cornea: Tensor):
        self.points = points
        self._shells = [shell for shell in (sclera, cornea) if len(shell)]
        self._places = torch.arange(len(points), device=points.device)

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        pass

    def depths(self, vertices: Float[Tensor, "V 3"]) -> Depths:
        x = vertices.index_select(0, self.points)
        depths = []
        for shell in self._shells:
            centre, radius = fit_sphere(vertices.index_select(0, shell))
            depths.append(radius - (x - centre).norm(dim=-1))
        return self._places, torch.stack(depths).amax(0)


class _InParts:
    """Points in any of some convex parts."""

    def __init__(self, points: Tensor, parts: ConvexParts):
        self.points, self._parts = points, parts
        self._place = self._part = points[:0]

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        on_device = torch.as_tensor(vertices, dtype=torch.float32, device=self.points.device)
        self._place, self._part = self._parts.candidates(on_device, self.points, _HULL_REACH)

    def depths(self, vertices: Float[Tensor, "V 3"]) -> Depths:
        depth, facet = self._parts.deepest(vertices, self.points[self._place], self._part)
        inside = depth > 0
        place = self._place[inside]
        return place, plane_depths(vertices, self.points[place], facet[inside])


class _Behind:
    """Points of one surface behind the triangle of another that they face."""

    def __init__(self, facing: Facing, device: torch.device):
        self._facing = facing
        self.points = torch.as_tensor(facing.points, device=device)
        self._triangles = torch.as_tensor(facing.triangles, device=device)
        self._place = self._triangle = self.points[:0]

    def refresh(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        place, triangle = self._facing.find(vertices)
        self._place, self._triangle = (torch.as_tensor(index).to(self.points) for index in (place, triangle))

    def depths(self, vertices: Float[Tensor, "V 3"]) -> Depths:
        triangles = self._triangles[self._triangle]
        return self._place, plane_depths(vertices, self.points[self._place], triangles)


class _Parts:
    """The parts of a model that can run into one another, and their contacts by pair."""

    def __init__(self, data: GNMData, rest: Float[np.ndarray, "V 3"], device: torch.device):
        skin, ears, body = (
            regions.exterior(data),
            regions.ears(data),
            _tongue_body(data.quads, rest, regions.tongue(data)),
        )
        mesh = data.triangles[skin[data.triangles].all(1)].astype(np.int64)
        upper, lower = regions.lips(data)
        teeth = ConvexParts(_teeth(data), device)
        tongue = ConvexParts(_slices(body, rest), device)
        self.hulls = (teeth, tongue)

        def within(points: np.ndarray, parts: ConvexParts) -> _Contact:
            return _InParts(torch.as_tensor(np.flatnonzero(points), device=device), parts)

        def facing(points: np.ndarray, others: np.ndarray) -> _Contact:
            near = [_near(rest, part, _NEIGHBOURS) for part in (points, others)]
            points, others = points & near[1], others & near[0]
            other = mesh[others[mesh].all(1)]
            return _Behind(Facing(np.flatnonzero(points), other, mesh, rest, reach=_FACING_REACH, apart=_APART), device)

        in_body = np.isin(np.arange(len(rest)), body)
        self.contacts: dict[str, list[_Contact]] = {
            "lids-eyeballs": [_eyeball(shell, skin, rest, device) for shell in regions.eyeball_shells(data)],
            "lips-teeth": [within(upper | lower, teeth)],
            "upper-lower lip": [facing(upper, lower), facing(lower, upper)],
            "tongue-teeth": [within(in_body, teeth), within(regions.teeth(data), tongue)],
            "tongue-lips": [within(upper | lower, tongue)],
            "tongue-palate": [within(regions.palate(data), tongue)],
            "ears-head": [facing(ears, skin & ~ears), facing(skin & ~ears, ears)],
        }


def _eyeball(
    shell: Bool[np.ndarray, "V"], skin: Bool[np.ndarray, "V"], rest: Float[np.ndarray, "V 3"], device: torch.device
) -> _Contact:
    """The skin near one eyeball, against it."""
    index = np.flatnonzero(shell)
    on_sclera = on_main_sphere(rest[index])
    sclera, cornea = index[on_sclera], index[~on_sclera]
    # What lies inside the main sphere is no bulge.
    centre, radius = (value.numpy() for value in fit_sphere(torch.as_tensor(rest[sclera])))
    cornea = cornea[np.linalg.norm(rest[cornea] - centre, axis=1) > radius]
    if len(cornea) < _LEAST_CORNEA:
        cornea = cornea[:0]
    points = np.flatnonzero(skin & _near(rest, shell, _LID_REACH))
    return _InEyeball(*(torch.as_tensor(part, device=device) for part in (points, sclera, cornea)))


def _teeth(data: GNMData) -> list[Int[np.ndarray, "_ 3"]]:
    """The triangles of each tooth: teeth share no vertices, but for those of the gums."""
    own = data.triangles[regions.teeth(data)[data.triangles].all(1)].astype(np.int64)
    part = connected_parts(own)
    return [own[part == number] for number in np.unique(part)]


def _tongue_body(
    quads: Int[np.ndarray, "Q 4"], rest: Float[np.ndarray, "V 3"], tongue: Bool[np.ndarray, "V"]
) -> Int[np.ndarray, "B 4"]:
    """The tongue's quads without the floor of the mouth, where a model joins one to the tongue.

    The floor looks up at the tongue's underside, which looks down. A hull around both would hold the lower teeth.
    """
    own = quads[tongue[quads].all(1)].astype(np.int64)
    a, b, c, d = (rest[own[:, k]] for k in range(4))
    normal = np.cross(c - a, d - b)
    up = normal[:, 1] / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    centre = (a + b + c + d) / 4
    underside, upwards = np.flatnonzero(up < 0), np.flatnonzero(up > _UPWARDS)
    flat = [0, 2]
    above = cKDTree(centre[underside][:, flat]).query_ball_point(centre[upwards][:, flat], _UNDER)
    floor = [
        face
        for face, over in zip(upwards, above, strict=True)
        if (centre[underside[over], 1] > centre[face, 1] + _BELOW).any()
    ]
    return np.delete(own, floor, axis=0)


def _slices(body: Int[np.ndarray, "B 4"], rest: Float[np.ndarray, "V 3"]) -> list[Int[np.ndarray, "_ 3"]]:
    """The tongue's body cut from back to front, into triangles."""
    along = rest[body][:, :, 2].mean(1)
    low, high = along.min(), along.max()
    number = np.clip(_SLICES * (along - low) / (high - low), 0, _SLICES - 1).astype(int)
    return [triangles_of(body[number == k]) for k in np.unique(number)]


def _near(rest: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"], distance: float) -> Bool[np.ndarray, "V"]:
    """What is within a distance of some vertices."""
    if not members.any():
        return np.zeros(len(rest), bool)
    return np.isfinite(cKDTree(rest[members]).query(rest, distance_upper_bound=distance)[0])


def _spread(points: Float[np.ndarray, "P 3"]) -> float:
    """Root mean square distance from the centre."""
    return float(np.sqrt(np.square(points - points.mean(0)).sum(1).mean()))
