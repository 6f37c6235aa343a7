"""The skin of the first model: MakeHuman's head and neck, cut along an edge loop, subdivided, with a uv map and vertex
groups."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from coregister.first_model.makehuman import MakeHuman
from coregister.first_model.part import MeshPart
from registration.geometry.geodesic import edge_distances
from registration.geometry.parameterization import flat_map
from registration.geometry.quads import Subdivision, beyond_loop, boundary_loops, edge_loop, edges_of, pieces, subdivide

# Vertices of MakeHuman's base mesh: an edge of the loop around the base of the neck, and a vertex of the scalp.
_NECK_LOOP = (1491, 8177)
_SCALP = 962
_TIE_M = 1e-9

# Seed points of the face's regions in a front view of MakeHuman's base mesh: x and y in mm, subject's left; mirrored
# for the right. A region is the set of vertices that are nearest, along the surface, to one of its seeds.
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
_UNPAIRED = ("forehead", "middle_brow", "nose", "upper_lip", "lower_lip", "chin")  # one region for both sides


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """The skin as a part of the model, and the map from MakeHuman's base mesh to its vertices."""

    part: MeshPart  # V vertices
    base: Int[np.ndarray, "N"]  # the base mesh's vertices that it uses
    subdivision: Subdivision  # from N to V vertices; the first N are the smoothed coarse ones
    edges: Int[np.ndarray, "E 2"]

    def follow(self, values: Float[np.ndarray, "B D"]) -> Float[np.ndarray, "V D"]:
        """Transfer positions or displacements of the base mesh to the skin."""
        return np.asarray(self.subdivision.weights @ values[self.base])


def build_skin(source: MakeHuman) -> Skin:
    """Build the skin from MakeHuman's body: cut, subdivide, map to the uv square, compute vertex groups."""
    body = source.quads["body"]
    kept = beyond_loop(body, edge_loop(body, *_NECK_LOOP), _SCALP)
    base, coarse = np.unique(body[kept], return_inverse=True)
    coarse = coarse.reshape(-1, 4)
    mirror = np.searchsorted(base, source.mirror[base])
    island = _islands(source.vertices[base], coarse, source.uv_quads["body"][kept])
    fine = subdivide(coarse, mirror)
    vertices = symmetrize(np.asarray(fine.weights @ source.vertices[base]), fine.mirror)
    edges, _, _ = edges_of(fine.quads)
    part = MeshPart(
        vertices=vertices,
        quads=fine.quads,
        quad_uvs=fine_corners(_uv_map(source.vertices[base], coarse, mirror, island)),
        groups=_groups(source, base, fine, vertices, np.repeat(island, 4), edges),
        mirror=fine.mirror,
    )
    return Skin(part=part, base=base, subdivision=fine, edges=edges)


def symmetrize(vertices: Float[np.ndarray, "V 3"], mirror: Int[np.ndarray, "V"]) -> Float[np.ndarray, "V 3"]:
    """Return the mean of a mesh and its mirror image, which is symmetric to the last bit.

    Sums in another order make the two sides of a subdivided mesh differ by rounding.

    Args:
        vertices: model frame, the plane of symmetry is x = 0.
        mirror: the mirror image of every vertex.
    """
    return (vertices + vertices[mirror] * (-1, 1, 1)) / 2


def _islands(points: Float[np.ndarray, "N 3"], quads: np.ndarray, uv_quads: np.ndarray) -> Int[np.ndarray, "Q"]:
    """Label the quads by MakeHuman's uv islands: 0 exterior, 1 oral lining, 2 and 3 eye sockets, left and right."""
    edges, of_quad, _ = edges_of(uv_quads)
    label, number = pieces(of_quad, np.ones(len(edges), bool))
    if number != 5:
        raise ValueError(f"expected five uv islands (face, neck, mouth, two eye sockets), got {number}")
    centre = np.array([points[quads[label == n]].mean((0, 1)) for n in range(number)])
    kind = np.zeros(number, int)
    left, right = centre[:, 0].argmax(), centre[:, 0].argmin()
    kind[[left, right]] = 2, 3
    rest = [n for n in range(number) if n not in (left, right, np.bincount(label).argmax())]  # neck and mouth
    kind[max(rest, key=lambda n: centre[n, 1])] = 1
    return kind[label]


def _uv_map(
    points: Float[np.ndarray, "N 3"], quads: Int[np.ndarray, "Q 4"], mirror: Int[np.ndarray, "N"], island: np.ndarray
) -> Float[np.ndarray, "Q 4 2"]:
    """Map the skin to the unit square: the exterior, slit along the nape, above; mouth and sockets in a strip below."""
    uvs = np.empty((len(quads), 4, 2))
    exterior = quads[island == 0]
    slit = _nape_path(points, exterior, mirror)
    cut, copies = _cut_open(points, exterior, slit)
    loop = max(boundary_loops(cut), key=lambda loop: len(loop) * np.isin(slit[-1], loop))
    loop = np.roll(loop, -int(np.flatnonzero(loop == slit[-1])[0]))  # starts at the crown
    uvs[island == 0] = _squircle_map(points[copies], cut, loop)[cut] * (1, 0.84) + (0, 0.16)
    for label, (u, width) in {1: (0.01, 0.30), 2: (0.40, 0.15), 3: (0.70, 0.15)}.items():
        rows, corner = np.unique(quads[island == label], return_inverse=True)
        local = corner.reshape(-1, 4)
        boundary = boundary_loops(local)[0]
        angle = 2 * np.pi * _arc_length(points[rows][boundary])
        circle = 0.5 + 0.5 * np.stack([np.cos(angle), np.sin(angle)], 1)
        uvs[island == label] = flat_map(points[rows], local, boundary, circle)[local] * (width, 0.15) + (u, 0.002)
    return uvs


def _nape_path(points: np.ndarray, quads: np.ndarray, mirror: np.ndarray) -> Int[np.ndarray, "S"]:
    """Return the midline's vertices from the neck's boundary at the back up to the crown."""
    edges, _, count = edges_of(quads)
    midline = mirror == np.arange(len(points))
    neighbours: dict[int, list[int]] = {}
    for a, b in edges[midline[edges].all(1)].tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    boundary = [v for v in np.unique(edges[count == 1]).tolist() if midline[v] and points[v, 1] < points[:, 1].mean()]
    path = [min(boundary, key=lambda v: points[v, 2])]
    while True:
        higher = [v for v in neighbours[path[-1]] if v not in path and points[v, 1] > points[path[-1], 1]]
        if not higher:
            return np.array(path)
        path.append(higher[0])


def _cut_open(points: np.ndarray, quads: np.ndarray, slit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quads cut open along a path, whose last vertex stays single, and the point of each of their vertices."""
    copy = np.arange(len(points))
    copy[slit[:-1]] = len(points) + np.arange(len(slit) - 1)
    right = points[quads][:, :, 0].mean(1) < 0
    return np.where(right[:, None], copy[quads], quads), np.concatenate([np.arange(len(points)), slit[:-1]])


def _squircle_map(points: np.ndarray, quads: np.ndarray, loop: np.ndarray) -> Float[np.ndarray, "V 2"]:
    """Map the exterior to a square with rounded corners: strictly convex, so that no face degenerates.

    The boundary loop starts at the top.
    """
    angle = np.pi / 2 + 2 * np.pi * _arc_length(points[loop])
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    outline = 0.5 + 0.5 * np.sign(direction) * np.sqrt(np.abs(direction))
    return flat_map(points, quads, loop, outline)


def _arc_length(loop: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Return the arc length before each point of a closed curve, as a fraction of the whole."""
    length = np.linalg.norm(np.roll(loop, -1, 0) - loop, axis=1)
    return np.concatenate([[0], np.cumsum(length)[:-1]]) / length.sum()


def fine_corners(corners: Float[np.ndarray, "Q 4 D"]) -> Float[np.ndarray, "4*Q 4 D"]:
    """Interpolate values of quad corners linearly for the four quads each that `subdivide` returns."""
    midpoints = (corners + np.roll(corners, -1, 1)) / 2
    centre = np.broadcast_to(corners.mean(1, keepdims=True), corners.shape)
    return np.stack([corners, midpoints, centre, np.roll(midpoints, 1, 1)], 2).reshape(-1, 4, corners.shape[-1])


def _groups(
    source: MakeHuman,
    base: np.ndarray,
    fine: Subdivision,
    vertices: Float[np.ndarray, "V 3"],
    island: Int[np.ndarray, "F"],
    edges: Int[np.ndarray, "E 2"],
) -> dict[str, Bool[np.ndarray, "V"]]:
    """Compute the vertex groups of the skin: surfaces, lips, ears and the official file's regions of the face."""
    count = len(vertices)

    def on_island(*labels: int) -> Bool[np.ndarray, "V"]:
        members = np.zeros(count, bool)
        members[fine.quads[np.isin(island, labels)]] = True
        return members

    def in_mask(name: str) -> Bool[np.ndarray, "V"]:
        return np.asarray(fine.linear @ source.masked(name)[base].astype(float)) > 0.5

    exterior = on_island(0)
    lips = in_mask("lips") & exterior
    # The corner of the mouth is the outermost point of the border between exterior and oral lining.
    border = exterior & on_island(1)
    corner = vertices[border][np.argmax(vertices[border, 0])]
    upper = _above_mouth(vertices, fine.quads[island == 0], lips, corner[1])
    face = in_mask("face") & exterior
    groups = {
        "skin": np.ones(count, bool),
        "skin_exterior": exterior,
        "hockey_mask": face,
        "upper_lip": lips & upper,
        "lower_lip": lips & ~upper,
        "mouth_sock": on_island(1) & ~exterior,
        "eye_sockets": on_island(2, 3) & ~exterior,
        "ears": in_mask("ears") & exterior,
    }
    return groups | _face_regions(vertices, fine.mirror, face, edges)


def _above_mouth(
    vertices: np.ndarray, quads: np.ndarray, lips: Bool[np.ndarray, "V"], height: float
) -> Bool[np.ndarray, "V"]:
    """Return whether vertices lie above the mouth's slit, by geodesic distance to the front of upper and lower lip."""
    edges, _, _ = edges_of(quads)
    central = lips & (np.abs(vertices[:, 0]) < 0.012)
    above, below = central & (vertices[:, 1] > height + 0.003), central & (vertices[:, 1] < height - 0.005)
    return edge_distances(vertices, edges, above) < edge_distances(vertices, edges, below)


def front_points(
    vertices: Float[np.ndarray, "V 3"], eligible: Bool[np.ndarray, "V"], points_mm: Float[np.ndarray, "P 2"]
) -> Int[np.ndarray, "P"]:
    """Return the eligible vertex nearest to each point in a front view, among the foremost within 4 mm.

    Args:
        vertices: metres, model frame.
        eligible: which vertices may be returned.
        points_mm: x and y.
    """
    rows = np.flatnonzero(eligible)
    tree = cKDTree(vertices[rows, :2])
    nearest = []
    for x, y in np.asarray(points_mm) / 1000:
        near = rows[tree.query_ball_point((x, y), 4e-3)]
        if not len(near):
            near = rows[[tree.query((x, y))[1]]]
        near = near[vertices[near, 2] > vertices[near, 2].max() - 8e-3]
        distance = np.hypot(vertices[near, 0] - x, vertices[near, 1] - y)
        nearest.append(near[np.argmin(distance)])
    return np.array(nearest)


def _face_regions(
    vertices: np.ndarray, mirror: np.ndarray, face: Bool[np.ndarray, "V"], edges: np.ndarray
) -> dict[str, Bool[np.ndarray, "V"]]:
    """Return the official file's regions of the face by nearest seed along the surface; the sides mirror each other."""
    inner = edges[face[edges].all(1)]
    names, distances = [], []
    for name, points in _REGIONS.items():
        left = front_points(vertices, face & (vertices[:, 0] > -1e-4), np.array(points, float))
        seeds = np.zeros(len(vertices), bool)
        seeds[left] = True
        distance = edge_distances(vertices, inner, seeds)
        if name in _UNPAIRED:
            names.append(f"{name}_region")
            distances.append(np.minimum(distance, distance[mirror]))
        else:
            names += [f"left_{name}_region", f"right_{name}_region"]
            distances += [distance, distance[mirror]]
    nearest = np.stack(distances)
    # A vertex at equal distance from two regions is in both; otherwise a midline vertex would be on one side only.
    member = face & (nearest <= nearest.min(0) + _TIE_M) & np.isfinite(nearest)
    return dict(zip(names, member, strict=True))
