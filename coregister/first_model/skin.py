"""The skin of the first model: MakeHuman's head and neck, cut on an edge loop, subdivided, unfolded, named."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from coregister.first_model.makehuman import MakeHuman
from coregister.first_model.part import Part
from registration.geometry.parameterization import flat_map
from registration.geometry.quads import Subdivision, beyond_loop, boundary_loops, edge_loop, edges_of, pieces, subdivide

# Vertices of MakeHuman's base mesh: an edge of the loop around the neck's foot, and one vertex of the scalp.
_NECK_LOOP = (1491, 8177)
_SCALP = 962
_TIE = 1e-9

# Points of the face as seen from the front, x and y in mm on MakeHuman's base mesh, subject's left; mirrored for the
# right. A region is the set of vertices nearest, along the surface, to one of its points.
_REGIONS: Mapping[str, tuple[tuple[float, float], ...]] = {
    "forehead": ((0, 345), (20, 345), (40, 342), (0, 362), (30, 362), (56, 336)),
    "brow": ((14, 319), (22, 323), (32, 324.5), (42, 322), (50, 316)),
    "middle_brow": ((0, 318), (0, 311)),
    "temple": ((66, 310), (62, 325), (68, 295)),
    "orbital": ((17, 302), (24, 312), (33, 313), (44, 309), (48, 302), (40, 293), (30, 291), (20, 295)),
    "zygomatic": ((58, 285), (50, 278), (60, 295)),
    "nose": ((0, 300), (0, 285), (0, 268), (8, 270), (14, 264), (8, 285), (0, 258), (13, 258)),
    "parotid": ((64, 262), (58, 245), (66, 250)),
    "infraorbital": ((28, 275), (20, 280), (38, 278)),
    "cheek": ((40, 252), (34, 240), (46, 238), (44, 225)),
    "upper_lip": ((0, 247), (12, 248), (22, 243), (0, 240), (10, 240)),
    "lower_lip": ((0, 230), (10, 229), (20, 229), (24, 225), (0, 222), (14, 220)),
    "chin": ((0, 205), (12, 205), (24, 208), (0, 195)),
}
_SINGLE = ("forehead", "middle_brow", "nose", "upper_lip", "lower_lip", "chin")  # one region for both sides


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """The skin as a part of the model, and how its vertices follow those of MakeHuman's base mesh."""

    part: Part  # V vertices
    base: Int[np.ndarray, "N"]  # the base mesh' vertices that it is made of
    subdivision: Subdivision  # their V fine vertices; the first N are the coarse ones, moved
    edges: Int[np.ndarray, "E 2"]

    def follow(self, values: Float[np.ndarray, "B D"]) -> Float[np.ndarray, "V D"]:
        """Positions or displacements of the base mesh, carried over to the skin."""
        return np.asarray(self.subdivision.weights @ values[self.base])


def make(source: MakeHuman) -> Skin:
    """Cut, subdivide, unfold and name the regions of the skin."""
    body = source.quads["body"]
    kept = beyond_loop(body, edge_loop(body, *_NECK_LOOP), _SCALP)
    base, coarse = np.unique(body[kept], return_inverse=True)
    coarse = coarse.reshape(-1, 4)
    mirror = np.searchsorted(base, source.mirror[base])
    island = _islands(source.vertices[base], coarse, source.uv_quads["body"][kept])
    fine = subdivide(coarse, mirror)
    vertices = _symmetric(np.asarray(fine.weights @ source.vertices[base]), fine.mirror)
    edges, _, _ = edges_of(fine.quads)
    part = Part(
        vertices=vertices,
        quads=fine.quads,
        quad_uvs=fine_corners(_unfold(source.vertices[base], coarse, mirror, island)),
        groups=_groups(source, base, fine, vertices, np.repeat(island, 4), edges),
        mirror=fine.mirror,
    )
    return Skin(part=part, base=base, subdivision=fine, edges=edges)


def _symmetric(vertices: Float[np.ndarray, "V 3"], mirror: Int[np.ndarray, "V"]) -> Float[np.ndarray, "V 3"]:
    """Exact mirror images; sums in another order differ in the last bit."""
    return (vertices + vertices[mirror] * (-1, 1, 1)) / 2


def _islands(points: Float[np.ndarray, "N 3"], quads: np.ndarray, uv_quads: np.ndarray) -> Int[np.ndarray, "Q"]:
    """0: what is seen from outside; 1: the mouth's lining; 2, 3: the eyes' sockets: MakeHuman's own uv islands."""
    edges, of_quad, _ = edges_of(uv_quads)
    label, number = pieces(of_quad, np.ones(len(edges), bool))
    if number != 5:
        raise ValueError(f"expected face, neck, mouth and two sockets, found {number} uv islands")
    middle = np.array([points[quads[label == n]].mean((0, 1)) for n in range(number)])
    kind = np.zeros(number, int)
    left, right = middle[:, 0].argmax(), middle[:, 0].argmin()
    kind[[left, right]] = 2, 3
    rest = [n for n in range(number) if n not in (left, right, np.bincount(label).argmax())]  # neck and mouth
    kind[max(rest, key=lambda n: middle[n, 1])] = 1
    return kind[label]


def _unfold(
    points: Float[np.ndarray, "N 3"], quads: Int[np.ndarray, "Q 4"], mirror: Int[np.ndarray, "N"], island: np.ndarray
) -> Float[np.ndarray, "Q 4 2"]:
    """One map for the skin: the outside, slit along the nape, above; mouth and sockets in a strip below."""
    uvs = np.empty((len(quads), 4, 2))
    outside = quads[island == 0]
    slit = _nape(points, outside, mirror)
    cut, copies = _cut(points, outside, slit)
    loop = max(boundary_loops(cut), key=lambda loop: len(loop) * np.isin(slit[-1], loop))
    loop = np.roll(loop, -int(np.flatnonzero(loop == slit[-1])[0]))  # from the crown
    places = points[copies]
    uvs[island == 0] = _squircle_map(places, cut, loop)[cut] * (1, 0.84) + (0, 0.16)
    for label, (u, width) in {1: (0.01, 0.30), 2: (0.40, 0.15), 3: (0.70, 0.15)}.items():
        own, corner = np.unique(quads[island == label], return_inverse=True)
        own_quads = corner.reshape(-1, 4)
        rim = boundary_loops(own_quads)[0]
        share = _along(points[own][rim])
        circle = 0.5 + 0.5 * np.stack([np.cos(2 * np.pi * share), np.sin(2 * np.pi * share)], 1)
        uvs[island == label] = flat_map(points[own], own_quads, rim, circle)[own_quads] * (width, 0.15) + (u, 0.002)
    return uvs


def _nape(points: np.ndarray, quads: np.ndarray, mirror: np.ndarray) -> Int[np.ndarray, "S"]:
    """The midline's vertices from the neck's rim at the back up to the crown."""
    edges, _, count = edges_of(quads)
    middle = mirror == np.arange(len(points))
    onward: dict[int, list[int]] = {}
    for a, b in edges[middle[edges].all(1)].tolist():
        onward.setdefault(a, []).append(b)
        onward.setdefault(b, []).append(a)
    rim = [v for v in np.unique(edges[count == 1]).tolist() if middle[v] and points[v, 1] < points[:, 1].mean()]
    path = [min(rim, key=lambda v: points[v, 2])]
    while True:
        ahead = [v for v in onward[path[-1]] if v not in path and points[v, 1] > points[path[-1], 1]]
        if not ahead:
            return np.array(path)
        path.append(ahead[0])


def _cut(points: np.ndarray, quads: np.ndarray, slit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quads opened along a path (its last vertex stays whole), and which point each of their vertices is."""
    copy = np.arange(len(points))
    copy[slit[:-1]] = len(points) + np.arange(len(slit) - 1)
    right = points[quads][:, :, 0].mean(1) < 0
    return np.where(right[:, None], copy[quads], quads), np.concatenate([np.arange(len(points)), slit[:-1]])


def _squircle_map(points: np.ndarray, quads: np.ndarray, loop: np.ndarray) -> Float[np.ndarray, "V 2"]:
    """The outside on a square with round corners (strictly convex, so no face collapses); the loop starts on top."""
    angle = np.pi / 2 + 2 * np.pi * _along(points[loop])
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    outline = 0.5 + 0.5 * np.sign(direction) * np.sqrt(np.abs(direction))
    return flat_map(points, quads, loop, outline)


def _along(loop: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Share of a closed curve's length before each of its points."""
    length = np.linalg.norm(np.roll(loop, -1, 0) - loop, axis=1)
    return np.concatenate([[0], np.cumsum(length)[:-1]]) / length.sum()


def fine_corners(corners: Float[np.ndarray, "Q 4 D"]) -> Float[np.ndarray, "4*Q 4 D"]:
    """Values per corner for the quads of `subdivide`."""
    middle = (corners + np.roll(corners, -1, 1)) / 2
    centre = np.broadcast_to(corners.mean(1, keepdims=True), corners.shape)
    return np.stack([corners, middle, centre, np.roll(middle, 1, 1)], 2).reshape(-1, 4, corners.shape[-1])


def _groups(
    source: MakeHuman,
    base: np.ndarray,
    fine: Subdivision,
    vertices: Float[np.ndarray, "V 3"],
    island: Int[np.ndarray, "F"],
    edges: Int[np.ndarray, "E 2"],
) -> dict[str, Bool[np.ndarray, "V"]]:
    count = len(vertices)

    def touched(label: tuple[int, ...]) -> Bool[np.ndarray, "V"]:
        found = np.zeros(count, bool)
        found[fine.quads[np.isin(island, label)]] = True
        return found

    def painted(name: str) -> Bool[np.ndarray, "V"]:
        return np.asarray(fine.linear @ source.masked(name)[base].astype(float)) > 0.5

    exterior = touched((0,))
    lips = painted("lips") & exterior
    # Where the lips meet is where the mouth's lining begins: at that rim's outermost points.
    rim = exterior & touched((1,))
    corner = vertices[rim][np.argmax(vertices[rim, 0])]
    upper = _above_mouth(vertices, fine.quads[island == 0], lips, corner[1])
    face = painted("face") & exterior
    groups = {
        "skin": np.ones(count, bool),
        "skin_exterior": exterior,
        "hockey_mask": face,
        "upper_lip": lips & upper,
        "lower_lip": lips & ~upper,
        "mouth_sock": touched((1,)) & ~exterior,
        "eye_sockets": touched((2, 3)) & ~exterior,
        "ears": painted("ears") & exterior,
    }
    return groups | _face_regions(vertices, fine.mirror, face, edges)


def _above_mouth(
    vertices: np.ndarray, quads: np.ndarray, lips: Bool[np.ndarray, "V"], height: float
) -> Bool[np.ndarray, "V"]:
    """Which side of the mouth's slit: by distance along the surface to the lips' red seen from the front."""
    edges, _, _ = edges_of(quads)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.csr_matrix((length, (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    middle = np.abs(vertices[:, 0]) < 0.012
    above = np.flatnonzero(lips & middle & (vertices[:, 1] > height + 0.003))
    below = np.flatnonzero(lips & middle & (vertices[:, 1] < height - 0.005))
    reach = [dijkstra(graph, directed=False, indices=seeds, min_only=True) for seeds in (above, below)]
    return reach[0] < reach[1]


def front_points(
    vertices: Float[np.ndarray, "V 3"], eligible: Bool[np.ndarray, "V"], points_mm: Float[np.ndarray, "P 2"]
) -> Int[np.ndarray, "P"]:
    """The eligible vertex nearest to each point as seen from the front, of those within 4 mm the foremost layer."""
    rows = np.flatnonzero(eligible)
    tree = cKDTree(vertices[rows, :2])
    found = []
    for x, y in np.asarray(points_mm) / 1000:
        near = rows[tree.query_ball_point((x, y), 4e-3)]
        if not len(near):
            near = rows[[tree.query((x, y))[1]]]
        near = near[vertices[near, 2] > vertices[near, 2].max() - 8e-3]
        distance = np.hypot(vertices[near, 0] - x, vertices[near, 1] - y)
        found.append(near[np.argmin(distance)])
    return np.array(found)


def _face_regions(
    vertices: np.ndarray, mirror: np.ndarray, face: Bool[np.ndarray, "V"], edges: np.ndarray
) -> dict[str, Bool[np.ndarray, "V"]]:
    """The official file's regions of the face: nearest points along the surface, mirror images of each other."""
    inner = edges[face[edges].all(1)]
    length = np.linalg.norm(vertices[inner[:, 0]] - vertices[inner[:, 1]], axis=1)
    graph = sp.csr_matrix((length, (inner[:, 0], inner[:, 1])), (len(vertices),) * 2)
    names, reach = [], []
    for name, points in _REGIONS.items():
        left = front_points(vertices, face & (vertices[:, 0] > -1e-4), np.array(points, float))
        far = dijkstra(graph, directed=False, indices=left, min_only=True)
        if name in _SINGLE:
            names.append(f"{name}_region")
            reach.append(np.minimum(far, far[mirror]))
        else:
            names += [f"left_{name}_region", f"right_{name}_region"]
            reach += [far, far[mirror]]
    nearest = np.stack(reach)
    # A vertex as near to two regions is in both: otherwise a midline vertex would be on one side only.
    member = face & (nearest <= nearest.min(0) + _TIE) & np.isfinite(nearest)
    return dict(zip(names, member, strict=True))
