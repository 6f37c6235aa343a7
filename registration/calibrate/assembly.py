"""All views posed together: tracks triangulated from posed views, further views resected, everything adjusted."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.calibrate.bundle import Adjusted, Observations, Priors, Rig, adjust
from registration.calibrate.metric import DEFAULT_SPREAD_M, ModelFit
from registration.calibrate.start import Focals, Start, with_pose
from registration.calibrate.structure import robust_pose, triangulate

MIN_RESECTION = 12  # track points that agree on the pose of a further view
_MIN_SHARE = 0.3  # of a further view's track points, that agree
_RESECTION = 0.015  # limit of the reprojection error, as a fraction of the longer side
_FIRST = 0.02  # limit of the reprojection error of tracks between views posed by landmarks alone, as a fraction
_LATER = 0.005
_OUTLIER = 5.0  # standard deviations, after these were estimated
_CORNER = 0.03  # standard deviation of radial distortion in the corners, as a fraction of the distance to the centre
_ALIKE = 10.0  # neighbouring landmarks err alike: so many count as one
_SHORT, _LONG = 15, 80  # iterations of adjustments before the last and of the last


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """What the photographs show: landmarks of faces, and tracks of features."""

    landmarks: Observations  # points 0 to L - 1
    tracks: Observations  # points 0 to T - 1
    track_count: int
    side_px: Float[np.ndarray, "N"]  # longer side of each view's image


@dataclass(frozen=True, kw_only=True, eq=False)
class Assembled:
    """Posed views and points in the model's frame."""

    adjusted: Adjusted  # points: landmarks first, then tracks
    observations: Observations  # that were adjusted
    posed: Bool[np.ndarray, "N"]
    model: ModelFit  # the last one: its landmarks are in the frame of the points
    landmark_count: int  # L

    @property
    def of_landmarks(self) -> Bool[np.ndarray, "M"]:
        """Which observations are landmarks'."""
        return self.observations.point < self.landmark_count


def assemble(
    start: Start,
    evidence: Evidence,
    focals: Focals,
    fit: Callable[[Float[np.ndarray, "L 3"]], ModelFit],
    spread_m: Float[np.ndarray, "L"] | None,
    *,
    distortion: bool = False,
    report: Callable[[str], None] = lambda text: None,
) -> Assembled:
    """Pose as many views as the tracks allow, and adjust everything.

    Args:
        start: views that show a face, posed.
        evidence: of all views.
        focals: what is known of focal lengths.
        fit: fits the head model to landmarks in a world of any unit.
        spread_m: of the map of the landmarks; None: unknown.
        distortion: estimate the radial distortion of each group.
        report: receives a line after each round.
    """
    count = len(start.points)
    spread = np.full(count, DEFAULT_SPREAD_M) if spread_m is None else spread_m
    # Landmarks of few views may be all that determines the cameras; independent errors would overrate them.
    landmarks = replace(evidence.landmarks, sigma_px=evidence.landmarks.sigma_px * np.sqrt(_ALIKE))
    rig, posed, points = start.rig, start.posed.copy(), start.points
    limit, sigma_factor = _FIRST, 1.0
    last = False
    while True:
        model = fit(_seen_points(points[:count], landmarks, posed))
        rig, points = rig.moved(model.scale, model.rotation, model.shift), _moved(points, model)
        tracks = evidence.tracks.where(posed[evidence.tracks.view])
        track_points, good = triangulate(rig, tracks, evidence.track_count, limit * float(evidence.side_px.max()))
        tracks = tracks.where(good[tracks.point])
        priors = Priors(
            points=np.concatenate([model.landmarks, np.zeros_like(track_points)]),
            point_sigma_m=np.concatenate([spread * np.sqrt(_ALIKE), np.full(len(track_points), np.inf)]),
            focals_px=focals.start_px,
            focal_sigma=focals.prior_sigma,
            deviation_sigma=focals.deviation_sigma if last else 0.0,
            k1_sigma=_k1_sigma(rig, evidence) if last and distortion else 0.0,
        )
        seen = _joined(landmarks.where(posed[landmarks.view]), tracks, count, sigma_factor)
        start_points = np.concatenate([points[:count], track_points])
        result, seen, sigma_factor = _adjusted(rig, start_points, seen, priors, count, sigma_factor, last)
        rig, points = result.rig, result.points
        if last:
            model = fit(_seen_points(points[:count], landmarks, posed))
            moved = rig.moved(model.scale, model.rotation, model.shift)
            result = replace(result, rig=moved, points=_moved(points, model))
            return Assembled(adjusted=result, observations=seen, posed=posed, model=model, landmark_count=count)
        added = _resect(rig, points[count:], good, evidence, posed)
        for view, (rotation, translation) in added.items():
            rig = with_pose(rig, view, rotation, translation)
            posed[view] = True
        report(f"{int(posed.sum())} of {len(posed)} views posed, {int(good.sum())} points")
        last = not added and limit == _LATER
        limit = _LATER


def _adjusted(
    rig: Rig, points: np.ndarray, seen: Observations, priors: Priors, count: int, factor: float, last: bool
) -> tuple[Adjusted, Observations, float]:
    """Adjust, estimate how large the tracks' errors are, drop outliers, and adjust again."""
    result = adjust(rig, points, seen, priors, max_iterations=_LONG if last else _SHORT)
    for _ in range(2 if last else 1):
        length = np.linalg.norm(np.nan_to_num(result.residuals_px, nan=1e6), axis=1) / seen.sigma_px
        of_tracks = seen.point >= count
        change = 1.0
        if of_tracks.sum() > 50:
            # The median length of two normal residuals is 1.177 standard deviations.
            change = float(np.clip(np.median(length[of_tracks]) / 1.177, 0.2, 20.0))
        keep = (length < _OUTLIER * np.where(of_tracks, change, 1.0)) | ~of_tracks
        sigma = np.where(of_tracks, change, 1.0) * seen.sigma_px
        seen = _with_two_rays(replace(seen, sigma_px=sigma).where(keep), count)
        factor *= change
        result = adjust(result.rig, result.points, seen, priors, max_iterations=_LONG if last else _SHORT)
    return result, seen, factor


def _k1_sigma(rig: Rig, evidence: Evidence) -> Float[np.ndarray, "G"]:
    """Standard deviations of k1 that mean the same distortion in the corners of images of all focal lengths."""
    side = np.ones(len(rig.focals_px))
    side[rig.group] = evidence.side_px
    return _CORNER / (0.6 * side / rig.focals_px) ** 2


def _with_two_rays(seen: Observations, count: int) -> Observations:
    """Without tracks that one view alone has left."""
    views = np.bincount(seen.point)
    return seen.where((views[seen.point] >= 2) | (seen.point < count))


def _joined(landmarks: Observations, tracks: Observations, count: int, factor: float) -> Observations:
    return Observations(
        view=np.concatenate([landmarks.view, tracks.view]),
        point=np.concatenate([landmarks.point, tracks.point + count]),
        xy_px=np.concatenate([landmarks.xy_px, tracks.xy_px]),
        sigma_px=np.concatenate([landmarks.sigma_px, tracks.sigma_px * factor]),
    )


def _moved(points: np.ndarray, model: ModelFit) -> np.ndarray:
    return model.scale * points @ model.rotation.T + model.shift


def _seen_points(points: np.ndarray, landmarks: Observations, posed: np.ndarray) -> np.ndarray:
    """Landmarks that two posed views show; NaN for the others, which are where the prior had them."""
    views = np.bincount(landmarks.point[posed[landmarks.view]], minlength=len(points))
    return np.where((views >= 2)[:, None], points, np.nan)


def _resect(
    rig: Rig, points: np.ndarray, good: np.ndarray, evidence: Evidence, posed: Bool[np.ndarray, "N"]
) -> dict[int, tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """Poses of further views, by the points that they share with posed ones."""
    added = {}
    for view in np.flatnonzero(~posed):
        seen = evidence.tracks.where((evidence.tracks.view == view) & good[evidence.tracks.point])
        if len(seen) < MIN_RESECTION:
            continue
        focal, (cx, cy) = rig.focals_px[rig.group[view]], rig.centres_px[view]
        K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
        found = robust_pose(points[seen.point], seen.xy_px, K, _RESECTION * float(evidence.side_px[view]))
        if found is not None and len(found[2]) >= max(MIN_RESECTION, _MIN_SHARE * len(seen)):
            added[int(view)] = found[:2]
    return added


def match_pairs(start: Start, max_angle: float) -> list[tuple[int, int]]:
    """Return the pairs of views worth matching: all but posed ones that look at the head from too different sides.

    Args:
        start: the views that are posed.
        max_angle: between the viewing directions, rad.
    """
    directions = start.rig.positions - np.zeros(3)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    posed: Bool[np.ndarray, N] = start.posed
    cosine = directions @ directions.T
    pairs: Int[np.ndarray, "M 2"] = np.argwhere(np.triu(np.ones(cosine.shape, bool), 1))
    return [(int(i), int(j)) for i, j in pairs if not (posed[i] and posed[j] and cosine[i, j] < np.cos(max_angle))]
