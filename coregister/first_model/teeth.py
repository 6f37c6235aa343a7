"""Meshes of the teeth and gums: fourteen closed crowns and one band of gum per arch, all quads, metres.

Sizes, FDI numbers and the frames of the teeth are those of `dental_arch`. Source: [GNM, Teeth modeling].
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from coregister.first_model.dental_arch import (
    FDI_LOWER,
    FDI_UPPER,
    LOWER,
    UPPER,
    Arch,
    ArchPlacement,
    Crown,
    Tooth,
    place_teeth,
)
from coregister.first_model.part import MeshPart

_GAP = 0.06e-3  # between neighbours
_LANDMARK_TEETH = (6, 3, 1)  # first molar, canine, central incisor
_SECTION = 10  # vertices of a cross-section of the gum
# The gum's cross-section from its crest over the outer side to its base; the inner side mirrors it. Each row: distance
# from the neck's centre as a fraction of the neck's half depth, plus mm; mm along h. At a tooth, and between teeth.
_GUM_AT_TOOTH = ((0, 0, -0.5), (0.9, 0, 0.7), (1, 0.5, -0.2), (1, 0.4, -3.2), (0.9, -1.4, -6), (0, 0, -7))
_GUM_BETWEEN = ((0, 0, 2.8), (0.55, 0, 2.4), (0.9, 0, 0.9), (1, 0.1, -2.8), (0.9, -1.5, -6), (0, 0, -7))


def upper_teeth(arch: Arch, teeth: tuple[Tooth, ...] = UPPER) -> MeshPart:
    """Build the upper teeth and gums.

    In the uv map each tooth is unfolded from its tip into a chart, with the root's end in a corner; the gum is a strip.

    Args:
        arch: where the teeth stand.
        teeth: from the midline outwards; teeth too wide for the arch are all scaled by the same factor.

    Returns:
        1106 vertices, the teeth in the order of `FDI_UPPER`, then the gums. Groups: `teeth`, `gums`,
        `upper_teeth_and_gums`.
    """
    return _build_part(place_teeth(arch, teeth, upper=True), "upper_teeth_and_gums")


def lower_teeth(arch: Arch, teeth: tuple[Tooth, ...] = LOWER) -> MeshPart:
    """Build the lower teeth and gums, inside the upper arch by `OVERJET`; see `upper_teeth`.

    Args:
        arch: the arch of the upper teeth.
        teeth: from the midline outwards.

    Returns:
        The part, with its teeth in the order of `FDI_LOWER`.
    """
    return _build_part(place_teeth(arch, teeth, upper=False), "lower_teeth_and_gums")


def tooth_vertices(part: MeshPart) -> Mapping[int, Int[np.ndarray, "N"]]:
    """Return the vertices of each tooth by FDI number, from the subject's right to left.

    Args:
        part: upper or lower teeth, built with the default teeth.
    """
    names, teeth = (FDI_UPPER, UPPER) if "upper_teeth_and_gums" in part.groups else (FDI_LOWER, LOWER)
    sizes = [_crown_size(tooth.crown) for tooth in (*teeth[::-1], *teeth)]
    ends = np.cumsum(sizes)
    return {name: np.arange(end - size, end) for name, size, end in zip(names, sizes, ends, strict=True)}


def landmark_vertices(part: MeshPart) -> Mapping[int, int]:
    """Return the landmark vertices of six teeth by FDI number, from the subject's right to left.

    First molar (mesiobuccal cusp), canine (tip), central incisor (middle of the edge), and the same on the left.

    Args:
        part: upper or lower teeth, built with the default teeth.
    """
    teeth = UPPER if "upper_teeth_and_gums" in part.groups else LOWER
    landmarks = {}
    for name, vertices in tooth_vertices(part).items():
        crown = teeth[name % 10 - 1].crown
        if name % 10 in _LANDMARK_TEETH:
            landmarks[name] = int(vertices[4 * _ring_size(crown) + crown.tip])
    return landmarks


def _ring_size(crown: Crown) -> int:
    return 2 * sum(crown.cells)


def _crown_size(crown: Crown) -> int:
    return 4 * _ring_size(crown) + len(crown.top) + 1


def _grid(cells: tuple[int, int]) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "K 2"], Int[np.ndarray, "Q 4"]]:
    """Return a grid of cells over [-1, 1]^2: border points counter-clockwise from (-1, -1), inner points, quads.

    The quads index the border points first, then the inner ones.
    """
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
    """Return a tooth's vertices in its frame (m, b, h), the tip at the origin.

    Order: rings from root to rim, inner points of the biting surface, end of the root.
    """
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
    """Return a crown's quads, counter-clockwise seen from outside in a right-handed frame (m, b, h)."""
    ring = _ring_size(crown)
    k = np.arange(ring)
    after = (k + 1) % ring
    sides = [ring * r + np.stack([k, after, ring + after, ring + k], 1) for r in range(3)]
    even, end = k[::2], np.full(ring // 2, _crown_size(crown) - 1)
    root = np.stack([end, (even + 2) % ring, even + 1, even], 1)
    return np.concatenate([*sides, 3 * ring + _grid(crown.cells)[2], root])


def _crown_chart(crown: Crown) -> Float[np.ndarray, "Q 4 2"]:
    """Return uvs of `_crown_quads` in [-0.5, 0.5]^2: a disc about the tip, and the end of the root in a corner."""
    border, inner, _ = _grid(crown.cells)
    directions = border / np.linalg.norm(border, axis=1, keepdims=True)
    disc = np.concatenate([*(radius * directions for radius in (0.42, 0.37, 0.28, 0.18)), 0.18 * inner, [[0, 0]]])
    corner = 0.385 + 0.09 * np.concatenate([directions, [[0, 0]]]) * [-1, 1]
    quads = _crown_quads(crown)
    uvs = disc[quads]
    roots = quads[quads[:, 0] == len(disc) - 1]
    uvs[len(quads) - len(roots) :] = corner[np.where(roots == len(disc) - 1, len(border), roots)]
    return uvs


def _gum_vertices(placement: ArchPlacement) -> Float[np.ndarray, "G 3"]:
    """Return cross-sections of the gum from the subject's right to left: at each tooth, between teeth, at both ends."""
    teeth = placement.teeth
    sizes = placement.scale * np.array([[t.width / 2, t.height, t.depth / 2 * t.crown.rings[1][2]] for t in teeth])
    necks, depth = placement.tip - sizes[:, 1:2] * placement.h, sizes[:, 2]
    at_teeth = _gum_sections(_GUM_AT_TOOTH, necks, placement.b, placement.h, depth)
    # Between two teeth: their mean. The neighbour of the first tooth is its mirror image, that of the last one itself.
    distal, mesial = necks + sizes[:, :1] * placement.m, necks - sizes[:, :1] * placement.m
    flip = [-1, 1, 1]
    centres, b, h = (
        np.concatenate([before[:1] * flip + before[:1], before[1:] + after[:-1], 2 * after[-1:]]) / 2
        for before, after in ((mesial, distal), (placement.b, placement.b), (placement.h, placement.h))
    )
    centres[-1] += 1.2e-3 * placement.m[-1]
    b, h = (axis / np.linalg.norm(axis, axis=1, keepdims=True) for axis in (b, h))
    depths = np.convolve([depth[0], *depth, 0.5 * depth[-1]], [0.5, 0.5], "valid")
    between = _gum_sections(_GUM_BETWEEN, centres, b, h, depths)
    left = np.concatenate([np.stack([between[:-1], at_teeth], 1).reshape(-1, _SECTION, 3), between[-1:]])
    return np.concatenate([left[:0:-1] * flip, left]).reshape(-1, 3)


def _gum_sections(
    profile: tuple[tuple[float, float, float], ...],
    centres: Float[np.ndarray, "N 3"],
    b: Float[np.ndarray, "N 3"],
    h: Float[np.ndarray, "N 3"],
    depth: Float[np.ndarray, "N"],
) -> Float[np.ndarray, "N S 3"]:
    """Return the cross-sections of a profile (see `_GUM_AT_TOOTH`) at frames along the arch."""
    fraction, offset, along = (np.array([*profile, *profile[-2:0:-1]]) * [1, 1e-3, 1e-3]).T
    side = np.where(np.arange(len(fraction)) < len(profile), 1, -1)
    outwards = side * (fraction * depth[:, None] + offset)
    return centres[:, None] + outwards[..., None] * b[:, None] + along[:, None] * h[:, None]


def _gum_quads(stations: int) -> tuple[Int[np.ndarray, "Q 4"], Float[np.ndarray, "Q 4 2"]]:
    """Return the band's quads, oriented as the crowns', and their uvs: a strip below v = 0.3, its two ends above it."""
    s, k = np.meshgrid(np.arange(stations - 1), np.arange(_SECTION), indexing="ij")
    after = (k + 1) % _SECTION
    number = _SECTION * s
    band = np.stack([number + k, number + _SECTION + k, number + _SECTION + after, number + after], -1).reshape(-1, 4)
    u = 0.02 + 0.96 * np.stack([s, s + 1, s + 1, s], -1) / (stations - 1)
    v = 0.02 + 0.28 * np.stack([k, k, k + 1, k + 1], -1) / _SECTION
    ladder = np.array([[0, 1, 2, 9], [9, 2, 3, 8], [8, 3, 4, 7], [7, 4, 5, 6]])
    angle = 2 * np.pi * np.arange(_SECTION) / _SECTION
    circle = 0.03 * np.stack([np.cos(angle), np.sin(angle)], 1)
    first, last = ladder, ladder[:, ::-1]
    uvs = [np.stack([u, v], -1).reshape(-1, 4, 2), [0.05, 0.35] + circle[first], [0.15, 0.35] + circle[last] * [-1, 1]]
    return np.concatenate([band, first, last + _SECTION * (stations - 1)]), np.concatenate(uvs)


def _build_part(placement: ArchPlacement, name: str) -> MeshPart:
    """Build crowns from right to left, then the gum; the right side is the exact mirror image of the left."""
    vertices, quads, uvs, mirror = [], [], [], []
    count = len(placement.teeth)
    order = [*reversed(range(count)), *range(count)]
    sizes = [_crown_size(placement.teeth[i].crown) for i in order]
    starts = np.cumsum([0, *sizes])
    for index, i in enumerate(order):
        left = index >= count
        step = 1 if left == placement.upper else -1  # the other frames are left-handed: their quads are reversed
        crown = placement.teeth[i].crown
        local = placement.scale * _crown_vertices(placement.teeth[i])
        points = placement.tip[i] + local @ np.stack([placement.m[i], placement.b[i], placement.h[i]])
        cell = [0.1 + 0.2 * (index % 5), 0.9 - 0.2 * (index // 5)]
        vertices.append(points if left else points * [-1, 1, 1])
        quads.append(starts[index] + _crown_quads(crown)[:, ::step])
        uvs.append(cell + 0.2 * _crown_chart(crown)[:, ::step] * [step, 1])
        mirror.append(starts[2 * count - 1 - index] + np.arange(sizes[index]))
    gum = _gum_vertices(placement)
    stations = len(gum) // _SECTION
    gum_quads, gum_uvs = _gum_quads(stations)
    vertices.append(gum)
    quads.append(starts[-1] + gum_quads if placement.upper else starts[-1] + gum_quads[:, ::-1])
    uvs.append(gum_uvs if placement.upper else [0, 0.4] + gum_uvs[:, ::-1] * [1, -1])
    mirror.append(starts[-1] + np.arange(len(gum)).reshape(stations, _SECTION)[::-1].ravel())
    is_gum = np.arange(starts[-1] + len(gum)) >= starts[-1]
    return MeshPart(
        vertices=np.concatenate(vertices),
        quads=np.concatenate(quads),
        quad_uvs=np.concatenate(uvs),
        groups={"teeth": ~is_gum, "gums": is_gum, name: np.ones(len(is_gum), bool)},
        mirror=np.concatenate(mirror),
    )
