"""What may be wrong with a scan that is used: stray pieces, winding, axes, parts of the file that do not count."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from registration.capture.scan import Scan
from registration.doctor import scan_position
from registration.doctor.findings import Finding, warnings
from registration.doctor.fixes import ScanFix
from registration.doctor.mesh_frame import Frame, candidate_frames
from registration.doctor.scan_frame import (
    FEW_SAMPLES,
    GRID,
    MAX_DISTANCE_M,
    MAX_SAMPLES,
    MIN_LANDMARKS,
    Silhouettes,
    evenly_spaced,
    finite_points,
    frame_kind,
    length_text,
    vertex_tree,
)
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.topology import directed_edges_used_twice
from registration.types import Capture, View

_NEAR = 8  # vertices around a landmark whose faces are searched
_CELL_M = 0.05  # pieces of a scan that are further apart than one to two cells float
_MAX_CELLS = 2**20  # per axis
_MANY = 0.01
_SURFACES = ("tristrips", "tristrip", "range_grid", "face", "triangle", "polygon")  # elements of PLY that join vertices
_CLEARLY = 1.15  # times the overlap
_CLEARLY_M = 2.5e-4  # nearer to the landmarks
_MAX_FACES = 300_000  # whose neighbours are compared
_FRONT_M = 0.01  # behind the nearest point of a coarse cell


def scan_warnings(capture: Capture, scan: Scan, landmarks: Float[np.ndarray, "L 3"]) -> list[Finding]:
    """What may be wrong with a scan that `require_frame` accepts; empty if nothing is.

    Args:
        capture: whose cameras see the scan.
        scan: of the capture.
        landmarks: triangulated, metres; NaN where not.
    """
    found, tree = warnings("scan-contents", _contents(scan)), vertex_tree(scan.vertices)
    if pieces := _floating(scan.vertices):
        found.append(Finding.warning("scan-pieces", pieces))
    points = finite_points(landmarks)
    if len(points) < MIN_LANDMARKS:
        turned = _turned(capture, scan)
        found += turned or scan_position.moved_from_masks(capture, scan)
    elif (frame := _better_frame(scan, points, distance := _landmark_distance(scan, tree, points), tree)) is not None:
        found.append(_turned_scan(capture, frame, "fits the landmarks"))
    else:
        found += scan_position.moved_from_landmarks(scan, tree, points, distance)
    if len(scan.triangles) and not any(finding.kind == "scan-mirrored" for finding in found):
        found += warnings("scan-winding", _winding(capture, scan))
    return found


def _turned_scan(capture: Capture, frame: Frame, how: str) -> Finding:
    """A scan that fits better in other axes. A person compares: what is left may be the symmetry of a head."""
    line = f"the scan {how} better if it is {frame}; compare it with the images, and export it again"
    fix = None
    if capture.scan is not None:
        fix = ScanFix(what=f"converted the scan that was {frame}", frame=frame, file=capture.scan.name)
    return Finding.warning(frame_kind(frame), line, fix)


def scan_facts(scan: Scan) -> str:
    """One line: size, and what of the file is left out."""
    extent = " x ".join(f"{MM_PER_M * side:.0f}" for side in np.ptp(scan.vertices, axis=0))
    parts = [f"{len(scan.vertices)} vertices, {len(scan.triangles)} faces, {extent} mm"]
    parts += [f"{scan.unused_vertices} vertices that no face uses are left out"] if scan.unused_vertices else []
    parts += [f"{scan.unused_faces} repeated or degenerate faces are left out"] if scan.unused_faces else []
    return "; ".join(parts)


def _contents(scan: Scan) -> list[str]:
    """Lines about parts of the file that are not measured, if they are many."""
    lines = []
    total = scan.unused_vertices + len(scan.vertices)
    if scan.unused_vertices > _MANY * total:
        lines.append(f"{scan.unused_vertices} of the scan's {total} vertices are not measured: no face uses them")
    surfaces = [name for name, count in scan.unread.items() if count and name in _SURFACES]
    if not len(scan.triangles) and (surfaces or scan.unused_faces):
        cause = f"its {', '.join(surfaces)} cannot be read" if surfaces else "its faces have no area"
        lines.append(f"the scan counts as a point cloud: {cause}; export it with triangles")
    return lines


def _floating(vertices: Float[np.ndarray, "V 3"]) -> str | None:
    """A line about pieces that are far from the largest one; None if there are none."""
    lowest = vertices.min(0)
    cells = np.minimum((vertices - lowest) // _CELL_M, _MAX_CELLS - 1).astype(np.int64)
    keys, count = np.unique(cells @ [_MAX_CELLS**2, _MAX_CELLS, 1], return_counts=True)
    centres = np.stack([keys // _MAX_CELLS**2, keys // _MAX_CELLS % _MAX_CELLS, keys % _MAX_CELLS], -1)
    pairs = cKDTree(centres).query_pairs(1.8, output_type="ndarray")  # neighbours, diagonal ones too
    shape = (len(keys), len(keys))
    pieces, piece = connected_components(coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=shape), directed=False)
    if pieces == 1:
        return None
    main = np.bincount(piece, count).argmax()
    away = _CELL_M * cKDTree(centres[piece == main]).query(centres[piece != main])[0].max()
    number = "one piece" if pieces == 2 else f"{pieces - 1} pieces"
    floating = f"{count[piece != main].sum()} vertices of the scan, in {number},"
    return f"{floating} float up to {length_text(away)} away from the rest: remove what is no skin"


def _landmark_distance(scan: Scan, tree: cKDTree, points: Float[np.ndarray, "L 3"]) -> float:
    """The median distance (m) of landmarks from a scan, of its faces from those around the nearest vertices."""
    distance, nearest = tree.query(points, k=min(_NEAR, len(scan.vertices)))
    if not len(scan.triangles):
        return float(np.median(distance[:, 0]))
    near = np.zeros(len(scan.vertices), bool)
    near[nearest] = True
    faces = scan.triangles[near[scan.triangles].any(1)]
    return float(np.median(closest_points(points, scan.vertices, faces)[0]))


def _better_frame(scan: Scan, points: Float[np.ndarray, "L 3"], distance: float, tree: cKDTree) -> Frame | None:
    """The axes with which a scan fits landmarks clearly better than with its own, at `distance` (m); None: none."""
    frames = [frame for frame in candidate_frames() if frame.unit == 1 and not frame.plain]
    medians = [float(np.median(tree.query(frame.to_file(points))[0])) for frame in frames]
    frame = frames[int(np.argmin(medians))]
    turned = _landmark_distance(scan, tree, frame.to_file(points))
    fits = turned <= MAX_DISTANCE_M / 2 and 2 * turned < distance and distance - turned > _CLEARLY_M
    return frame if fits else None


def _turned(capture: Capture, scan: Scan) -> list[Finding]:
    """A warning if the scan's silhouette fits the masks better with other axes."""
    views, frames = Silhouettes.of(capture), [frame for frame in candidate_frames() if frame.unit == 1]
    if not views.masks:
        return []
    sample = scan.vertices[:: -(-len(scan.vertices) // FEW_SAMPLES)]
    best = views.best(sample, frames)
    if best is None or best[1].plain or best[0] < _CLEARLY * views.overlap(sample):
        return []
    return [_turned_scan(capture, best[1], "by its silhouette fits the masks")]


def _winding(capture: Capture, scan: Scan) -> list[str]:
    """Lines about faces that show the cameras their back."""
    rng = np.random.default_rng(0)
    chosen = scan.triangles[rng.permutation(len(scan.triangles))[:MAX_SAMPLES]]
    a, b, c = (scan.vertices[chosen[:, k]] for k in range(3))
    normal, centre = np.cross(b - a, c - a), (a + b + c) / 3
    outside = inside = 0.0
    for view in evenly_spaced(capture.views, 6):
        area = (normal * (view.camera.centre - centre)).sum(1)[_in_front(view, centre)]
        outside, inside = outside + area[area > 0].sum(), inside - area[area < 0].sum()
    lines = []
    if inside > outside:
        lines.append(
            "the scan's faces point inwards: it is inside out or mirrored; distances are measured all the same, but "
            "compare it with the images"
        )
    if twice := directed_edges_used_twice(scan.triangles[:_MAX_FACES]):
        lines.append(f"the scan's faces are wound in both directions: neighbours disagree at {twice} edges or more")
    return lines


def _in_front(view: View, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    """Which points of a surface a view may see: those that are about the nearest in their coarse cell of the image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, depth = view.camera.project(points)
        cells = np.clip(2 * GRID * xy / [view.camera.width_px, view.camera.height_px], -1, 2 * GRID)
    cells = np.where((depth > 0)[:, None], cells, -1).astype(np.int64)
    inside = (cells >= 0).all(1) & (cells < 2 * GRID).all(1)
    cell = np.where(inside, cells[:, 0] * 2 * GRID + cells[:, 1], 0)
    nearest = np.full(4 * GRID**2, np.inf)
    np.minimum.at(nearest, cell[inside], depth[inside])
    return inside & (depth < nearest[cell] + _FRONT_M)
