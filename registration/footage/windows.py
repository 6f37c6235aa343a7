"""Long sequences: identity and camera from frames spread over all, then overlapping windows with both known."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from registration.landmark_fit.fit import fit_landmarks
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.result import LandmarkFit
from registration.model.gnm_npz import GNMData

LONGEST = 600  # frames that are solved at once
SPREAD = 200  # frames for identity and camera
WINDOW, OVERLAP = 300, 30  # frames of a window, and how many its neighbours share with it


def fit_long(
    observations: Observations,
    data: GNMData,
    options: FitOptions,
    *,
    longest: int = LONGEST,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> LandmarkFit:
    """Fit a sequence of any length, as `fit_landmarks` for at most `longest` frames.

    Identity, focal length, principal point and distortion of a longer one are those of `SPREAD` frames, evenly chosen;
    their uncertainties, too. Where windows overlap, each frame is of the window whose end is farther.

    Args:
        observations: of one subject and one view with an unknown pose.
        data: the model.
        options: of the fit.
        longest: number of frames.
        report: receives the number of solved windows, and of all.
    """
    count = len(observations.points_px)
    if count <= longest:
        return fit_landmarks(observations, data, options)
    chosen = np.unique(np.linspace(0, count - 1, min(SPREAD, longest)).round().astype(int))
    first = fit_landmarks(observations.frames(chosen), data, replace(options, temporal=None))
    known = replace(options, identity=first.identity, principal_point=False, distortion=False, covariance=True)
    calibrated = _calibrated(observations, first)
    parts, kept = [], []
    spans = list(windows(count, min(WINDOW, longest), min(OVERLAP, longest // 4)))
    for done, (span, own) in enumerate(spans):
        parts.append(fit_landmarks(calibrated.frames(np.arange(count)[span]), data, known))
        kept.append(own)
        report(done + 1, len(spans))
    return _stitched(first, parts, kept, options)


def windows(count: int, length: int, overlap: int) -> Iterator[tuple[slice, slice]]:
    """Yield the frames of each window, and which of the window's own frames are kept."""
    step = length - overlap
    starts = list(range(0, max(1, count - overlap), step))
    for k, start in enumerate(starts):
        end = min(start + length, count)
        first = 0 if k == 0 else overlap // 2
        last = end - start if k == len(starts) - 1 else step + overlap // 2
        yield slice(start, end), slice(first, last)


def _calibrated(observations: Observations, fit: LandmarkFit) -> Observations:
    """With the fit's camera as a known one, and points without its distortion."""
    (camera,), (view,) = fit.cameras, observations.views
    K = camera.intrinsics
    known = replace(view, focal_px=float(K[0, 0]), principal_px=(float(K[0, 2]), float(K[1, 2])))
    points = observations.points_px
    if camera.distortion:
        flat = points.reshape(-1, 1, 2)
        seen = np.isfinite(flat).all((1, 2))
        plain: Float[np.ndarray, P] = np.full(flat.shape, np.nan)
        plain[seen] = cv2.undistortPoints(flat[seen], K, np.array(camera.distortion), P=K)
        points = plain.reshape(points.shape)
    return Observations(scheme=observations.scheme, views=(known,), points_px=points, sigma_px=observations.sigma_px)


def _stitched(first: LandmarkFit, parts: list[LandmarkFit], kept: list[slice], options: FitOptions) -> LandmarkFit:
    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name)[own] for part, own in zip(parts, kept, strict=True)])

    worst = max(parts, key=lambda part: ("converged", "stopped", "failed").index(part.status))
    return replace(
        first,
        status=worst.status,
        reason=f"{worst.reason}; {len(parts)} windows" + ("" if worst.status == "converged" else ", the worst one"),
        scale=first.scale,
        expression=joined("expression"),
        rotations=joined("rotations"),
        translation=joined("translation"),
        residual_px=joined("residual_px"),
        weights=joined("weights"),
        expression_sigma=joined("expression_sigma"),
        seconds=first.seconds + sum(part.seconds for part in parts),
        iterations=first.iterations + sum(part.iterations for part in parts),
        energy=sum(part.energy for part in parts),
        options=options,
    )
