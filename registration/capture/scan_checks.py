"""Checks of a scan and of true vertices: unit and frame against landmarks or cameras, stray pieces, winding.

A mesh in another frame is compared with the landmarks, or with the masks, in every unit and with every exchange of the
axes: what fits tells the user how to export it again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from registration.capture import pixels
from registration.capture.scan import Scan, read_scan, read_truth
from registration.capture.triangulation import triangulate
from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import directed_edges_used_twice
from registration.types import Capture, View

MIN_LANDMARKS = 6  # that locate a mesh
MAX_DISTANCE_M = 0.01  # median of the landmarks' distances from a mesh of the skin that they lie on
FAR_M = 0.1  # of all landmarks: the mesh shows something else, or lies elsewhere
_UNITS = {1.0: "", 1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 1e3: "kilometres"}
_AXES = "xyz"
_NEAR = 8  # vertices around a landmark whose faces are searched
_CELL_M = 0.05  # pieces of a scan that are further apart than one to two cells float
_MAX_CELLS = 2**20  # per axis
_GRID = 32  # cells per side of the coarse images in which a scan without landmarks is compared with masks
_MIN_OVERLAP = 0.1  # of a mesh with the masks; a scan of the whole body beside masks of the head has 0.2
_FITS = 0.5
_MANY = 0.01
_SURFACES = ("tristrips", "tristrip", "range_grid", "face", "triangle", "polygon")  # elements of PLY that join vertices
_CLEARLY = 1.15  # times the overlap
_CLEARLY_M = 2.5e-4  # nearer to the landmarks
_HEADS_M = (0.1, 3.0)  # sizes of a scan, from a face to a body
_MAX_SAMPLES, _FEW_SAMPLES = 20_000, 2_000


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """How a file's coordinates may have been exported: world axis k is sign * file axis, times the unit."""

    unit: float  # metres per unit of the file
    axes: tuple[int, int, int]
    signs: tuple[int, int, int]

    @property
    def plain(self) -> bool:
        return self.axes == (0, 1, 2) and self.signs == (1, 1, 1)

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(np.eye(3)[list(self.axes)] * self.signs) < 0)

    def to_file(self, world: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """World points (m) in the coordinates that the file would give them."""
        points = np.empty_like(world)
        points[:, list(self.axes)] = world * self.signs / self.unit
        return points

    def to_world(self, file: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        """Points of the file in the world, metres."""
        return file[:, list(self.axes)] * self.signs * self.unit

    def __str__(self) -> str:
        turned = ", ".join(("-" if s < 0 else "") + _AXES[k] for k, s in zip(self.axes, self.signs, strict=True))
        parts = [f"in {_UNITS[self.unit]}"] if self.unit != 1 else []
        parts += [] if self.plain else [f"{'mirrored' if self.mirrored else 'turned'}: the world is its ({turned})"]
        return " and ".join(parts)


_AS_IT_IS = _Frame(unit=1.0, axes=(0, 1, 2), signs=(1, 1, 1))


def _frames() -> Iterator[_Frame]:
    """All units and all axes, simpler ones first."""
    axes = [(a, s) for a in permutations(range(3)) for s in product((1, -1), repeat=3)]
    turned = [_Frame(unit=1.0, axes=a, signs=s) for a, s in axes]  # type: ignore[arg-type]
    turned.sort(key=lambda frame: (not frame.plain, frame.mirrored))
    for frame in turned:
        for unit in _UNITS:
            yield _Frame(unit=unit, axes=frame.axes, signs=frame.signs)


def require_frames(capture: Capture) -> Scan | None:
    """Read a capture's scan and its true vertices, and refuse them as `require_frame` does.

    Returns:
        The scan, if there is one.

    Raises:
        InputError: a file cannot be read, or is in another unit or frame than the cameras.
    """
    if capture.scan is None and capture.ground_truth is None:
        return None
    landmarks, scan = surface_landmarks(capture), None
    if capture.scan is not None:
        scan = read_scan(capture.scan)
        require_frame("scan", capture.scan, scan.vertices, capture, landmarks)
    if capture.ground_truth is not None and len(truth := read_truth(capture.ground_truth)):
        require_frame("ground truth", capture.ground_truth, truth.astype(np.float64), capture, landmarks)
    return scan


def require_frame(
    title: str, where: Path, vertices: Float[np.ndarray, "V 3"], capture: Capture, landmarks: Float[np.ndarray, "L 3"]
) -> None:
    """Refuse a mesh of the capture's head that is clearly in another unit or frame than its world.

    Args:
        title: what messages call the mesh.
        where: its file.
        vertices: as read, which should be metres in the capture's world.
        capture: without enough landmarks, its masks and cameras are compared.
        landmarks: triangulated, metres; NaN where not.

    Raises:
        InputError: another unit or frame explains the mesh, or all landmarks are far from it, or no camera sees it.
    """
    points = _valid(landmarks)
    if len(points) >= MIN_LANDMARKS:
        distance, guess = _fit_landmarks(vertices, points)
        if guess is None and distance.min() <= FAR_M:
            return
        expected = "a surface at the landmarks"
        got = f"one {_length(float(np.median(distance)))} from them in the median"
    else:
        seen, guess = _fit_views(vertices, capture)
        if guess is None and seen:
            return
        expected, got = "a surface that the cameras see where the subject is", "one outside the masks or the images"
    extent = " x ".join(_length(side) for side in np.ptp(vertices, axis=0))
    raise InputError(
        f"The {title} is in another unit or frame than the cameras",
        where=where,
        expected=expected,
        got=f"{got}, {extent} large" + (f"; it fits if it is {guess}" if guess else ""),
        fix="export it in metres in the world of the COLMAP model, or remove it",
    )


def _fit_landmarks(
    vertices: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "L 3"]
) -> tuple[Float[np.ndarray, "L"], _Frame | None]:
    """Distances (m) of landmarks from a mesh as it is; and the frame in which it fits, if it does not and one does."""
    tree = _tree(vertices)
    distance = tree.query(points)[0]
    limit = min(MAX_DISTANCE_M / 2, float(np.median(distance)) / 4)
    if np.median(distance) <= MAX_DISTANCE_M:
        return distance, None
    frames = list(_frames())
    medians = np.array([frame.unit * float(np.median(tree.query(frame.to_file(points))[0])) for frame in frames])
    # A head is nearly symmetric: among frames that fit about equally well the simplest one is meant.
    fitting = np.flatnonzero(medians <= min(limit, 2 * medians.min() + 1.5e-3))
    return distance, frames[fitting[0]] if len(fitting) else None


def _fit_views(vertices: Float[np.ndarray, "V 3"], capture: Capture) -> tuple[bool, _Frame | None]:
    """Whether the cameras see a mesh as it is, where the masks are; and the frame in which it fits, if not."""
    sample = vertices[:: -(-len(vertices) // _MAX_SAMPLES)]
    views = _Silhouettes.of(capture)
    overlap = views.overlap(sample)
    if overlap >= _MIN_OVERLAP:
        return True, None
    frames = list(_frames())
    if not views.masks:  # a mesh that shrinks to a point would fit best
        size = float((np.percentile(sample, 95, axis=0) - np.percentile(sample, 5, axis=0)).max())
        frames = [frame for frame in frames if _HEADS_M[0] <= frame.unit * size <= _HEADS_M[1]]
    guess = views.best(sample, frames)
    if guess is not None and guess[0] >= _FITS:
        return False, guess[1]
    return overlap > 0, None


@dataclass(frozen=True, kw_only=True)
class _Silhouettes:
    """Some views of a capture with coarse masks, or without where there are none."""

    views: tuple[View, ...]
    masks: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, capture: Capture) -> "_Silhouettes":
        masked = [view for view in capture.views if view.mask is not None] or list(capture.views)
        views = [masked[k] for k in np.linspace(0, len(masked) - 1, min(len(masked), 4)).astype(int)]
        masks = tuple(_coarse_mask(view) for view in views if view.mask is not None)
        return cls(views=tuple(views), masks=masks)

    def overlap(self, points: Float[np.ndarray, "P 3"]) -> float:
        """How well points fill the masks and only them: the geometric mean of the share of points inside and of the
        share of cells covered, in the median over the views. Without masks the share of points in the images."""
        overlaps = []
        for number, view in enumerate(self.views):
            column, row = _in_image(view, points)
            if not self.masks:
                overlaps.append(len(row) / len(points))
                continue
            mask = self.masks[number]
            covered = np.zeros_like(mask)
            covered[row, column] = True
            within = mask[row, column].sum() / len(points)
            overlaps.append(float(np.sqrt(within * (covered & mask).sum() / max(mask.sum(), 1))))
        return float(np.median(overlaps))

    def best(self, points: Float[np.ndarray, "P 3"], frames: Sequence[_Frame]) -> tuple[float, _Frame] | None:
        """The first frame among those in which points of a file fit about best, and their overlap in it."""
        points = points[:: -(-len(points) // _FEW_SAMPLES)]
        overlaps = np.array([self.overlap(frame.to_world(points)) for frame in frames])
        if not len(overlaps):
            return None
        first = int(np.flatnonzero(overlaps >= 0.97 * overlaps.max())[0])
        return float(overlaps[first]), frames[first]


def _in_image(view: View, points: Float[np.ndarray, "P 3"]) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Coarse columns and rows of the points that project into a view's image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, depth = view.camera.project(points)
    cells = xy / [view.camera.width_px, view.camera.height_px]
    inside = (depth > 0) & (cells >= 0).all(1) & (cells < 1).all(1)
    column, row = (_GRID * cells[inside]).astype(np.int64).T
    return column, row


def _coarse_mask(view: View) -> np.ndarray:
    assert view.mask is not None
    mask = pixels.read_mask(view.mask, view.camera)
    height, width = mask.shape
    rows, columns = np.nonzero(mask >= 128)
    coarse = np.zeros((_GRID, _GRID), bool)
    coarse[rows * _GRID // height, columns * _GRID // width] = True
    return coarse


def scan_warnings(capture: Capture, scan: Scan, landmarks: Float[np.ndarray, "L 3"]) -> list[str]:
    """What may be wrong with a scan that `require_frame` accepts, one line each; empty if nothing is.

    Args:
        capture: whose cameras see the scan.
        scan: of the capture.
        landmarks: triangulated, metres; NaN where not.
    """
    warnings = _contents(scan)
    if pieces := _floating(scan.vertices):
        warnings.append(pieces)
    points = _valid(landmarks)
    if len(points) < MIN_LANDMARKS:
        warnings += _turned(capture, scan)
    elif (frame := _better_frame(scan, points, distance := _landmark_distance(scan, points))) is not None:
        warnings.append(f"the scan fits the landmarks better if it is {frame}; compare it with the images")
    elif distance > MAX_DISTANCE_M:
        warnings.append(f"the scan is {MM_PER_M * distance:.0f} mm from the landmarks; check its frame and unit")
    if len(scan.triangles):
        warnings += _winding(capture, scan)
    return warnings


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
    return (
        f"{count[piece != main].sum()} vertices of the scan, in {number}, float up to {_length(away)} away from the "
        "rest: remove what is no skin"
    )


def _landmark_distance(scan: Scan, points: Float[np.ndarray, "L 3"]) -> float:
    """The median distance (m) of landmarks from a scan, of its faces from those around the nearest vertices."""
    tree = _tree(scan.vertices)
    distance, nearest = tree.query(points, k=min(_NEAR, len(scan.vertices)))
    if not len(scan.triangles):
        return float(np.median(distance[:, 0]))
    near = np.zeros(len(scan.vertices), bool)
    near[nearest] = True
    faces = scan.triangles[near[scan.triangles].any(1)]
    return float(np.median(closest_points(points, scan.vertices, faces)[0]))


def _better_frame(scan: Scan, points: Float[np.ndarray, "L 3"], distance: float) -> _Frame | None:
    """The axes with which a scan fits landmarks clearly better than with its own, at `distance` (m); None: none."""
    frames = [frame for frame in _frames() if frame.unit == 1 and not frame.plain]
    tree = _tree(scan.vertices)
    medians = [float(np.median(tree.query(frame.to_file(points))[0])) for frame in frames]
    frame = frames[int(np.argmin(medians))]
    turned = _landmark_distance(scan, frame.to_file(points))
    fits = turned <= MAX_DISTANCE_M / 2 and 2 * turned < distance and distance - turned > _CLEARLY_M
    return frame if fits else None


def _turned(capture: Capture, scan: Scan) -> list[str]:
    """A line if the scan's silhouette fits the masks better with other axes."""
    views, frames = _Silhouettes.of(capture), [frame for frame in _frames() if frame.unit == 1]
    if not views.masks:
        return []
    sample = scan.vertices[:: -(-len(scan.vertices) // _FEW_SAMPLES)]
    best = views.best(sample, frames)
    if best is None or best[1].plain or best[0] < _CLEARLY * views.overlap(sample):
        return []
    return [f"the scan's silhouette fits the masks better if it is {best[1]}; compare it with the images"]


def _winding(capture: Capture, scan: Scan) -> list[str]:
    """Lines about faces that show the cameras their back."""
    rng = np.random.default_rng(0)
    chosen = scan.triangles[rng.permutation(len(scan.triangles))[:_MAX_SAMPLES]]
    a, b, c = (scan.vertices[chosen[:, k]] for k in range(3))
    normal, centre = np.cross(b - a, c - a), (a + b + c) / 3
    caster, outside, inside = RayCaster(scan.vertices, scan.triangles), 0.0, 0.0
    for k in np.linspace(0, len(capture.views) - 1, min(len(capture.views), 6)).astype(int):
        camera = capture.views[k].camera
        area = (normal * (camera.centre - centre)).sum(1)[caster.visible(centre, camera)]
        outside, inside = outside + area[area > 0].sum(), inside - area[area < 0].sum()
    lines = []
    if inside > outside:
        lines.append(
            "the scan's faces point inwards: it is inside out or mirrored; distances are measured all the same, but "
            "compare it with the images"
        )
    if twice := directed_edges_used_twice(scan.triangles):
        lines.append(f"the scan's faces are wound in both directions: neighbours disagree at {twice} edges")
    return lines


def _tree(vertices: Float[np.ndarray, "V 3"]) -> cKDTree:
    return cKDTree(vertices, balanced_tree=False, compact_nodes=False)  # it is built for few queries


def _valid(landmarks: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "P 3"]:
    return landmarks[np.isfinite(landmarks).all(-1)]


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{MM_PER_M * metres:.3g} mm"


def surface_landmarks(capture: Capture) -> Float[np.ndarray, "L 3"]:
    """Triangulate the landmarks (metres; NaN where not) that locate a capture's head: of scheme 68 if there are enough,
    else of the scheme with the most; no points without landmarks."""
    names = sorted({name for view in capture.views for name in view.landmarks}, key=lambda name: name != "68")
    best = np.zeros((0, 3))
    for name in names:
        points = triangulate(capture, name)[0]
        if len(_valid(points)) > len(_valid(best)):
            best = points
        if len(_valid(best)) >= MIN_LANDMARKS:
            break
    return best
