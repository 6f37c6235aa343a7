"""The procedural teeth in an arch of real size, given as two coarse strips."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from coregister.first_model import dental_arch, teeth
from coregister.first_model.part import MeshPart
from registration.errors import InputError
from registration.geometry.closest_point import closest_points

ARCHES = ("upper", "lower")


def strip(sign: int) -> np.ndarray:
    """A horseshoe 62 mm wide and 54 mm deep: an outer wall of two heights, 10 mm high, and a row 9 mm inside it.

    The edge towards the other arch rises 23 cm per metre towards the back; `sign` is 1 above the occlusal plane.
    """
    angle = np.linspace(-np.pi / 2, np.pi / 2, 21)
    x, z = 0.031 * np.sin(angle), 0.071 + 0.054 * np.cos(angle)
    edge = 0.2345 + 0.23 * (0.125 - z) + sign * 0.0003
    outer = [np.stack([x, edge + sign * rise, z], 1) for rise in (0, 0.010, 0.019)]
    inner = np.stack([x * 22 / 31, edge + sign * 0.010, 0.071 + (z - 0.071) * 45 / 54], 1)
    return np.concatenate([*outer, inner])


def make(scale: float = 1.0) -> dict[str, MeshPart]:
    arch = dental_arch.fit_arch(scale * strip(1), scale * strip(-1))
    return {"upper": teeth.upper_teeth(arch), "lower": teeth.lower_teeth(arch)}


@pytest.fixture(scope="module")
def parts() -> dict[str, MeshPart]:
    return make()


def triangles(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def pieces(part: MeshPart) -> np.ndarray:
    """The connected piece of each vertex."""
    ends = np.stack([part.quads, np.roll(part.quads, -1, 1)], -1).reshape(-1, 2)
    adjacency = np.zeros((len(part.vertices),) * 2, bool)
    adjacency[ends[:, 0], ends[:, 1]] = True
    return connected_components(adjacency)[1]


def piece(part: MeshPart, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a single piece."""
    quads = part.quads[np.isin(part.quads, members).all(1)]
    return part.vertices[members], np.searchsorted(members, triangles(quads))


def surface_points(vertices: np.ndarray, faces: np.ndarray, steps: int = 5) -> np.ndarray:
    grid = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
    return np.einsum("sk,fkc->fsc", np.array(grid) / steps, vertices[faces]).reshape(-1, 3)


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Solid angle of a closed mesh over 4 pi: 1 inside, 0 outside (van Oosterom and Strackee 1983)."""
    a, b, c = (vertices[faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    ab, bc, ca = (np.einsum("pfi,pfi->pf", p, q) for p, q in ((a, b), (b, c), (c, a)))
    triple = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    return (2 * np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)).sum(1) / (4 * np.pi)


def depth(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> float:
    """How deep points of the first surface lie inside the second, metres."""
    points = surface_points(*first)
    points = points[((points >= second[0].min(0)) & (points <= second[0].max(0))).all(1)]
    if not len(points):
        return 0.0
    inside = points[winding_number(points, *second) > 0.5]
    return closest_points(inside, *second)[0].max() if len(inside) else 0.0


@pytest.mark.parametrize("name", ARCHES)
def test_every_connected_piece_is_closed_and_faces_outwards(parts, name):
    part = parts[name]
    quads = part.quads
    directed = np.stack([quads, np.roll(quads, -1, 1)], -1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(e) for e in directed} == {tuple(e[::-1]) for e in directed}
    assert (np.unique(quads) == np.arange(len(part.vertices))).all()
    assert len(part.vertices) <= 1150
    of = pieces(part)
    assert of.max() + 1 == 15
    for number in range(15):
        members = np.flatnonzero(of == number)
        vertices, faces = piece(part, members)
        assert len(members) - len(faces) / 2 == 2  # Euler's formula for quads: one sphere
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        assert np.linalg.norm(normals, axis=1).min() > 1e-8  # m^2
        halves = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        assert np.einsum("ij,ij->i", *np.split(halves, 2)).min() > 0  # no quad is folded
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        assert 0.5e-7 < volume < (2e-5 if part.groups["gums"][members].all() else 2e-6)  # m^3


@pytest.mark.parametrize("name", ARCHES)
def test_the_mirror_is_exact(parts, name):
    part = parts[name]
    mirror = part.mirror
    assert (mirror[mirror] == np.arange(len(mirror))).all()
    assert np.abs(part.vertices[mirror] - part.vertices * [-1, 1, 1]).max() < 1e-12
    edges = {tuple(e) for q in part.quads for e in zip(q, np.roll(q, -1), strict=True)}
    mirrored = mirror[part.quads][:, ::-1]
    assert {frozenset(q) for q in mirrored.tolist()} == {frozenset(q) for q in part.quads.tolist()}
    assert all(tuple(e) in edges for q in mirrored for e in zip(q, np.roll(q, -1), strict=True))
    assert all((member[mirror] == member).all() for member in part.groups.values())


@pytest.mark.parametrize("name", ARCHES)
def test_groups_and_numbers(parts, name):
    part = parts[name]
    assert set(part.groups) == {"teeth", "gums", f"{name}_teeth_and_gums"}
    assert (part.groups["teeth"] ^ part.groups["gums"]).all()
    assert part.groups[f"{name}_teeth_and_gums"].all()
    numbered = teeth.tooth_vertices(part)
    assert list(numbered) == list(dental_arch.FDI_UPPER if name == "upper" else dental_arch.FDI_LOWER)
    assert (np.sort(np.concatenate(list(numbered.values()))) == np.flatnonzero(part.groups["teeth"])).all()
    piece_of_vertex = pieces(part)
    assert all(len(np.unique(piece_of_vertex[members])) == 1 for members in numbered.values())
    centres = [part.vertices[members, 0].mean() for members in numbered.values()]
    assert (np.diff(centres[2:12]) > 0).all()  # from right to left; beyond, the arch bends backwards
    for right, left in zip(list(numbered), list(numbered)[::-1], strict=True):
        assert set(part.mirror[numbered[right]]) == set(numbered[left])


@pytest.mark.parametrize("name", ARCHES)
def test_landmarks(parts, name):
    part = parts[name]
    tips = teeth.landmark_vertices(part)
    quadrants = (1, 2) if name == "upper" else (4, 3)
    assert list(tips) == [10 * quadrants[0] + k for k in (6, 3, 1)] + [10 * quadrants[1] + k for k in (1, 3, 6)]
    assert [part.mirror[tip] for tip in tips.values()] == list(tips.values())[::-1]
    up = np.array([0, 1, 0.23]) / np.hypot(1, 0.23)
    for number, tip in tips.items():
        members = teeth.tooth_vertices(part)[number]
        assert tip in members
        towards = part.vertices[members] @ up * (-1 if name == "upper" else 1)
        assert part.vertices[tip] @ up * (-1 if name == "upper" else 1) > towards.max() - 0.6e-3


@pytest.mark.parametrize("name", ARCHES)
def test_uv_charts_do_not_overlap(parts, name):
    part = parts[name]
    uvs = part.quad_uvs
    assert uvs.min() >= 0 and uvs.max() <= 1
    size = 1024
    counts = np.zeros((size, size), int)
    for a, b, c in triangles_of(uvs) * size:
        assert cross(b - a, c - a) > 1  # counter-clockwise, no smaller than half a pixel
        low, high = np.floor(np.min([a, b, c], 0)).astype(int), np.ceil(np.max([a, b, c], 0)).astype(int)
        points = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1) + 0.5
        inside = np.all([cross(q - p, points - p) > 1e-6 for p, q in ((a, b), (b, c), (c, a))], 0)
        counts[low[1] : high[1], low[0] : high[0]] += inside
    assert counts.max() == 1
    assert counts.mean() > 0.4


def triangles_of(corners: np.ndarray) -> np.ndarray:
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@pytest.mark.parametrize("scale", [1.0, 0.8])
@pytest.mark.parametrize("name", ARCHES)
def test_neighbouring_teeth_touch_with_little_overlap(name, scale):
    part = make(scale)[name]
    alone = [piece(part, members) for members in teeth.tooth_vertices(part).values()]
    for first, second in zip(alone[6:], alone[7:], strict=False):  # the left side, and both central incisors
        assert max(depth(first, second), depth(second, first)) < 0.2e-3
        assert closest_points(surface_points(*first), *second)[0].min() < 0.35e-3


@pytest.mark.parametrize("name", ARCHES)
def test_sizes_are_those_of_real_teeth(parts, name):
    part = parts[name]
    rows = dental_arch.UPPER if name == "upper" else dental_arch.LOWER
    for number, members in teeth.tooth_vertices(part).items():
        vertices = part.vertices[members]
        row = rows[number % 10 - 1]
        spans = np.ptp(vertices @ principal(vertices), axis=0)
        reached = np.sort([row.width, row.height + 3.8e-3, row.depth])  # the crown and the root's stump
        assert np.sort(spans) == pytest.approx(reached, rel=0.25)
    upper_incisor = part.vertices[teeth.tooth_vertices(part)[11 if name == "upper" else 41]]
    assert np.ptp(upper_incisor[:, 0]) == pytest.approx(rows[0].width, rel=0.08)


def principal(vertices: np.ndarray) -> np.ndarray:
    return np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2].T


def test_a_small_arch_scales_all_teeth_uniformly():
    small, large = make(0.8), make()
    for name in ARCHES:
        numbered = teeth.tooth_vertices(small[name])
        ratios = [
            np.linalg.norm(np.ptp(small[name].vertices[members], axis=0))
            / np.linalg.norm(np.ptp(large[name].vertices[members], axis=0))
            for members in numbered.values()
        ]
        assert 0.6 < np.mean(ratios) < 0.9
        assert np.std(ratios) < 0.05


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_upper_and_lower_teeth_meet_without_touching(scale):
    arches = make(scale)
    alone = {
        name: [piece(arches[name], members) for members in list(teeth.tooth_vertices(arches[name]).values())[7:]]
        for name in ARCHES
    }
    distances = np.full(7, np.inf)
    for i, first in enumerate(alone["upper"]):
        for second in alone["lower"]:
            assert depth(first, second) == 0
            assert depth(second, first) == 0
            if np.linalg.norm(first[0].mean(0) - second[0].mean(0)) < 0.02:
                distances[i] = min(distances[i], closest_points(first[0], *second)[0].min())
    assert distances.max() < 1.5e-3
    assert distances.min() < 0.3e-3


def test_overbite_and_overjet(parts):
    above = parts["upper"].vertices[teeth.landmark_vertices(parts["upper"])[21]]
    below = parts["lower"].vertices[teeth.landmark_vertices(parts["lower"])[31]]
    assert 1e-3 < below[1] - above[1] < 2e-3
    assert 1e-3 < above[2] - below[2] < 2.5e-3


def test_teeth_stand_within_the_guide(parts):
    for name, sign in (("upper", 1), ("lower", -1)):
        guide, part = strip(sign), parts[name]
        assert (np.abs(part.vertices[:, 0]) < guide[:, 0].max()).all()
        assert (part.vertices[:, 2] < guide[:, 2].max()).all()
        assert (part.vertices[:, 2] > guide[:, 2].min()).all()
        outline = (part.vertices[:, 0] / 0.032) ** 2 + ((part.vertices[:, 2] - 0.071) / 0.055) ** 2
        assert outline.max() < 1  # at most 1 mm outside the guide anywhere
        beyond = sign * (part.vertices[:, 1] - 0.2345 - 0.23 * (0.125 - part.vertices[:, 2]))
        assert -2.5e-3 < beyond.min() and beyond.max() < 0.024


def test_gums_enclose_the_roots_but_not_the_crowns(parts):
    for part in parts.values():
        gum = piece(part, np.flatnonzero(part.groups["gums"]))
        for members in teeth.tooth_vertices(part).values():
            around = 16 if len(members) == 74 else 12
            inside = winding_number(part.vertices[members], *gum) > 0.5
            assert inside[:around].all() and inside[-1]  # the root's ring and its end
            assert not inside[3 * around : -1].any()  # edge and biting surface
    assert abs(parts["upper"].vertices[parts["upper"].groups["gums"], 0].sum()) < 1e-9


def test_single_teeth_can_be_changed():
    arch = dental_arch.fit_arch(strip(1), strip(-1))
    longer = (replace(dental_arch.UPPER[0], height=12e-3), *dental_arch.UPPER[1:])
    before, after = teeth.upper_teeth(arch), teeth.upper_teeth(arch, longer)
    displaced = np.abs(before.vertices - after.vertices).max(1) > 1e-12
    numbered = teeth.tooth_vertices(before)
    assert displaced[numbered[11]].any() and displaced[numbered[21]].any()
    assert not any(displaced[members].any() for number, members in numbered.items() if number not in (11, 21))
    assert (before.quads == after.quads).all()


@pytest.mark.parametrize(
    "upper, lower",
    [
        (strip(1)[:2], strip(-1)),
        (strip(1), np.full((5, 3), np.nan)),
        (strip(1) / 10, strip(-1) / 10),
        (strip(1)[:, [2, 1, 0]] * 0.2, strip(-1)),
        (strip(1), strip(-1) * [1, 1, 0]),
    ],
)
def test_guides_without_an_arch_are_refused(upper, lower):
    with pytest.raises(InputError):
        dental_arch.fit_arch(upper, lower)
