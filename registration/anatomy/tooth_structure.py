"""Which vertices of a model are which tooth, where its neck is, and how it stands in its arch.

Found from the meshes and the official names alone. Teeth may be pieces of their own that stand in the gums, or crowns
that grow out of one surface with them; in both cases the teeth's vertex group falls into one piece per tooth. Teeth
have their FDI numbers: 1x upper right, 2x upper left, 3x lower left, 4x lower right; x = 1 central incisor .. 8 third
molar. Metres, the model's frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.anatomy.arch_curve import ArchCurve, fit_arch_curve
from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.quads import edges_of
from registration.geometry.topology import connected_parts
from registration.geometry.winding import Winding, closed
from registration.model import regions
from registration.model.gnm_npz import GNMData

COUNTS = (14, 16)  # teeth of an arch: without and with third molars
_STEPS = 32  # points on an edge between which the gum's surface is searched
_INSIDE = 0.5  # winding number


@dataclass(frozen=True, kw_only=True, eq=False)
class Tooth:
    """One tooth: its surface, the line where it leaves the gum, and its frame.

    The axes are rows: m along the arch from mesial to distal, b outwards to lip or cheek, h from the neck to the biting
    edge. They are left-handed on one side of each arch, since sides mirror one another. The origin is the mean of the
    neck line.
    """

    fdi: int
    vertices: Int[np.ndarray, "N"]  # ascending; what stands in the gum included
    triangles: Int[np.ndarray, "F 3"]  # indices into the model's vertices
    crown: Bool[np.ndarray, "N"]  # outside the gum
    neck: Int[np.ndarray, "L 2"]  # the neck line's points lie on these edges of the tooth, of the model's vertices,
    neck_weights: Float[np.ndarray, "L"]  # at this fraction of the way from the first to the second
    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size: Float[np.ndarray, "3"]  # of the crown along m, b and h

    def neck_line(self, vertices: Float[np.ndarray, "*S V 3"]) -> Float[np.ndarray, "*S L 3"]:
        """Return the points of the neck line of the model with these vertices."""
        weight = self.neck_weights[:, None]
        return (1 - weight) * vertices[..., self.neck[:, 0], :] + weight * vertices[..., self.neck[:, 1], :]


@dataclass(frozen=True, kw_only=True, eq=False)
class DentalArch:
    """The teeth and the gum of one jaw."""

    name: str  # upper, lower
    teeth: tuple[Tooth, ...]  # from the subject's right to left
    gum: Int[np.ndarray, "G"]  # vertices of the component that belong to no tooth
    gum_triangles: Int[np.ndarray, "F 3"]  # all triangles of the component that are no tooth's
    curve: ArchCurve

    @property
    def vertices(self) -> Int[np.ndarray, "N"]:
        """All vertices of teeth and gum, ascending."""
        return np.sort(np.concatenate([self.gum, *(tooth.vertices for tooth in self.teeth)]))


def find_teeth(data: GNMData) -> tuple[DentalArch, DentalArch]:
    """Find the teeth of the upper and of the lower arch.

    Raises:
        InputError: a vertex group is missing, an arch does not fall into 14 or 16 teeth, as many on either side, or a
            tooth does not stand in the gum. The message names the piece in doubt.
    """
    return _find_arch(data, "upper"), _find_arch(data, "lower")


def tooth_labels(arches: tuple[DentalArch, ...]) -> dict[int, Float[np.ndarray, "3"]]:
    """Return, for each FDI number, the middle of its biting edge in the template: where a picture names it."""
    return {t.fdi: t.origin + t.size[2] * t.axes[2] for arch in arches for t in arch.teeth}


def _find_arch(data: GNMData, name: str) -> DentalArch:
    vertices = data.template_vertex_positions.astype(np.float64)
    component = regions.group(data, f"{name}_teeth_and_gums") > 0.5
    of_tooth = component & regions.teeth(data)
    triangles = data.triangles[component[data.triangles].all(1)].astype(np.int64)
    on_tooth = of_tooth[triangles].all(1)
    surface = triangles[on_tooth]
    part = connected_parts(surface) if len(surface) else np.zeros(0, np.int64)
    pieces = [surface[part == label] for label in np.unique(part)]
    _check_count(name, pieces, vertices)
    centres = np.array([vertices[np.unique(piece)].mean(0) for piece in pieces])
    order = _along_arch(centres)
    _check_sides(name, centres[order])
    _check_groups(name, component & ~of_tooth & ~(regions.group(data, "gums") > 0.5), vertices)
    pieces, count = [pieces[k] for k in order], len(pieces)
    gum_triangles = triangles[~on_tooth]
    necks = [_neck(name, piece, gum_triangles, vertices) for piece in pieces]
    origins = np.array([_mean_of_line(neck, vertices) for neck in necks])
    curve = fit_arch_curve(origins)
    quadrants = (1, 2) if name == "upper" else (4, 3)
    half = count // 2
    numbers = [10 * quadrants[0] + half - k for k in range(half)] + [10 * quadrants[1] + k + 1 for k in range(half)]
    teeth = tuple(
        _tooth(fdi, piece, neck, curve, vertices) for fdi, piece, neck in zip(numbers, pieces, necks, strict=True)
    )
    in_teeth = np.zeros(len(vertices), bool)
    in_teeth[surface.ravel()] = True
    return DentalArch(
        name=name, teeth=teeth, gum=np.flatnonzero(component & ~in_teeth), gum_triangles=gum_triangles, curve=curve
    )


_Neck = tuple[np.ndarray, np.ndarray, np.ndarray]  # edges, weights, vertices in the gum


def _neck(
    name: str,
    piece: Int[np.ndarray, "F 3"],
    gum: Int[np.ndarray, "G 3"],
    vertices: Float[np.ndarray, "V 3"],
) -> _Neck:
    """Find where a tooth leaves the gum: the vertices that it shares with it, or where its edges pass its surface."""
    own = np.unique(piece)
    shared = np.intersect1d(own, gum)
    if len(shared):
        return np.stack([shared, shared], 1), np.zeros(len(shared)), np.zeros(0, np.int64)
    edges, _, _ = edges_of(piece)
    solid = Winding(*closed(vertices, gum))
    inside = solid.numbers(vertices[own]) > _INSIDE
    buried = np.isin(edges, own[inside])
    crossing = edges[buried.any(1) & ~buried.all(1)]
    if not len(crossing):
        centre = vertices[own].mean(0) * MM_PER_M
        raise InputError(
            f"A tooth of the {name} arch does not stand in the gum",
            where=f"the piece of {len(own)} vertices at {np.round(centre, 1).tolist()} mm",
            expected="a crown outside the gum and a root inside it, or vertices that both share",
            got=f"{int(inside.sum())} of its {len(own)} vertices inside the gum",
            fix="close the gum, or let it reach the teeth",
        )
    flip = np.isin(crossing[:, 0], own[inside])  # from crown to root
    crossing[flip] = crossing[flip, ::-1]
    steps = (np.arange(_STEPS) + 0.5) / _STEPS
    points = vertices[crossing[:, :1]] + steps[:, None] * (vertices[crossing[:, 1:]] - vertices[crossing[:, :1]])
    covered = (solid.numbers(points.reshape(-1, 3)) > _INSIDE).reshape(-1, _STEPS)
    first = np.where(covered.any(1), covered.argmax(1), _STEPS)
    return crossing, first / _STEPS, own[inside]


def _mean_of_line(neck: _Neck, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "3"]:
    edges, weights, _ = neck
    return ((1 - weights)[:, None] * vertices[edges[:, 0]] + weights[:, None] * vertices[edges[:, 1]]).mean(0)


def _tooth(
    fdi: int,
    piece: Int[np.ndarray, "F 3"],
    neck: _Neck,
    curve: ArchCurve,
    vertices: Float[np.ndarray, "V 3"],
) -> Tooth:
    own = np.unique(piece)
    crown = ~np.isin(own, neck[2])
    origin = _mean_of_line(neck, vertices)
    long_axis = vertices[own[crown]].mean(0) - origin
    tangent, outward = curve.directions(curve.locate(origin))
    distal = tangent if fdi // 10 in (2, 3) else -tangent
    h = long_axis / np.linalg.norm(long_axis)
    b = outward - (outward @ h) * h
    b /= np.linalg.norm(b)
    m = np.cross(b, h)
    m *= np.sign(m @ distal)
    axes = np.stack([m, b, h])
    local = (vertices[own[crown]] - origin) @ axes.T
    size = np.array([*np.ptp(local[:, :2], axis=0), local[:, 2].max()])
    return Tooth(
        fdi=fdi,
        vertices=own,
        triangles=piece,
        crown=crown,
        neck=neck[0],
        neck_weights=neck[1],
        origin=origin,
        axes=axes,
        size=size,
    )


def _along_arch(centres: Float[np.ndarray, "T 3"]) -> Int[np.ndarray, "T"]:
    """Order pieces from the subject's right to left around the arch, which opens backwards."""
    middle = (centres[:, 0].min() + centres[:, 0].max()) / 2
    back = centres[:, 2].min() - 1e-3
    return np.argsort(-np.arctan2(centres[:, 2] - back, centres[:, 0] - middle), kind="stable")


def _widths(pieces: list[Int[np.ndarray, "_ 3"]], vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "T"]:
    """The largest extent of each piece in plan view."""
    return np.array([np.ptp(vertices[np.unique(piece)][:, [0, 2]], axis=0).max() for piece in pieces])


def _check_groups(name: str, stray: Bool[np.ndarray, "V"], vertices: Float[np.ndarray, "V 3"]) -> None:
    """Each vertex of an arch is of a tooth or of the gums: others would count as skin in the layout of a model."""
    if stray.any():
        first = int(np.flatnonzero(stray)[0])
        raise InputError(
            f"Vertices of the {name} arch are neither teeth nor gums",
            where="vertex_groups: teeth, gums",
            expected=f"each vertex of {name}_teeth_and_gums in one of them",
            got=f"{int(stray.sum())} in neither, as {first} at {np.round(1e3 * vertices[first]).astype(int)} mm",
            fix="use a model with the official vertex groups",
        )


def _check_count(name: str, pieces: list[Int[np.ndarray, "_ 3"]], vertices: Float[np.ndarray, "V 3"]) -> None:
    if len(pieces) in COUNTS:
        return
    got = "no piece"
    if pieces:
        widths = _widths(pieces, vertices)
        typical = float(np.median(widths))
        k = int(np.abs(np.log(np.maximum(widths, 1e-6) / max(typical, 1e-6))).argmax())
        centre = np.round(vertices[np.unique(pieces[k])].mean(0) * MM_PER_M, 1).tolist()
        got = (
            f"{len(pieces)} pieces; in doubt is that at {centre} mm, {widths[k] * MM_PER_M:.1f} mm wide, "
            f"where the median is {typical * MM_PER_M:.1f} mm"
        )
    raise InputError(
        f"The {name} teeth do not fall into one piece per tooth",
        where=f"vertex groups 'teeth' and '{name}_teeth_and_gums'",
        expected=f"{COUNTS[0]} or {COUNTS[1]} connected pieces",
        got=got,
        fix="mark in the group 'teeth' the crowns alone, so that the vertices between two teeth are not in it",
    )


def _check_sides(name: str, centres: Float[np.ndarray, "T 3"]) -> None:
    """As many teeth on the left as on the right of the middle between both ends of the arch."""
    middle = (centres[0, 0] + centres[-1, 0]) / 2
    left = int((centres[:, 0] > middle).sum())
    if 2 * left == len(centres):
        return
    k = int(np.abs(centres[:, 0] - middle).argmin())
    raise InputError(
        f"The {name} arch has not as many teeth on the left as on the right",
        where=f"vertex groups 'teeth' and '{name}_teeth_and_gums'",
        expected=f"{len(centres) // 2} on each side of x = {middle * MM_PER_M:.1f} mm",
        got=f"{left} on the left; in doubt is the piece at {np.round(centres[k] * MM_PER_M, 1).tolist()} mm",
        fix="complete the arch on both sides, or remove the third molar that has no partner",
    )
