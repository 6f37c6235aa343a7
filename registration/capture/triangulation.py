"""Triangulate landmarks over the views of a capture, robust to outliers and to miscalibrated views."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.capture.origin import capture_origin
from registration.capture.pixels import undistort_landmarks, undistorted_spread
from registration.model import jaw_order
from registration.types import Camera, Capture, View

MIN_CONFIDENCE = 0.5  # a 2D landmark is used above it
MAX_PAIRS = 400  # of views that propose a point; 29 views have 406
MAX_ERRORS = 1_000_000  # of proposals in views that are computed at once, 24 bytes each in the largest array
MAX_RESIDUAL = 0.01  # of an inlier, as a fraction of the image's geometric mean side
MAX_DEVIATION = 3.5  # of an inlier, as a multiple of its spread, where that is stated
MIN_ANGLE = np.radians(0.5)  # between the widest two rays; below it depth is not determined


def triangulate(
    capture: Capture, scheme: str
) -> tuple[Float[np.ndarray, "L 3"], Int[np.ndarray, "L"], Float[np.ndarray, "L"]]:
    """Triangulate every landmark of a scheme.

    Each pair of views proposes a point (linear DLT in normalized coordinates, Hartley and Zisserman 2004, section
    12.2). The proposal with the smallest truncated reprojection error over all views is refined over its inliers,
    reweighted from algebraic to reprojection error. An outlier in one view therefore costs that view only.

    Args:
        capture: its landmarks are used where their confidence is above `MIN_CONFIDENCE`. Where the views state the
            spread of the scheme's landmarks, they count by it, and what deviates by more than `MAX_DEVIATION` of it is
            an outlier.
        scheme: name of the landmark scheme.

    Returns:
        points: metres, world; NaN where fewer than two views agree. L = 0 if no view has the scheme.
        used: number of inlier views of each point.
        residuals: root-mean-square reprojection error over the inlier views, px of the full images; NaN as the points.
    """
    views = [view for view in capture.views if scheme in view.landmarks]
    if not views:
        return np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0)
    pixels = np.stack([undistort_landmarks(view, scheme) for view in views])  # N L 3
    stated = all(scheme in view.landmark_spread_px for view in views)
    spread_px = np.stack([view.landmark_spread_px[scheme] for view in views]) if stated else None
    return triangulate_pixels([view.camera for view in views], pixels, spread_px)


def triangulate_pixels(
    cameras: Sequence[Camera],
    pixels: Float[np.ndarray, "N L 3"],
    spread_px: Float[np.ndarray, "N L"] | None = None,
    *,
    max_pairs: int = MAX_PAIRS,
) -> tuple[Float[np.ndarray, "L 3"], Int[np.ndarray, "L"], Float[np.ndarray, "L"]]:
    """Triangulate landmarks of undistorted images, as `triangulate`.

    Args:
        cameras: of the views; their distortion is ignored.
        pixels: x_px, y_px, confidence.
        spread_px: standard deviation along each axis; None: that of all is alike.
        max_pairs: of views that propose a point.

    Returns:
        As `triangulate`.
    """
    observed = (pixels[..., 2] > MIN_CONFIDENCE) & np.isfinite(pixels).all(-1)
    rays = np.stack([_normalized(c.intrinsics, xy) for c, xy in zip(cameras, pixels[..., :2], strict=True)])
    origin = capture_origin(cameras)
    poses = np.stack([camera.relative_to(origin).T_cam_world[:3] for camera in cameras])
    focals = np.array([[camera.intrinsics[0, 0], camera.intrinsics[1, 1]] for camera in cameras])
    limits = np.repeat([[inlier_limit_px(camera)] for camera in cameras], pixels.shape[1], 1)
    if spread_px is not None:
        limits = MAX_DEVIATION * spread_px

    count = pixels.shape[1]
    points, used, residuals = np.full((count, 3), np.nan), np.zeros(count, np.int64), np.full(count, np.nan)
    for landmarks, index in _batches(observed, max_pairs):
        at = (index, landmarks[:, None])
        of_views = _Observations(rays=rays[at], poses=poses[index], focals=focals[index], limits=limits[at])
        points[landmarks], inliers, residuals[landmarks] = _solve(of_views, max_pairs, weighted=spread_px is not None)
        used[landmarks] = inliers.sum(-1)
    return points + origin, used, residuals


def _batches(
    observed: Bool[np.ndarray, "N L"], max_pairs: int
) -> Iterator[tuple[Int[np.ndarray, "B"], Int[np.ndarray, "B V"]]]:
    """Landmarks that equally many views see, and those views; as many at once as memory holds easily."""
    views = observed.sum(0)
    for number in map(int, np.unique(views[views >= 2])):
        alike = np.flatnonzero(views == number)
        size = max(1, MAX_ERRORS // (min(max_pairs, number * (number - 1) // 2) * number))
        for start in range(0, len(alike), size):
            landmarks = alike[start : start + size]
            yield landmarks, np.nonzero(observed[:, landmarks].T)[1].reshape(-1, number)


def covariances(capture: Capture, scheme: str, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3 3"]:
    """Return the covariance of every triangulated landmark by the spread of its detections.

    The inverse of the sum over the inlier views of J^T J / spread^2, where J is the projection's derivative. Detections
    that disagree by more than their spread allows enlarge it by their reduced chi-square, since their errors have a
    common cause.

    Args:
        capture: whose landmarks were triangulated.
        scheme: name of the landmark scheme; its spread is known in at least one view.
        points: as `triangulate` returns them.

    Returns:
        Square metres; NaN for points that are NaN.

    Raises:
        ValueError: no view states the spread.
    """
    views = [view for view in capture.views if scheme in view.landmarks]
    spreads_px = _spreads_px(views, scheme)
    if spreads_px is None:
        raise ValueError(f"the spread of the landmarks {scheme} is not known")
    information = np.zeros((len(points), 3, 3))
    chi_square, equations = np.zeros(len(points)), np.zeros(len(points))
    for view, spread_px in zip(views, spreads_px, strict=True):
        distance = residuals(view, scheme, points)
        inlier = np.flatnonzero(distance < MAX_DEVIATION * spread_px)
        J = _projection_derivatives(view.camera, points[inlier]) / spread_px[inlier, None, None]
        information[inlier] += J.transpose(0, 2, 1) @ J
        chi_square[inlier] += (distance[inlier] / spread_px[inlier]) ** 2
        equations[inlier] += 2
    result = np.full((len(points), 3, 3), np.nan)
    solved = np.flatnonzero(np.isfinite(points).all(-1) & (equations >= 4))
    excess = np.maximum(1, chi_square[solved] / (equations[solved] - 3))
    result[solved] = np.linalg.inv(information[solved]) * excess[:, None, None]
    return result


def spreads_m(capture: Capture, landmarks: Mapping[str, Float[np.ndarray, "L 3"]]) -> dict[str, Float[np.ndarray, "L"]]:
    """Return the standard deviation of triangulated landmarks along each axis.

    Args:
        capture: whose landmarks were triangulated.
        landmarks: scheme -> points, as `triangulate` returns them.

    Returns:
        Scheme -> standard deviations, metres; of schemes whose spread some view states.
    """
    stated = {name for view in capture.views for name in view.landmark_spread_px}
    return {
        name: np.sqrt(np.trace(covariances(capture, name, points), axis1=1, axis2=2) / 3)
        for name, points in landmarks.items()
        if name in stated
    }


def _projection_derivatives(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2 3"]:
    """Derivatives of pixels by world points (m), without distortion."""
    pixels, depth = camera.project(points)
    M = camera.intrinsics @ camera.T_cam_world[:3, :3]
    return (M[None, :2] - pixels[:, :, None] * M[None, 2:]) / depth[:, None, None]


def _spreads_px(views: Sequence[View], scheme: str) -> Float[np.ndarray, "N L"] | None:
    """Spread of the landmarks in undistorted images; a view that does not state it has the others' median."""
    known = [undistorted_spread(view, scheme) for view in views if scheme in view.landmark_spread_px]
    if not known:
        return None
    typical = np.median(known, axis=0)
    rows = iter(known)
    return np.stack([next(rows) if scheme in view.landmark_spread_px else typical for view in views])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observations:
    """Landmarks, each in the views that see it."""

    rays: Float[np.ndarray, "L N 2"]
    poses: Float[np.ndarray, "L N 3 4"]
    focals: Float[np.ndarray, "L N 2"]
    limits: Float[np.ndarray, "L N"]  # px, of an inlier's error


def _normalized(intrinsics: Float[np.ndarray, "3 3"], xy: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
    """Project pixels onto the plane z = 1 of the camera."""
    homogeneous = np.concatenate([xy, np.ones((len(xy), 1))], -1)
    return (homogeneous @ np.linalg.inv(intrinsics).T)[:, :2]


def _solve(
    of_views: _Observations, max_pairs: int, *, weighted: bool
) -> tuple[Float[np.ndarray, "L 3"], Bool[np.ndarray, "L N"], Float[np.ndarray, "L"]]:
    """Solve each landmark: best pair, then its inliers together; `weighted`: a view counts by its limit.

    Returns the points, their inliers and rms errors (px); NaN and no inliers where no two views agree or their rays are
    parallel.
    """
    rays, poses, focals, limits = of_views.rays, of_views.poses, of_views.focals, of_views.limits
    rows = rays[..., None] * poses[:, :, 2:3] - poses[:, :, :2]  # L N 2 4: the two DLT equations of a view
    pairs = np.array(list(combinations(range(rays.shape[1]), 2)))
    if len(pairs) > max_pairs:
        pairs = pairs[np.linspace(0, len(pairs) - 1, max_pairs).astype(int)]
    proposals = _null_points(rows[:, pairs].reshape(len(rays), len(pairs), 4, 4))
    errors = _errors(proposals, of_views)  # L P N, px
    best = np.arange(len(rays)), np.minimum(errors / limits[:, None], 1.0).sum(-1).argmin(-1)
    inliers = errors[best] < limits
    point = proposals[best]
    weights = limits.min(-1, keepdims=True) / limits if weighted else np.ones_like(limits)
    for _ in range(3):
        inliers = inliers & (inliers.sum(-1, keepdims=True) >= 2)
        # Algebraic error is depth times reprojection error: dividing by the last depth leaves the latter.
        depth = (poses[:, :, 2, :3] @ point[:, :, None])[..., 0] + poses[:, :, 2, 3]
        scale = np.where(inliers, weights, 0.0) / np.where(inliers, depth, 1.0)
        point = _null_points((rows * (scale[..., None] * focals)[..., None]).reshape(len(rays), 1, -1, 4))[:, 0]
        error = _errors(point[:, None], of_views)[:, 0]
        inliers = (error < limits) & inliers.any(-1, keepdims=True)
    solved = (inliers.sum(-1) >= 2) & (_widest_angles(point, poses, inliers) >= MIN_ANGLE)
    inliers &= solved[:, None]
    squares = np.where(inliers, error, 0.0) ** 2
    rms = np.sqrt(squares.sum(-1) / np.where(solved, inliers.sum(-1), np.nan))
    return np.where(solved[:, None], point, np.nan), inliers, rms


def _null_points(systems: Float[np.ndarray, "L P R 4"]) -> Float[np.ndarray, "L P 3"]:
    """Return the point that each homogeneous system maps closest to zero; very far away for points at infinity."""
    solution = np.linalg.svd(systems, full_matrices=False)[2][..., -1, :]
    scale = np.where(np.abs(solution[..., 3:]) < 1e-12, 1e-12, solution[..., 3:])
    return solution[..., :3] / scale


def _errors(points: Float[np.ndarray, "L P 3"], of_views: _Observations) -> Float[np.ndarray, "L P N"]:
    """Return reprojection errors of each landmark's points in px; infinite behind a camera."""
    poses = of_views.poses[:, None]
    local = (poses[..., :3] @ points[:, :, None, :, None])[..., 0] + poses[..., 3]  # L P N 3
    depth = local[..., 2]
    front = depth > 1e-9
    image = local[..., :2] / np.where(front, depth, 1.0)[..., None]
    distance = np.linalg.norm((image - of_views.rays[:, None]) * of_views.focals[:, None], axis=-1)
    return np.where(front, distance, np.inf)


def _widest_angles(
    points: Float[np.ndarray, "L 3"], poses: Float[np.ndarray, "L N 3 4"], inliers: Bool[np.ndarray, "L N"]
) -> Float[np.ndarray, "L"]:
    """Return the largest angle (rad) between the rays of two inlier cameras to each point; 0 without any."""
    centres = -np.einsum("lnji,lnj->lni", poses[..., :3], poses[..., 3])
    rays = points[:, None] - centres
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cosines = np.where(inliers[:, :, None] & inliers[:, None], rays @ rays.transpose(0, 2, 1), 1.0)
    return np.arccos(np.clip(cosines.min((1, 2)), -1.0, 1.0))


def residuals(view: View, scheme: str, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L"]:
    """Return the distances (px, full image) of a view's landmarks from projected points (m, world).

    NaN where a landmark is not used or a point is NaN, infinite where the point is behind the camera.
    """
    landmarks = undistort_landmarks(view, scheme)
    projected, depth = view.camera.project(points)
    distance = np.linalg.norm(projected - landmarks[:, :2], axis=-1)
    distance = np.where(depth > 0, distance, np.where(np.isfinite(depth), np.inf, np.nan))
    return np.where(landmarks[:, 2] > MIN_CONFIDENCE, distance, np.nan)


def inlier_limit_px(camera: Camera) -> float:
    """Return the reprojection error (px) above which a landmark is an outlier."""
    return MAX_RESIDUAL * float(np.sqrt(camera.width_px * camera.height_px))


def reversed_jaw_points(points: Float[np.ndarray, "68 3"]) -> list[int]:
    """Find the jaw points (0 to 16 of the 68 scheme) whose order around the face is reversed.

    From the front, the jaw runs from the subject's right ear (0) over the chin (8) to the left ear (16): the angle
    around the point between the brows increases. The order of Google's first file (`registration.model.jaw_order`) is
    no error: it is read in the scheme's.

    Args:
        points: triangulated landmarks, metres; NaN points are skipped.

    Returns:
        Indices of the points at steps of less than -2 degrees; empty if eyes or nose are missing.
    """
    if jaw_order.is_reversed(points):
        points = points[jaw_order.TURNED]
    right, left, brow, nose = points[36], points[45], points[27], points[33]
    x = left - right
    down = nose - brow
    x = x / np.linalg.norm(x)
    down = down - (down @ x) * x
    down = down / np.linalg.norm(down)
    if not np.isfinite([x, down]).all():
        return []
    valid = np.flatnonzero(np.isfinite(points[:17]).all(-1))
    local = points[valid] - brow
    angles = np.unwrap(np.arctan2(local @ down, -(local @ x)))  # 0 at the subject's right, a quarter turn at the chin
    back = np.flatnonzero(np.diff(angles) < -np.radians(2.0))
    return sorted({int(valid[i]) for step in back for i in (step, step + 1)})
