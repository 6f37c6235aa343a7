"""Procedural teeth: fourteen closed crowns and one gum band per arch, all quads, metres.

Sizes of the permanent teeth: Nelson and Ash, Wheeler's Dental Anatomy, table of measurements (crown length, mesiodistal
and buccolingual diameters). Inclinations are those of the long axes to the normal of the occlusal plane. Teeth go by
their FDI numbers: 1x upper right, 2x upper left, 3x lower left, 4x lower right; x = 1 central incisor .. 7 second
molar.

A tooth's own frame: m runs along the arch from mesial to distal, b outwards (to lip or cheek), h towards the tip, zero
at the neck.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from coregister.first_model.part import Part
from registration.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Crown:
    """The form that teeth of one kind share. Grid: cells of the biting surface along m and along b, both even."""

    cells: tuple[int, int]
    # From root to rim: height (of the crown's), half width (of half the width), buccal and lingual surface (of half the
    # depth), and the exponent of the superellipse: 2 is round, more is boxy. The root's height is in metres.
    rings: tuple[tuple[float, float, float, float, float], ...]
    falls: tuple[float, float]  # how much lower (of the height) the rim lies at its mesial and distal end
    # The biting surface inside the rim, b the outer and m the inner index: m (of half the width), b (of half the
    # depth), height (of the crown's).
    top: tuple[tuple[float, float, float], ...]
    taper: float  # how much narrower it is on its lingual side
    tip: int  # which point of `top` is its landmark


@dataclass(frozen=True, kw_only=True)
class Tooth:
    """One tooth's size in metres and its stance in the arch."""

    crown: Crown
    width: float  # mesiodistal
    height: float  # of the crown
    depth: float  # buccolingual
    tilt: float  # degrees by which the tip leans outwards
    lean: float = 0.0  # degrees by which the tip leans towards the midline
    reach: float  # of the tip beyond the occlusal plane, towards the other arch


_INCISOR = Crown(
    cells=(4, 2),
    rings=(
        (-3.0e-3, 0.55, 0.72, -0.72, 2.0),
        (0.0, 0.75, 0.96, -0.96, 2.2),
        (0.48, 0.95, 0.86, -0.40, 2.8),
        (0.92, 1.00, 0.36, -0.16, 3.5),
    ),
    falls=(0.02, 0.06),
    top=((-0.55, 0.12, 0.995), (0.0, 0.12, 1.0), (0.5, 0.12, 0.985)),
    taper=0.40,
    tip=1,
)
_CANINE = Crown(
    cells=(4, 2),
    rings=(
        (-3.0e-3, 0.60, 0.80, -0.80, 2.0),
        (0.0, 0.74, 0.96, -0.96, 2.1),
        (0.45, 1.00, 0.92, -0.55, 2.5),
        (0.82, 0.96, 0.52, -0.30, 2.8),
    ),
    falls=(0.17, 0.24),
    top=((-0.48, 0.12, 0.87), (0.0, 0.12, 1.0), (0.48, 0.12, 0.83)),
    taper=0.30,
    tip=1,
)
_PREMOLAR = Crown(
    cells=(2, 4),
    rings=(
        (-3.0e-3, 0.66, 0.72, -0.72, 2.0),
        (0.0, 0.80, 0.86, -0.86, 2.4),
        (0.45, 1.0, 1.00, -0.98, 2.8),
        (0.80, 0.96, 0.80, -0.80, 3.0),
    ),
    falls=(0.04, 0.05),
    top=((0.0, -0.46, 0.93), (0.0, -0.02, 0.74), (0.0, 0.50, 1.0)),
    taper=0.18,
    tip=2,
)
_MOLAR = Crown(
    cells=(4, 4),
    rings=(
        (-3.0e-3, 0.74, 0.76, -0.76, 2.4),
        (0.0, 0.82, 0.88, -0.88, 2.6),
        (0.45, 1.0, 1.00, -1.00, 3.0),
        (0.80, 0.94, 0.80, -0.80, 3.0),
    ),
    falls=(0.0, 0.02),
    top=(
        (-0.46, -0.48, 0.98),
        (0.02, -0.50, 0.80),
        (0.46, -0.46, 0.92),
        (-0.55, 0.0, 0.80),
        (0.0, 0.0, 0.70),
        (0.52, 0.0, 0.78),
        (-0.48, 0.50, 1.0),
        (0.02, 0.54, 0.82),
        (0.46, 0.50, 0.95),
    ),
    taper=0.08,
    tip=6,
)
# From the midline outwards.
UPPER = (
    Tooth(crown=_INCISOR, width=8.5e-3, height=10.5e-3, depth=7.0e-3, tilt=24, lean=2, reach=1.4e-3),
    Tooth(crown=_INCISOR, width=6.5e-3, height=9.0e-3, depth=6.0e-3, tilt=22, lean=3, reach=0.9e-3),
    Tooth(crown=_CANINE, width=7.5e-3, height=10.0e-3, depth=8.0e-3, tilt=19, lean=3, reach=1.2e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=9.0e-3, tilt=10, lean=3, reach=0.75e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=9.0e-3, tilt=7, lean=2, reach=0.75e-3),
    Tooth(crown=_MOLAR, width=10.0e-3, height=7.5e-3, depth=11.0e-3, tilt=4, lean=1, reach=0.45e-3),
    Tooth(crown=_MOLAR, width=9.0e-3, height=7.0e-3, depth=11.0e-3, tilt=6, reach=0.45e-3),
)
LOWER = (
    Tooth(crown=_INCISOR, width=5.0e-3, height=9.0e-3, depth=6.0e-3, tilt=14, lean=1, reach=0.0),
    Tooth(crown=_INCISOR, width=5.5e-3, height=9.5e-3, depth=6.5e-3, tilt=12, lean=1.5, reach=0.0),
    Tooth(crown=_CANINE, width=7.0e-3, height=11.0e-3, depth=7.5e-3, tilt=8, lean=1, reach=0.2e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=7.5e-3, tilt=2, lean=2, reach=0.75e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.0e-3, depth=8.0e-3, tilt=-5, lean=1, reach=0.7e-3),
    Tooth(crown=_MOLAR, width=11.0e-3, height=7.5e-3, depth=10.5e-3, tilt=-8, reach=0.45e-3),
    Tooth(crown=_MOLAR, width=10.5e-3, height=7.0e-3, depth=10.0e-3, tilt=-8, reach=0.45e-3),
)
FDI_UPPER = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)  # from the subject's right to left
FDI_LOWER = (47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37)

OVERJET = 2.7e-3  # how far the line of the lower teeth lies inside that of the upper
_GAP = 0.06e-3  # between neighbours
_ARCH_EXPONENT = 2.2  # of the superellipse that the arch is in plan view
_FRONT_INSET, _SIDE_INSET = 3.1e-3, 5.6e-3  # from the guide's outline to the line on which the teeth touch
_LANDMARK_TEETH = (6, 3, 1)  # first molar, canine, central incisor
_SECTION = 10  # vertices around the gum
# The gum's cross-section from its crest over the outer side to its base, the inner side alike: distance from the middle
# of the neck as a share of the neck's own half depth, plus mm, and mm along h. At a tooth and between two teeth.
_GUM_AT_TOOTH = ((0, 0, -0.5), (0.9, 0, 0.7), (1, 0.5, -0.2), (1, 0.4, -3.2), (0.9, -1.4, -6), (0, 0, -7))
_GUM_BETWEEN = ((0, 0, 2.8), (0.55, 0, 2.4), (0.9, 0, 0.9), (1, 0.1, -2.8), (0.9, -1.5, -6), (0, 0, -7))


@dataclass(frozen=True, kw_only=True)
class Arch:
    """Where the teeth stand: half a superellipse in the occlusal plane, on which the upper teeth touch each other."""

    half_width: float  # x at the back
    front: float  # z at the midline
    back: float  # z where the arch is widest
    height: float  # y of the occlusal plane at the front
    slope: float  # by how much the occlusal plane rises per metre towards the back


def arch(upper_guide: Float[np.ndarray, "S 3"], lower_guide: Float[np.ndarray, "R 3"]) -> Arch:
    """The arch that fits coarse horseshoe strips around the upper and the lower teeth.

    The strips' vertices count only as points. The plan is the upper strip's outline, moved inwards so that the teeth
    keep clear of lips and cheeks; the occlusal plane lies midway between the upper strip's lower edge and the lower
    strip's upper edge.

    Raises:
        InputError: a guide has fewer than three points or one that is not finite, or the arch has no room for teeth.
    """
    for name, guide in (("upper_guide", upper_guide), ("lower_guide", lower_guide)):
        if len(guide) < 3 or not np.isfinite(guide).all():
            raise InputError(
                "this guide shows no dental arch",
                where=name,
                expected="at least three finite points, in metres",
                got=f"{len(guide)} points, {int((~np.isfinite(guide)).any(1).sum())} of them not finite",
                fix="give the vertices of a strip around the teeth",
            )
    half_width = float(np.abs(upper_guide[:, 0]).max() - _SIDE_INSET)
    front, back = float(upper_guide[:, 2].max() - _FRONT_INSET), float(upper_guide[:, 2].min())
    if half_width < 0.01 or front - back < 0.02 or np.ptp(lower_guide[:, 2]) < 0.01:
        raise InputError(
            "the guides leave no room for teeth",
            where="upper_guide, lower_guide",
            expected="arches more than 32 mm wide and 24 mm deep that open backwards",
            got=f"{half_width:.4f} m half a width and {front - back:.4f} m depth, less the distance to the lips",
            fix="check the unit (metres) and the frame (+Y up, +Z out of the face)",
        )
    edges = np.array([_edge(upper_guide, -1), _edge(lower_guide, 1)])  # arch, front or back, (z, y)
    slopes = (edges[:, 1, 1] - edges[:, 0, 1]) / (edges[:, 0, 0] - edges[:, 1, 0])
    heights = edges[:, 0, 1] + slopes * (edges[:, 0, 0] - front)
    height, slope = float(heights.mean()), float(slopes.mean())
    return Arch(half_width=half_width, front=front, back=back, height=height, slope=slope)


def upper(where: Arch, teeth: tuple[Tooth, ...] = UPPER) -> Part:
    """The upper teeth and gums: 1106 vertices, the teeth in the order of `FDI_UPPER`, then the gums.

    Teeth too wide for the arch are scaled to fit it, all alike. Groups: `teeth`, `gums`, `upper_teeth_and_gums`. In the
    uv map each tooth is unfolded from its tip into a chart of its own, with its root's end in a corner; the gum is a
    strip.
    """
    return _part(_stand(where, teeth, up=True), "upper_teeth_and_gums")


def lower(where: Arch, teeth: tuple[Tooth, ...] = LOWER) -> Part:
    """The lower teeth and gums, as `upper`, in the order of `FDI_LOWER` and within the upper arch by `OVERJET`."""
    return _part(_stand(where, teeth, up=False), "lower_teeth_and_gums")


def tooth_vertices(part: Part) -> Mapping[int, Int[np.ndarray, "N"]]:
    """FDI number -> the vertices of that tooth, from the subject's right to left; of a part made with default teeth."""
    names, teeth = (FDI_UPPER, UPPER) if "upper_teeth_and_gums" in part.groups else (FDI_LOWER, LOWER)
    sizes = [_crown_size(tooth.crown) for tooth in (*teeth[::-1], *teeth)]
    ends = np.cumsum(sizes)
    return {name: np.arange(end - size, end) for name, size, end in zip(names, sizes, ends, strict=True)}


def tips(part: Part) -> Mapping[int, int]:
    """FDI number -> the landmark vertex of six teeth, from the subject's right to left: first molar (its mesiobuccal
    cusp), canine (its tip), central incisor (the middle of its edge), and the same on the left."""
    teeth = UPPER if "upper_teeth_and_gums" in part.groups else LOWER
    found = {}
    for name, vertices in tooth_vertices(part).items():
        crown = teeth[name % 10 - 1].crown
        if name % 10 in _LANDMARK_TEETH:
            found[name] = int(vertices[4 * _around(crown) + crown.tip])
    return found


@dataclass(frozen=True, kw_only=True)
class _Stance:
    """The left half of an arch, T teeth from the midline outwards: a tooth's tip, the axes of its frame, its size."""

    teeth: tuple[Tooth, ...]
    scale: float  # of all sizes
    up: bool  # the upper arch, whose tips point down; its frames are right-handed
    tip: Float[np.ndarray, "T 3"]
    m: Float[np.ndarray, "T 3"]
    b: Float[np.ndarray, "T 3"]
    h: Float[np.ndarray, "T 3"]


def _stand(where: Arch, teeth: tuple[Tooth, ...], *, up: bool) -> _Stance:
    turn = np.linspace(0, np.pi / 2, 2001)
    line = np.stack([np.sin(turn), np.cos(turn)], 1) ** (2 / _ARCH_EXPONENT)
    stretch = np.hypot(1, where.slope)  # lengths in the inclined plane against those in plan view
    line = line * [where.half_width, stretch * (where.front - where.back)]  # (x, towards the front), in that plane
    if not up:
        along = np.gradient(line, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        along[0] = [1, 0]
        line = line + OVERJET * along[:, ::-1] * [1, -1]
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    scale = min(1.0, length / sum(tooth.width for tooth in teeth))
    contacts = [np.array([0, line[0, 1]])]
    for tooth in teeth:
        contacts.append(_step(line, contacts[-1], scale * tooth.width))
    forward = np.array([0, -where.slope, 1]) / stretch
    normal = np.array([0, 1, where.slope]) / stretch
    origin = np.array([0, where.height, where.front]) - stretch * (where.front - where.back) * forward
    points = origin + np.array([[x, 0, 0] + y * forward for x, y in contacts])
    m = np.diff(points, axis=0)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    out = np.cross(m, normal)
    along_h = -normal if up else normal
    tilt, lean = np.radians([[tooth.tilt, tooth.lean] for tooth in teeth]).T[..., None]
    reach = scale * np.array([tooth.reach for tooth in teeth])[:, None]
    tilted = np.cos(tilt) * along_h + np.sin(tilt) * out
    return _Stance(
        teeth=teeth,
        scale=scale,
        up=up,
        tip=(points[1:] + points[:-1]) / 2 + reach * along_h,
        m=np.cos(lean) * m + np.sin(lean) * tilted,
        b=np.cos(tilt) * out - np.sin(tilt) * along_h,
        h=np.cos(lean) * tilted - np.sin(lean) * m,
    )


def _step(line: Float[np.ndarray, "P 2"], start: Float[np.ndarray, "2"], width: float) -> Float[np.ndarray, "2"]:
    """The next point on a line that is `width` away from `start`; beyond the line's end, straight on."""
    beyond = line[-1] + 2 * width * (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    line = np.concatenate([line, beyond[None]])
    distance = np.linalg.norm(line - start, axis=1)
    nearest = int(distance.argmin())
    after = nearest + int(np.argmax(distance[nearest:] >= width))
    before = line[after - 1] - start
    along = line[after] - line[after - 1]
    # |before + t along| = width
    a, half, c = along @ along, before @ along, before @ before - width**2
    return line[after - 1] + along * (-half + np.sqrt(half**2 - a * c)) / a


def _edge(guide: Float[np.ndarray, "S 3"], sign: int) -> Float[np.ndarray, "2 2"]:
    """(z, y) of a guide's lowest (sign -1) or highest (1) point, in the front and in the back third of its depth."""
    share = (guide[:, 2] - guide[:, 2].min()) / np.ptp(guide[:, 2])
    thirds = [guide[share >= 2 / 3], guide[share <= 1 / 3]]
    return np.stack([points[np.argmax(sign * points[:, 1]), 2:0:-1] for points in thirds])


def _around(crown: Crown) -> int:
    return 2 * sum(crown.cells)


def _crown_size(crown: Crown) -> int:
    return 4 * _around(crown) + len(crown.top) + 1


def _grid(cells: tuple[int, int]) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "K 2"], Int[np.ndarray, "Q 4"]]:
    """A square of cells over [-1, 1]^2: its border counter-clockwise from (-1, -1), its inner points, and its quads,
    whose indices count the border first."""
    columns, rows = cells
    i, j = np.arange(columns), np.arange(rows)
    sides = [(i, 0 * i), (0 * j + columns, j), (columns - i, 0 * i + rows), (0 * j, rows - j)]
    border = np.concatenate([np.stack(side, 1) for side in sides])
    inner = np.stack(np.meshgrid(i[1:], j[1:]), -1).reshape(-1, 2)
    points = np.concatenate([border, inner])
    number = np.empty((columns + 1, rows + 1), int)
    number[points[:, 0], points[:, 1]] = np.arange(len(points))
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    return 2 * border / cells - 1, 2 * inner / cells - 1, quads


def _crown_vertices(tooth: Tooth) -> Float[np.ndarray, "V 3"]:
    """A tooth in its own frame (m, b, h), the tip at the origin: rings from root to rim, the biting surface's inner
    points, the root's end."""
    crown, half_width, half_depth = tooth.crown, (tooth.width - _GAP) / 2, tooth.depth / 2
    border, _, _ = _grid(crown.cells)
    mesial, distal = crown.falls
    rings = []
    for index, (height, width, buccal, lingual, exponent) in enumerate(crown.rings):
        section = border / (np.abs(border) ** exponent).sum(1, keepdims=True) ** (1 / exponent)
        m = width * section[:, 0] * (1 + crown.taper * np.minimum(section[:, 1], 0))
        b = (buccal + lingual) / 2 + (buccal - lingual) / 2 * section[:, 1]
        h = np.full(len(m), height if index == 0 else height * tooth.height)
        if index == len(crown.rings) - 1:
            h -= tooth.height * border[:, 0] ** 2 * np.where(border[:, 0] < 0, mesial, distal)
        rings.append(np.stack([m * half_width, b * half_depth, h], 1))
    top = np.array(crown.top) * [half_width, half_depth, tooth.height]
    end = [[0, 0, rings[0][0, 2] - 0.2 * half_width]]
    return np.concatenate([*rings, top, end]) - [0, 0, tooth.height]


def _crown_quads(crown: Crown) -> Int[np.ndarray, "Q 4"]:
    """Counter-clockwise seen from outside in a right-handed frame (m, b, h)."""
    around = _around(crown)
    k = np.arange(around)
    after = (k + 1) % around
    sides = [around * r + np.stack([k, after, around + after, around + k], 1) for r in range(3)]
    even, end = k[::2], np.full(around // 2, _crown_size(crown) - 1)
    root = np.stack([end, (even + 2) % around, even + 1, even], 1)
    return np.concatenate([*sides, 3 * around + _grid(crown.cells)[2], root])


def _crown_chart(crown: Crown) -> Float[np.ndarray, "Q 4 2"]:
    """The uvs of `_crown_quads` in [-0.5, 0.5]^2: a disc about the tip, the root's end in the corner beside it."""
    border, inner, _ = _grid(crown.cells)
    directions = border / np.linalg.norm(border, axis=1, keepdims=True)
    disc = np.concatenate([*(radius * directions for radius in (0.42, 0.37, 0.28, 0.18)), 0.18 * inner, [[0, 0]]])
    corner = 0.385 + 0.09 * np.concatenate([directions, [[0, 0]]]) * [-1, 1]
    quads = _crown_quads(crown)
    uvs = disc[quads]
    roots = quads[quads[:, 0] == len(disc) - 1]
    uvs[len(quads) - len(roots) :] = corner[np.where(roots == len(disc) - 1, len(border), roots)]
    return uvs


def _gum_vertices(stance: _Stance) -> Float[np.ndarray, "G 3"]:
    """The gum's cross-sections from the subject's right to left: at each tooth, between neighbours and at both ends."""
    teeth = stance.teeth
    sizes = stance.scale * np.array([[t.width / 2, t.height, t.depth / 2 * t.crown.rings[1][2]] for t in teeth])
    necks, depth = stance.tip - sizes[:, 1:2] * stance.h, sizes[:, 2]
    at_teeth = _gum_sections(_GUM_AT_TOOTH, necks, stance.b, stance.h, depth)
    # Between two teeth lies the mean of both; the first one's neighbour is its mirror image, the last one's itself.
    distal, mesial = necks + sizes[:, :1] * stance.m, necks - sizes[:, :1] * stance.m
    flip = [-1, 1, 1]
    middle, b, h = (
        np.concatenate([before[:1] * flip + before[:1], before[1:] + after[:-1], 2 * after[-1:]]) / 2
        for before, after in ((mesial, distal), (stance.b, stance.b), (stance.h, stance.h))
    )
    middle[-1] += 1.2e-3 * stance.m[-1]
    b, h = (axis / np.linalg.norm(axis, axis=1, keepdims=True) for axis in (b, h))
    depths = np.convolve([depth[0], *depth, 0.5 * depth[-1]], [0.5, 0.5], "valid")
    between = _gum_sections(_GUM_BETWEEN, middle, b, h, depths)
    left = np.concatenate([np.stack([between[:-1], at_teeth], 1).reshape(-1, _SECTION, 3), between[-1:]])
    return np.concatenate([left[:0:-1] * flip, left]).reshape(-1, 3)


def _gum_sections(
    rows: tuple[tuple[float, float, float], ...],
    middle: Float[np.ndarray, "N 3"],
    b: Float[np.ndarray, "N 3"],
    h: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N S 3"]:
    share, out, along = (np.array([*rows, *rows[-2:0:-1]]) * [1, 1e-3, 1e-3]).T
    side = np.where(np.arange(len(share)) < len(rows), 1, -1)
    outwards = side * (share * depth[:, None] + out)
    return middle[:, None] + outwards[..., None] * b[:, None] + along[:, None] * h[:, None]


def _gum_quads(stations: int) -> tuple[Int[np.ndarray, "Q 4"], Float[np.ndarray, "Q 4 2"]]:
    """The band's quads, right-handed as the crowns', and their uvs: a strip below v = 0.3, its two ends above that."""
    s, k = np.meshgrid(np.arange(stations - 1), np.arange(_SECTION), indexing="ij")
    after = (k + 1) % _SECTION
    number = _SECTION * s
    band = np.stack([number + k, number + _SECTION + k, number + _SECTION + after, number + after], -1).reshape(-1, 4)
    u = 0.02 + 0.96 * np.stack([s, s + 1, s + 1, s], -1) / (stations - 1)
    v = 0.02 + 0.28 * np.stack([k, k, k + 1, k + 1], -1) / _SECTION
    ladder = np.array([[0, 1, 2, 9], [9, 2, 3, 8], [8, 3, 4, 7], [7, 4, 5, 6]])
    turn = 2 * np.pi * np.arange(_SECTION) / _SECTION
    circle = 0.03 * np.stack([np.cos(turn), np.sin(turn)], 1)
    first, last = ladder, ladder[:, ::-1]
    uvs = [np.stack([u, v], -1).reshape(-1, 4, 2), [0.05, 0.35] + circle[first], [0.15, 0.35] + circle[last] * [-1, 1]]
    return np.concatenate([band, first, last + _SECTION * (stations - 1)]), np.concatenate(uvs)


def _part(stance: _Stance, name: str) -> Part:
    """Crowns from right to left, then the gum, with everything on the right the exact mirror image of the left."""
    vertices, quads, uvs, mirror = [], [], [], []
    count = len(stance.teeth)
    order = [*reversed(range(count)), *range(count)]
    sizes = [_crown_size(stance.teeth[i].crown) for i in order]
    starts = np.cumsum([0, *sizes])
    for place, i in enumerate(order):
        left = place >= count
        turn = 1 if left == stance.up else -1  # the frames of the others are left-handed
        crown = stance.teeth[i].crown
        local = stance.scale * _crown_vertices(stance.teeth[i])
        placed = stance.tip[i] + local @ np.stack([stance.m[i], stance.b[i], stance.h[i]])
        cell = [0.1 + 0.2 * (place % 5), 0.9 - 0.2 * (place // 5)]
        vertices.append(placed if left else placed * [-1, 1, 1])
        quads.append(starts[place] + _crown_quads(crown)[:, ::turn])
        uvs.append(cell + 0.2 * _crown_chart(crown)[:, ::turn] * [turn, 1])
        mirror.append(starts[2 * count - 1 - place] + np.arange(sizes[place]))
    gum = _gum_vertices(stance)
    stations = len(gum) // _SECTION
    gum_quads, gum_uvs = _gum_quads(stations)
    vertices.append(gum)
    quads.append(starts[-1] + gum_quads if stance.up else starts[-1] + gum_quads[:, ::-1])
    uvs.append(gum_uvs if stance.up else [0, 0.4] + gum_uvs[:, ::-1] * [1, -1])
    mirror.append(starts[-1] + np.arange(len(gum)).reshape(stations, _SECTION)[::-1].ravel())
    is_gum = np.arange(starts[-1] + len(gum)) >= starts[-1]
    return Part(
        vertices=np.concatenate(vertices),
        quads=np.concatenate(quads),
        quad_uvs=np.concatenate(uvs),
        groups={"teeth": ~is_gum, "gums": is_gum, name: np.ones(len(is_gum), bool)},
        mirror=np.concatenate(mirror),
    )
