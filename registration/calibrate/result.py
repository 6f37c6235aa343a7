"""The result of a calibration: cameras, how sure they are, and how well they agree with the photographs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from registration.calibrate.assembly import Assembled
from registration.calibrate.features import MIN_MATCHES
from registration.calibrate.lengths import Size
from registration.calibrate.photographs import Photograph
from registration.calibrate.start import Focals
from registration.frames import MM_PER_M
from registration.types import Camera

_UNSURE_FOCAL = 0.05  # relative standard deviation of a focal length, above which the user is told


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibratedView:
    """One calibrated photograph, and how well it agrees with the others."""

    photograph: Photograph
    camera: Camera
    group: str
    focal_sigma_px: float  # standard deviation of its focal length
    tracks: int  # points of features that it shows
    tracks_rms_px: float  # of their residuals along both axes together; NaN without any
    landmarks: int
    landmarks_rms_px: float
    observed_px: Float[np.ndarray, "M 2"]  # of the tracks, then of the landmarks
    residual_px: Float[np.ndarray, "M 2"]  # projected less observed
    is_track: Bool[np.ndarray, "M"]


@dataclass(frozen=True, kw_only=True)
class FocalGroup:
    """Photographs that share a focal length."""

    name: str
    views: tuple[str, ...]
    start_px: float  # by the user, EXIF, or a guess
    source: str  # of the start
    focal_px: float
    sigma_px: float
    k1: float
    k1_sigma: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Cameras in the frame of the head model (+Y up, +Z out of the face, +X the subject's left), metres.

    The head has `size.head_scale` times the size of the model fitted to the landmarks.
    """

    root: Path  # of the photographs
    views: tuple[CalibratedView, ...]
    groups: tuple[FocalGroup, ...]
    left_out: Mapping[str, str]  # photograph -> reason
    points: Float[np.ndarray, "P 3"]  # of the tracks
    landmarks: Float[np.ndarray, "L 3"]  # NaN where fewer than two views show it
    scheme: str
    size: Size  # how metres were found
    landmark_distance_mm: float  # median, from the fitted head model
    notes: tuple[str, ...]

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras by the names of the views."""
        return {view.photograph.name: view.camera for view in self.views}


def collect(
    root: Path,
    photographs: Sequence[Photograph],
    *,
    focals: Focals,
    assembled: Assembled,
    left_out: Mapping[str, str],
    size: Size,
    notes: Sequence[str],
    scheme: str,
) -> Calibration:
    """Return the calibration of assembled views.

    Args:
        root: of the photographs.
        photographs: of all views that were tried.
        focals: what was known of the focal lengths.
        assembled: the posed views.
        left_out: photograph -> why it has no camera.
        size: how metres were found.
        notes: of what was seen before.
        scheme: of the landmarks.
    """
    rig, count = assembled.adjusted.rig, assembled.landmark_count
    views = tuple(
        _view(assembled, view, photographs[view], focals.names) for view in np.flatnonzero(assembled.posed).tolist()
    )
    groups = []
    for number, name in enumerate(focals.names):
        members = tuple(view.photograph.name for view in views if view.group == name)
        if members:
            groups.append(
                FocalGroup(
                    name=name,
                    views=members,
                    start_px=float(focals.start_px[number]),
                    source=focals.sources[number],
                    focal_px=float(rig.focals_px[number]),
                    sigma_px=float(assembled.adjusted.focal_sigma_px[number]),
                    k1=float(rig.k1[number]),
                    k1_sigma=float(assembled.adjusted.k1_sigma[number]),
                )
            )
    seen = assembled.observations
    used = np.bincount(seen.point, minlength=len(assembled.adjusted.points)) >= 2
    landmarks = np.where(used[:count, None], assembled.adjusted.points[:count], np.nan)
    distance = assembled.model.distance_m
    return Calibration(
        root=root,
        views=views,
        groups=tuple(groups),
        left_out=dict(left_out),
        points=assembled.adjusted.points[count:][used[count:]],
        landmarks=landmarks,
        scheme=scheme,
        size=size,
        landmark_distance_mm=float(np.nanmedian(distance)) * MM_PER_M,
        notes=(*notes, *_remarks(views, groups, assembled)),
    )


def _view(assembled: Assembled, view: int, photograph: Photograph, focal_names: Sequence[str]) -> CalibratedView:
    rig, seen = assembled.adjusted.rig, assembled.observations
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.rotations[view], rig.translations[view]
    group = int(rig.group[view])
    order = np.flatnonzero(seen.view == view)
    order = order[np.argsort(assembled.of_landmarks[order], kind="stable")]
    is_track = ~assembled.of_landmarks[order]
    residual = assembled.adjusted.residuals_px[order]
    squared = (residual**2).sum(1)
    return CalibratedView(
        photograph=photograph,
        camera=photograph.camera(float(rig.view_focals_px[view]), T, float(rig.k1[group])),
        group=focal_names[group],
        focal_sigma_px=float(assembled.adjusted.view_focal_sigma_px[view]),
        tracks=int(is_track.sum()),
        tracks_rms_px=_rms(squared[is_track]),
        landmarks=int((~is_track).sum()),
        landmarks_rms_px=_rms(squared[~is_track]),
        observed_px=seen.xy_px[order],
        residual_px=residual,
        is_track=is_track,
    )


def _rms(squared: np.ndarray) -> float:
    return float(np.sqrt(np.mean(squared))) if len(squared) else float("nan")


def _remarks(views: Sequence[CalibratedView], groups: Sequence[FocalGroup], assembled: Assembled) -> list[str]:
    """What a user should know of the result."""
    remarks = []
    for group in groups:
        if group.sigma_px > _UNSURE_FOCAL * group.focal_px:
            remarks.append(
                f"the focal length of {group.name} is unsure, {group.focal_px:.0f} +- {group.sigma_px:.0f} px: "
                "give it with --focal-px, or add photographs"
            )
    few = [view.photograph.name for view in views if view.tracks < MIN_MATCHES]
    if few:
        remarks.append(
            f"{len(few)} of {len(views)} photographs rest on landmarks alone, which are several pixels off: "
            + ", ".join(few[:5])
        )
    if not assembled.adjusted.converged:
        remarks.append("the adjustment stopped before it converged")
    return remarks


def summary(calibration: Calibration) -> str:
    """Return what a terminal shows: focal lengths, residuals, and what was left out and why."""
    lines = [
        f"{len(calibration.views)} photographs calibrated, {len(calibration.points)} points; "
        f"metric scale +- {100 * calibration.size.sigma:.1f} % by {calibration.size.source}"
    ]
    for group in calibration.groups:
        distortion = f", k1 {group.k1:.3g} +- {group.k1_sigma:.2g}" if group.k1_sigma else ""
        sigma = f" +- {group.sigma_px:.1f}" if group.source != "given" else ", as given"
        lines.append(f"focal length of {group.name} ({len(group.views)}): {group.focal_px:.1f}{sigma} px{distortion}")
    worst = sorted((view for view in calibration.views if view.tracks), key=lambda view: -view.tracks_rms_px)[:3]
    if worst:
        total = _rms(np.concatenate([(view.residual_px[view.is_track] ** 2).sum(1) for view in calibration.views]))
        named = ", ".join(f"{view.photograph.name} {view.tracks_rms_px:.2f}" for view in worst)
        lines.append(f"residual of features {total:.2f} px rms; largest {named}")
    lines += [f"left out: {name}: {reason}" for name, reason in calibration.left_out.items()]
    lines += [f"note: {note}" for note in calibration.notes]
    return "\n".join(lines)
