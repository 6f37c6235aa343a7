"""The unit and the frame of a capture's meshes, from the landmarks or, without them, from masks and cameras.

A mesh in another frame is compared in every unit and with every exchange of the axes: what fits tells the user how to
export it again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from registration.capture import pixels
from registration.capture.scan import Scan, read_scan, read_truth
from registration.capture.triangulation import triangulate
from registration.doctor.findings import refuse
from registration.doctor.fixes import ScanFix
from registration.doctor.mesh_frame import Frame, candidate_frames
from registration.frames import MM_PER_M
from registration.types import Capture, View

MIN_LANDMARKS = 6  # that locate a mesh
MAX_DISTANCE_M = 0.01  # median of the landmarks' distances from a mesh of the skin that they lie on
FAR_M = 0.1  # of all landmarks: the mesh shows something else, or lies elsewhere
GRID = 32  # cells per side of the coarse images in which a scan without landmarks is compared with masks
_MIN_OVERLAP = 0.1  # of a mesh with the masks; a scan of the whole body beside masks of the head has 0.2
_FITS = 0.5
_HEADS_M = (0.1, 3.0)  # sizes of a scan, from a face to a body
MAX_SAMPLES, FEW_SAMPLES = 20_000, 2_000


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
    points = finite_points(landmarks)
    if len(points) >= MIN_LANDMARKS:
        distance, guess = _fit_landmarks(vertices, points)
        if guess is None and distance.min() <= FAR_M:
            return
        expected = "a surface at the landmarks"
        got = f"one {length_text(float(np.median(distance)))} from them in the median"
    else:
        seen, guess = _fit_views(vertices, capture)
        if guess is None and seen:
            return
        expected, got = "a surface that the cameras see where the subject is", "one outside the masks or the images"
    extent = " x ".join(length_text(side) for side in np.ptp(vertices, axis=0))
    raise refuse(
        _kind(title, guess),
        f"The {title} is in another unit or frame than the cameras",
        where=where,
        expected=expected,
        got=f"{got}, {extent} large" + (f"; it fits if it is {guess}" if guess else ""),
        fix="export it in metres in the world of the COLMAP model, or remove it",
        mend=None
        if guess is None
        else ScanFix(what=f"converted the {title} that was {guess}", frame=guess, file=where.name),
    )


def _kind(title: str, guess: Frame | None) -> str:
    """The kind of the finding that a mesh is in another frame."""
    if title != "scan":
        return "ground-truth"
    return "scan-elsewhere" if guess is None else frame_kind(guess)


def frame_kind(frame: Frame) -> str:
    """The kind of the finding that a scan is in this frame."""
    return "scan-unit" if frame.unit != 1 else "scan-mirrored" if frame.mirrored else "scan-axes"


def _fit_landmarks(
    vertices: Float[np.ndarray, "V 3"], points: Float[np.ndarray, "L 3"]
) -> tuple[Float[np.ndarray, "L"], Frame | None]:
    """Distances (m) of landmarks from a mesh as it is; and the frame in which it fits, if it does not and one does."""
    tree = vertex_tree(vertices)
    distance = tree.query(points)[0]
    limit = min(MAX_DISTANCE_M / 2, float(np.median(distance)) / 4)
    if np.median(distance) <= MAX_DISTANCE_M:
        return distance, None
    frames = list(candidate_frames())
    medians = np.array([frame.unit * float(np.median(tree.query(frame.to_file(points))[0])) for frame in frames])
    # A head is nearly symmetric: among frames that fit about equally well the simplest one is meant.
    fitting = np.flatnonzero(medians <= min(limit, 2 * medians.min() + 1.5e-3))
    return distance, frames[fitting[0]] if len(fitting) else None


def _fit_views(vertices: Float[np.ndarray, "V 3"], capture: Capture) -> tuple[bool, Frame | None]:
    """Whether the cameras see a mesh as it is, where the masks are; and the frame in which it fits, if not."""
    sample = vertices[:: -(-len(vertices) // MAX_SAMPLES)]
    views = Silhouettes.of(capture)
    overlap = views.overlap(sample)
    if overlap >= _MIN_OVERLAP:
        return True, None
    frames = list(candidate_frames())
    if not views.masks:  # a mesh that shrinks to a point would fit best
        size = float((np.percentile(sample, 95, axis=0) - np.percentile(sample, 5, axis=0)).max())
        frames = [frame for frame in frames if _HEADS_M[0] <= frame.unit * size <= _HEADS_M[1]]
    guess = views.best(sample, frames)
    if guess is not None and guess[0] >= _FITS:
        return False, guess[1]
    return overlap > 0, None


@dataclass(frozen=True, kw_only=True)
class Silhouettes:
    """Some views of a capture with coarse masks, or without where there are none."""

    views: tuple[View, ...]
    masks: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, capture: Capture) -> "Silhouettes":
        masked = [view for view in capture.views if view.mask is not None] or list(capture.views)
        views = evenly_spaced(masked, 4)
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

    def best(self, points: Float[np.ndarray, "P 3"], frames: Sequence[Frame]) -> tuple[float, Frame] | None:
        """The first frame among those in which points of a file fit about best, and their overlap in it."""
        points = points[:: -(-len(points) // FEW_SAMPLES)]
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
    column, row = (GRID * cells[inside]).astype(np.int64).T
    return column, row


def _coarse_mask(view: View) -> np.ndarray:
    assert view.mask is not None
    mask = pixels.read_mask(view.mask, view.camera)
    height, width = mask.shape
    rows, columns = np.nonzero(mask >= 128)
    coarse = np.zeros((GRID, GRID), bool)
    coarse[rows * GRID // height, columns * GRID // width] = True
    return coarse


def evenly_spaced(views: Sequence[View], count: int) -> list[View]:
    """Some of the views, evenly spaced in their order."""
    return [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), count)).astype(int)]


def vertex_tree(vertices: Float[np.ndarray, "V 3"]) -> cKDTree:
    return cKDTree(vertices, balanced_tree=False, compact_nodes=False)  # it is built for few queries


def finite_points(landmarks: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "P 3"]:
    return landmarks[np.isfinite(landmarks).all(-1)]


def length_text(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{MM_PER_M * metres:.3g} mm"


def surface_landmarks(capture: Capture) -> Float[np.ndarray, "L 3"]:
    """Triangulate the landmarks (metres; NaN where not) that locate a capture's head: of scheme 68 if there are enough,
    else of the scheme with the most; no points without landmarks."""
    names = sorted({name for view in capture.views for name in view.landmarks}, key=lambda name: name != "68")
    best = np.zeros((0, 3))
    for name in names:
        points = triangulate(capture, name)[0]
        if len(finite_points(points)) > len(finite_points(best)):
            best = points
        if len(finite_points(best)) >= MIN_LANDMARKS:
            break
    return best
