"""Make a map between topologies: the target's mesh is bent onto the source's, then projected."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points
from registration.geometry.nonrigid_icp import Bent, Hits, IcpSettings, Surface, bend
from registration.geometry.rigid import similarity_transform
from registration.geometry.topology import connected_parts, vertex_areas
from registration.progress import NullProgress, Progress
from registration.topology_map.landmarked import LandmarkedMesh
from registration.topology_map.topology_map import SurfacePoints, TopologyMap

_LEAST_LANDMARKS = 4
_FACE_M = (0.015, 0.15)  # rms distance of the landmarks of a face from their mean
_USUAL_SPREAD_M = 2e-3  # of a landmark whose scheme states none
_NEIGHBOURS = 200  # vertices of the skin that a part without correspondences moves with


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """How a map is made and when it is accepted."""

    icp: IcpSettings = field(default_factory=IcpSettings)
    mean_mm: float = 0.02  # largest mean distance of the bent vertices from the source's surface
    cycle_mm: float = 0.2  # largest mean distance of a vertex from itself, carried to the source and back
    least_covered: float = 0.7  # of the area of the outer surface


def map_topologies(
    source: LandmarkedMesh,
    target: LandmarkedMesh,
    settings: MapSettings | None = None,
    progress: Progress | None = None,
) -> TopologyMap:
    """Map a source's topology to a target's.

    Args:
        source: metres. Its surface is the one that both meshes get.
        target: in any unit and frame.
        settings: of the bending, and the limits of acceptance.
        progress: where to report to.

    Returns:
        The map. Its status is "refused", with reasons, where a check failed.

    Raises:
        InputError: fewer than four landmarks are common to both, or the source is not in metres.
    """
    settings, progress = settings or MapSettings(), progress or NullProgress()
    marks = _common_landmarks(source, target)
    scale, rotation, translation = similarity_transform(
        marks.on_target @ target.vertices, marks.points, free_scale=True, weights=marks.trust
    )
    progress.message(f"bending {target.name} onto {source.name}")
    start = scale * target.vertices @ rotation.T + translation
    bent = _bent(source, target, start, marks, settings.icp)
    points = _points(bent, target, source.vertices, source)
    back = _points(source.vertices, source, bent, target)
    figures = _figures(source, target, bent, points, back) | _landmark_figures(marks, bent)
    reasons = _reasons(figures, settings)
    return TopologyMap(
        source_triangles=source.triangles,
        target_triangles=target.triangles,
        points=points,
        back=back,
        scale=scale,
        rotation=rotation,
        translation=translation,
        status="refused" if reasons else "accepted",
        reasons=reasons,
        figures=figures,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Landmarks:
    """The L landmarks that lie on both outer surfaces."""

    on_target: csr_matrix  # (L, V)
    points: Float[np.ndarray, "L 3"]  # on the source
    trust: Float[np.ndarray, "L"]


def _common_landmarks(source: LandmarkedMesh, target: LandmarkedMesh) -> _Landmarks:
    indices, weights, points, spread = [], [], [], []
    for name in sorted(source.schemes.keys() & target.schemes.keys()):
        a, b = source.schemes[name], target.schemes[name]
        if len(a.indices) != len(b.indices):
            raise _landmark_error(source, target, f"{len(a.indices)} and {len(b.indices)} points in scheme {name}")
        kept = source.members[a.indices].all(1) & target.members[b.indices].all(1)
        indices.append(b.indices[kept])
        weights.append(b.weights[kept])
        points.append(a.points(source.vertices)[kept])
        both = [s.spread_m[kept] for s in (a, b) if s.spread_m is not None]
        spread.append(np.sqrt(np.square(both).sum(0)) if both else np.full(int(kept.sum()), _USUAL_SPREAD_M))
    marks = np.concatenate(points) if points else np.zeros((0, 3))
    if len(marks) < _LEAST_LANDMARKS:
        names = [", ".join(sorted(mesh.schemes)) or "none" for mesh in (source, target)]
        raise _landmark_error(source, target, f"{len(marks)} points; schemes: {names[0]}, and {names[1]}")
    size = float(np.sqrt(np.square(marks - marks.mean(0)).sum(1).mean()))
    if not _FACE_M[0] < size < _FACE_M[1]:
        raise InputError(
            "The source of a map is not in metres",
            where=source.name,
            expected=f"landmarks {_FACE_M[0]} to {_FACE_M[1]} m from their mean",
            got=f"{size:g}",
            fix="scale the mesh to metres",
        )
    rows = np.repeat(np.arange(len(marks)), 3)
    columns, values = np.concatenate(indices).ravel(), np.concatenate(weights).ravel()
    matrix = coo_matrix((values, (rows, columns)), (len(marks), len(target.vertices))).tocsr()
    trust = np.minimum((_USUAL_SPREAD_M / np.concatenate(spread)) ** 2, 4.0)
    return _Landmarks(on_target=matrix, points=marks, trust=trust)


def _landmark_error(source: LandmarkedMesh, target: LandmarkedMesh, got: str) -> InputError:
    return InputError(
        "The meshes have too few landmarks in common",
        where=f"{source.name}, {target.name}",
        expected=f"at least {_LEAST_LANDMARKS} landmarks of one scheme on both surfaces",
        got=got,
        fix="put the same scheme beside both files, as head_sparse_NAME.txt",
    )


def _bent(
    source: LandmarkedMesh,
    target: LandmarkedMesh,
    start: Float[np.ndarray, "V 3"],
    marks: _Landmarks,
    settings: IcpSettings,
) -> Float[np.ndarray, "V 3"]:
    """The target's vertices, bent: its skin by non-rigid ICP, other parts rigidly with the skin around them."""
    rows, triangles = _part(target.triangles, target.skin)
    mesh = Bent(
        vertices=start[rows],
        triangles=triangles,
        data=target.members[rows],
        whole=target.whole[rows],
        landmarks=marks.on_target[:, rows],
        marks=marks.points,
        trust=marks.trust,
    )
    surface_rows, surface_triangles = _part(source.triangles, source.skin)
    surface = Surface(source.vertices[surface_rows], surface_triangles, source.members[surface_rows])
    result = start.copy()
    result[rows] = bend(mesh, surface, settings)
    tree = cKDTree(start[rows])
    for members in _other_parts(target):
        near = rows[np.unique(tree.query(start[members], k=min(_NEIGHBOURS, len(rows)))[1])]
        scale, rotation, translation = similarity_transform(start[near], result[near], free_scale=True)
        result[members] = scale * start[members] @ rotation.T + translation
    return result


def _part(
    triangles: Int[np.ndarray, "F 3"], members: Bool[np.ndarray, "V"]
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "G 3"]]:
    """The vertices of a part, and its triangles as indices of these."""
    inside = triangles[members[triangles].all(1)]
    rows, corners = np.unique(inside, return_inverse=True)
    return rows, corners.reshape(-1, 3)


def _other_parts(mesh: LandmarkedMesh) -> list[Int[np.ndarray, "N"]]:
    """The vertices of each connected part off the skin, and those that no triangle uses."""
    labels = np.full(len(mesh.vertices), -1)
    labels[mesh.triangles] = connected_parts(mesh.triangles)[:, None]
    skin = np.zeros(len(labels), bool)
    skin[_part(mesh.triangles, mesh.skin)[0]] = True
    return [np.flatnonzero((labels == label) & ~skin) for label in np.unique(labels[~skin])]


def _points(
    vertices: Float[np.ndarray, "V 3"],
    mesh: LandmarkedMesh,
    other: Float[np.ndarray, "W 3"],
    other_mesh: LandmarkedMesh,
) -> SurfacePoints:
    """The closest points of one mesh's vertices on the other, both bent together; each part's on the same part."""
    count = len(vertices)
    triangle, share, distance = np.zeros(count, np.int64), np.zeros((count, 3)), np.zeros(count)
    mask, offset = np.zeros(count, bool), np.zeros((count, 3))
    for name, members in _by_part(mesh, other_mesh).items():
        faces = np.arange(len(other_mesh.triangles))
        if name in other_mesh.parts:
            faces = np.flatnonzero(other_mesh.parts[name][other_mesh.triangles].all(1))
        surface = Surface(other, other_mesh.triangles[faces], other_mesh.members)
        hits: Hits = surface.closest(vertices[members])
        triangle[members], share[members], distance[members] = faces[hits.face], hits.barycentric, hits.distance
        mask[members] = hits.usable & mesh.members[members]
        offset[members] = vertices[members] - hits.points
    return SurfacePoints(triangle=triangle, barycentric=share, distance_m=distance, mask=mask, offset=offset)


def _by_part(mesh: LandmarkedMesh, other: LandmarkedMesh) -> dict[str, Int[np.ndarray, "N"]]:
    """The vertices by the name of the part that they are looked for on; "": on any."""
    names = np.full(len(mesh.vertices), "", dtype=object)
    for name in mesh.parts.keys() & other.parts.keys():
        names[mesh.parts[name]] = name
    return {name: np.flatnonzero(names == name) for name in sorted(set(names.tolist()))}


def _figures(
    source: LandmarkedMesh,
    target: LandmarkedMesh,
    bent: Float[np.ndarray, "V 3"],
    points: SurfacePoints,
    back: SurfacePoints,
) -> dict[str, float]:
    mask = points.mask
    distance = MM_PER_M * points.distance_m[mask] if mask.any() else np.array([np.inf])
    areas = vertex_areas(bent, target.triangles)
    cycle = MM_PER_M * _cycle(source, bent, target, points, back)
    return {
        "mean_mm": float(distance.mean()),
        "p95_mm": float(np.percentile(distance, 95)),
        "max_mm": float(distance.max()),
        "covered": float(areas[mask].sum() / max(areas[target.members].sum(), 1e-20)),
        "flipped_faces": float(len(flipped_faces(source, target, bent, mask))),
        "cycle_mean_mm": float(cycle.mean()),
        "cycle_p95_mm": float(np.percentile(cycle, 95)),
        "cycle_max_mm": float(cycle.max()),
    }


def _cycle(
    source: LandmarkedMesh,
    bent: Float[np.ndarray, "V 3"],
    target: LandmarkedMesh,
    points: SurfacePoints,
    back: SurfacePoints,
) -> Float[np.ndarray, "N"]:
    """Distances of the target's vertices from themselves, carried to the source and back; metres of the source."""
    corners = source.triangles[points.triangle]
    rows = np.flatnonzero(points.mask & back.mask[corners].all(1))
    if not len(rows):
        return np.array([np.inf])
    returned = barycentric_points(bent, target.triangles, back.triangle, back.barycentric)
    there = np.einsum("vk,vkc->vc", points.barycentric[rows], returned[corners[rows]])
    return np.linalg.norm(there - bent[rows], axis=1)


def flipped_faces(
    source: LandmarkedMesh,
    target: LandmarkedMesh,
    bent: Float[np.ndarray, "V 3"],
    mask: Bool[np.ndarray, "V"],
) -> Int[np.ndarray, "N"]:
    """Return the target's faces within the mask that look into the source's surface."""
    faces = np.flatnonzero(mask[target.triangles].all(1))
    if not len(faces):
        return faces
    corners = bent[target.triangles[faces]]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    skin = source.triangles[source.skin[source.triangles].all(1)]
    outwards = Surface(source.vertices, skin).closest(corners.mean(1)).normals
    return faces[np.einsum("fc,fc->f", across, outwards) <= 0]


def _landmark_figures(marks: _Landmarks, bent: Float[np.ndarray, "V 3"]) -> dict[str, float]:
    residual = MM_PER_M * np.linalg.norm(marks.on_target @ bent - marks.points, axis=1)
    return {"landmarks": float(len(residual)), "landmark_median_mm": float(np.median(residual))}


def _reasons(figures: Mapping[str, float], settings: MapSettings) -> tuple[str, ...]:
    limits = {
        "mean_mm": (settings.mean_mm, "the bent vertices are {got:.3f} mm from the surface in the mean, not {limit:g}"),
        "cycle_mean_mm": (settings.cycle_mm, "carried there and back, vertices move by {got:.3f} mm, not {limit:g}"),
        "flipped_faces": (0, "{got:.0f} faces are flipped"),
    }
    reasons = [text.format(got=figures[k], limit=limit) for k, (limit, text) in limits.items() if figures[k] > limit]
    if figures["covered"] < settings.least_covered:
        reasons.append(f"only {figures['covered']:.0%} of the outer surface has a counterpart")
    return tuple(reasons)
