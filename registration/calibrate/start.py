"""The start of a calibration: views that show a face are posed by the mean head."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.calibrate.bundle import Adjusted, Observations, Priors, Rig, adjust
from registration.calibrate.metric import DEFAULT_SPREAD_M
from registration.calibrate.structure import pose
from registration.detect.provider import Face

FOCAL_RATIO = 2.0  # focal length over the longer side to start from, where nothing is known: a portrait lens
EXIF_SIGMA = 0.1  # of a focal length by EXIF: rounding, crops, focusing; of its logarithm
UNKNOWN_SIGMA = 0.7  # of a focal length about which nothing is known
_PERSON_M = 5e-3  # standard deviation of a person's landmarks from the mean head's
_WRONG_VIEW = 4.0  # times the median over views: a view whose landmarks fit so badly shows no face, or another one


@dataclass(frozen=True, kw_only=True, eq=False)
class Focals:
    """What is known of the focal lengths of the G groups."""

    px: Float[np.ndarray, "G"]  # NaN: unknown
    sigma: Float[np.ndarray, "G"]  # of the logarithm; 0: known exactly
    side_px: Float[np.ndarray, "G"]  # longer side of the groups' images
    deviation_sigma: float  # of single views from their group's
    names: tuple[str, ...] = ()  # of the groups
    sources: tuple[str, ...] = ()  # of what is known: given, EXIF, unknown

    @property
    def start_px(self) -> Float[np.ndarray, "G"]:
        """Focal lengths to start from."""
        return np.where(np.isfinite(self.px), self.px, FOCAL_RATIO * self.side_px)

    @property
    def prior_sigma(self) -> Float[np.ndarray, "G"]:
        """Standard deviations of their logarithms, before the images were seen."""
        return np.where(np.isfinite(self.px), self.sigma, UNKNOWN_SIGMA)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Posed views in the model's frame."""

    rig: Rig  # of all N views; those that are not posed stand at the origin
    posed: Bool[np.ndarray, "N"]
    points: Float[np.ndarray, "L 3"]  # landmarks, metres, model frame
    wrong: tuple[int, ...]  # views whose face does not fit the others'


def landmark_observations(faces: Sequence[Face | None]) -> Observations:
    """Return the observations of the landmarks of all faces; one entry per view, None where there is no face."""
    view, point, xy, sigma = [], [], [], []
    for number, face in enumerate(faces):
        if face is None:
            continue
        seen = np.flatnonzero((face.confidence > 0) & np.isfinite(face.points).all(1))
        view.append(np.full(len(seen), number))
        point.append(seen)
        xy.append(face.points[seen])
        sigma.append(face.spread_px[seen])
    if not view:
        none = np.zeros(0, np.int64)
        return Observations(view=none, point=none, xy_px=np.zeros((0, 2)), sigma_px=np.zeros(0))
    return Observations(
        view=np.concatenate(view),
        point=np.concatenate(point),
        xy_px=np.concatenate(xy).astype(np.float64),
        sigma_px=np.maximum(np.concatenate(sigma).astype(np.float64), 0.1),
    )


def start_from_faces(
    landmarks: Observations,
    mean: Float[np.ndarray, "L 3"],
    spread_m: Float[np.ndarray, "L"] | None,
    centres_px: Float[np.ndarray, "N 2"],
    group: Int[np.ndarray, "N"],
    focals: Focals,
) -> Start:
    """Pose the views that show a face: by resection of the mean head, then together, its points held loosely.

    Focal lengths stay at what is known or usual. Detected landmarks do not tell them: their errors change with the
    view in the way of a shorter focal length (of 2.6 times the longer side, 1.0 times fitted them best).

    Args:
        landmarks: of the views that show a face.
        mean: the mean head's landmarks, metres, model frame.
        spread_m: of the map of the landmarks; None: unknown.
        centres_px: principal points of all views.
        group: of all views.
        focals: what is known of the groups' focal lengths.
    """
    spread = np.full(len(mean), DEFAULT_SPREAD_M) if spread_m is None else spread_m
    priors = Priors(
        points=mean,
        point_sigma_m=np.hypot(spread, _PERSON_M),
        focals_px=focals.start_px,
        focal_sigma=np.zeros(len(focals.px)),
    )
    rig, posed = _resected(landmarks, mean, centres_px, group, focals.start_px)
    wrong: list[int] = []
    while True:
        seen = landmarks.where(posed[landmarks.view])
        result = adjust(rig, mean, seen, priors, max_iterations=20)
        misfit = _misfit(result, seen, posed)
        if posed.sum() <= 3 or not np.nanmax(misfit) > _WRONG_VIEW * np.nanmedian(misfit):
            return Start(rig=result.rig, posed=posed, points=result.points, wrong=tuple(wrong))
        wrong.append(int(np.nanargmax(misfit)))
        posed = posed & (np.arange(len(posed)) != wrong[-1])


def _resected(
    landmarks: Observations, mean: np.ndarray, centres_px: np.ndarray, group: np.ndarray, focals_px: np.ndarray
) -> tuple[Rig, np.ndarray]:
    count = len(group)
    rotations, translations, posed = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count, bool)
    for view in np.unique(landmarks.view):
        of_view = landmarks.where(landmarks.view == view)
        focal, (cx, cy) = focals_px[group[view]], centres_px[view]
        K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
        found = pose(mean[of_view.point], of_view.xy_px, K)
        if found is not None:
            rotations[view], translations[view], posed[view] = *found, True
    rig = Rig(
        rotations=rotations,
        translations=translations,
        centres_px=centres_px,
        group=group,
        focals_px=focals_px.astype(np.float64),
        k1=np.zeros(len(focals_px)),
        deviation=np.zeros(count),
    )
    return rig, posed


def _misfit(result: Adjusted, seen: Observations, posed: np.ndarray) -> np.ndarray:
    """The median residual of each view, in standard deviations; NaN without one."""
    length = np.linalg.norm(np.nan_to_num(result.residuals_px, nan=1e3), axis=1) / seen.sigma_px
    misfit = np.full(len(posed), np.nan)
    for view in np.flatnonzero(posed):
        if (of_view := seen.view == view).any():
            misfit[view] = np.median(length[of_view])
    return misfit


def with_pose(rig: Rig, view: int, rotation: np.ndarray, translation: np.ndarray) -> Rig:
    """The rig with one view's pose replaced."""
    rotations, translations = rig.rotations.copy(), rig.translations.copy()
    rotations[view], translations[view] = rotation, translation
    return replace(rig, rotations=rotations, translations=translations)


def angles(rig: Rig, view: int) -> Float[np.ndarray, "N"]:
    """Return the angles between the directions from the world's origin, the head, to one camera and to all, rad."""
    directions = rig.positions / np.maximum(np.linalg.norm(rig.positions, axis=1, keepdims=True), 1e-9)
    return np.arccos(np.clip(directions @ directions[view], -1, 1))
