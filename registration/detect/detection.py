"""Landmarks of a capture: faces of all views, the person whom they agree on, and what is refused."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from registration.capture.pixels import distort_points
from registration.detect import judgement
from registration.detect.agreement import Agreement, agree, fitting_face, relative_residual, residuals
from registration.detect.capture_landmarks import PLAIN, CaptureLandmarks, ViewDetection
from registration.detect.crops import Crop
from registration.detect.faces import face_size
from registration.detect.landmark_folder import LandmarkFolder
from registration.detect.provider import LandmarkProvider
from registration.detect.views import FaceFinder, ViewFaces, landmark_cache
from registration.progress import NullProgress, Progress
from registration.types import Capture, View

_LABEL = "detecting landmarks"
_MAX_TURN_DEG = 70.0  # of a face away from the camera, up to which a view is searched again
_BATCH = 4  # views that are searched in tiles before it is tried whether they agree
_MAX_SPREAD_FACTOR = 4.0
_OUTLIER = 3.5  # residual, as a multiple of the spread
_OUTLIER_SIZE = 0.015  # and relative to the face's size
_CHI2_MEDIAN = 1.386  # of the squared distance of two normal variables of unit variance


def detect_landmarks(
    capture: Capture,
    provider: LandmarkProvider | LandmarkFolder,
    *,
    progress: Progress | None = None,
    cache: bool = True,
) -> CaptureLandmarks:
    """Detect one person's landmarks in the photographs of a capture.

    Every view is searched upright; where no two views agree, also turned, then in tiles. Views whose faces do not fit
    are searched again where the person's face must be. A view's face counts only if it agrees with the other views.

    Args:
        capture: its images and cameras are used.
        provider: finds faces in images, or reads landmark files.
        progress: receives the number of views that are done.
        cache: keep the faces of every image in the cache folder, and read them from there.

    Returns:
        The landmarks; `outcome` and `warnings` say what is wrong with them. Nothing is written but the cache.

    Raises:
        InputError: an image or a landmark file cannot be read, or the provider's files cannot be had.
    """
    progress = progress or NullProgress()
    if isinstance(provider, LandmarkFolder):
        provider.check(capture)
        views = [provider.faces(view) for view in capture.views]
        return _judged(provider, views, agree(views), {})
    finder = FaceFinder(provider, landmark_cache() if cache else None)
    views = _search(finder.upright, capture.views, progress, _LABEL)
    agreement = agree(views)
    if agreement is None:
        views = _search_missing(finder.turned, views, len(views), progress, "searching turned images")
        agreement = agree(views)
    if agreement is None:
        views = _search_missing(finder.tiled, views, _BATCH, progress, "searching tiles")
        agreement = agree(views)
    if agreement is not None:
        views, agreement = _search_again(finder, views, agreement)
    mirrored = _mirrored(finder, views, agreement)
    return _judged(provider, views, agreement, mirrored)


def _search(
    search: Callable[[View], ViewFaces], views: Sequence[View], progress: Progress, label: str
) -> list[ViewFaces]:
    """Search views in parallel: OpenCV and the decoders release the interpreter."""
    found = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, result in enumerate(pool.map(search, views), 1):
            found.append(result)
            progress.update(done, len(views), label)
    return found


def _search_missing(
    search: Callable[[View], ViewFaces], views: Sequence[ViewFaces], batch: int, progress: Progress, label: str
) -> list[ViewFaces]:
    """Search the views without a face, some at a time until two agree."""
    result = list(views)
    missing = [k for k, view in enumerate(views) if not view.faces]
    for start in range(0, len(missing), batch):
        part = missing[start : start + batch]
        for k, found in zip(part, _search(search, [views[k].view for k in part], progress, label), strict=True):
            result[k] = found
        if agree(result) is not None:
            break
    return result


def _search_again(
    finder: FaceFinder, views: Sequence[ViewFaces], agreement: Agreement
) -> tuple[list[ViewFaces], Agreement]:
    """Search the views that do not agree where the face must be, and take in those that agree then."""
    regions = {
        k: region
        for k, choice in enumerate(agreement.chosen)
        if choice is None and (region := _expected_region(views, agreement, k)) is not None
    }
    if not regions:
        return list(views), agreement
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = dict(
            zip(regions, pool.map(lambda k: finder.in_region(views[k].view, regions[k]), regions), strict=True)
        )
    fitting = {k: view for k, view in found.items() if fitting_face(view, agreement.points) is not None}
    merged = [fitting.get(k, view) for k, view in enumerate(views)]
    again = agree(merged) if fitting else None
    return (merged, again) if again is not None and again.count > agreement.count else (list(views), agreement)


def _expected_region(views: Sequence[ViewFaces], agreement: Agreement, index: int) -> Crop | None:
    """The square of a view where the face must be; None if it is outside or turned away."""
    camera = views[index].camera
    points = agreement.points[np.isfinite(agreement.points[:, 0])]
    xy, depth = camera.project(points)
    centre = np.median(xy, 0)
    if (depth <= 0).any() or not ((centre >= 0) & (centre < [camera.width_px, camera.height_px])).all():
        return None
    if judgement.turned_away_deg(views, agreement, camera) > _MAX_TURN_DEG:
        return None
    return Crop.around(xy, _expected_roll(views, agreement, index), 1.0)


def _expected_roll(views: Sequence[ViewFaces], agreement: Agreement, index: int) -> float:
    """The turn of the face in a view: from two points that lie side by side in the view nearest to it."""
    target = views[index].camera
    members = [k for k, choice in enumerate(agreement.chosen) if choice is not None]
    nearest = min(members, key=lambda k: float(np.linalg.norm(views[k].camera.centre - target.centre)))
    choice = agreement.chosen[nearest]
    assert choice is not None
    face = views[nearest].faces[choice]
    known = np.isfinite(agreement.points[:, 0])
    direction = np.array([np.cos(face.roll), np.sin(face.roll)])
    along = np.where(known, face.points @ direction, np.nan)
    ends = agreement.points[[int(np.nanargmin(along)), int(np.nanargmax(along))]]
    before = np.diff(views[nearest].camera.project(ends)[0], axis=0)[0]
    after = np.diff(target.project(ends)[0], axis=0)[0]
    turn = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
    return float((face.roll + turn + np.pi) % (2 * np.pi) - np.pi)


def _mirrored(finder: FaceFinder, views: Sequence[ViewFaces], agreement: Agreement | None) -> dict[int, ViewFaces]:
    """The views whose mirror images agree with the others, where the images themselves do not."""
    doubted = [k for k, view in enumerate(views) if view.faces and (agreement is None or agreement.chosen[k] is None)]
    if not doubted or sum(bool(view.faces) for view in views) < 2:
        return {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = dict(zip(doubted, pool.map(lambda k: finder.mirrored(views[k].view), doubted), strict=True))
    if agreement is not None:
        return {k: view for k, view in found.items() if fitting_face(view, agreement.points) is not None}
    both = [replace(view, faces=view.faces + found[k].faces) if k in found else view for k, view in enumerate(views)]
    joint = agree(both)
    if joint is None:
        return {}
    return {
        k: found[k] for k, choice in enumerate(joint.chosen) if choice is not None and choice >= len(views[k].faces)
    }


def _judged(
    provider: LandmarkProvider | LandmarkFolder,
    views: Sequence[ViewFaces],
    agreement: Agreement | None,
    mirrored: dict[int, ViewFaces],
) -> CaptureLandmarks:
    """Judge faces: which view is used, what it says, and how sure it is."""
    outcome, reason = judgement.judge(views, agreement, mirrored, provider.scheme)
    sure = agreement if outcome == "found" else None
    if outcome == "one view":
        detections = [_alone(view) for view in views]
    else:
        detections = [_detection(view, k, sure, mirrored, views) for k, view in enumerate(views)]
    told = judgement.warnings(views, detections, sure, mirrored) if outcome in ("found", "one view") else ()
    count = provider.count
    return CaptureLandmarks(
        scheme=provider.scheme,
        version=provider.version,
        outcome=outcome,
        reason=reason,
        views=tuple(detections),
        points=sure.points if sure is not None else np.full((count, 3), np.nan),
        used=sure.used if sure is not None else np.zeros(count, np.int64),
        point_residual_px=sure.residual_px if sure is not None else np.full(count, np.nan),
        hints=judgement.hints(views, detections, sure),
        warnings=tuple(told),
    )


def _alone(view: ViewFaces) -> ViewDetection:
    """The only view with a face: nothing confirms it."""
    if not view.faces:
        return _without(view, "no face found")
    chosen = int(np.argmax([face_size(face) for face in view.faces]))
    note = "the only view with a face: no other confirms it"
    if len(view.faces) > 1:
        note += f"; the largest of {len(view.faces)} faces"
    return _used(view, chosen, note, np.full(len(view.faces[chosen].points), np.nan))


def _detection(
    view: ViewFaces,
    index: int,
    agreement: Agreement | None,
    mirrored: dict[int, ViewFaces],
    views: Sequence[ViewFaces],
) -> ViewDetection:
    if not view.faces:
        away = None if agreement is None else judgement.turned_away_deg(views, agreement, view.camera)
        note = "no face found" if away is None else f"no face found; it is turned away by about {away:.0f} degrees"
        return _without(view, note)
    chosen = None if agreement is None else agreement.chosen[index]
    if agreement is None or chosen is None:
        if index in mirrored:
            note = "mirrored: the other views agree with its mirror image"
        elif agreement is None:
            note = "contradicts the other views"
        else:
            fit = min(relative_residual(view.camera, face, agreement.points) for face in view.faces)
            off = f"off by {fit:.0%} of the face's size" if fit < 1 else "the face is elsewhere"
            note = f"contradicts the other views: {off}"
        return replace(_without(view, note), state="refused")
    return _used(view, chosen, _note(view, chosen), residuals(view.camera, view.faces[chosen], agreement.points))


def _note(view: ViewFaces, chosen: int) -> str:
    how = {"turned": "found in the turned image", "tiles": "found in tiles", "region": "found where the others say"}
    parts = [how[view.how]] if view.how in how else []
    if len(view.faces) > 1:
        parts.append(f"{len(view.faces)} faces: number {chosen + 1} agrees with the other views")
    return "; ".join(parts) or PLAIN


def _without(view: ViewFaces, note: str) -> ViewDetection:
    return ViewDetection(name=view.view.name, state="none", note=note, camera=view.camera, faces=view.faces)


def _used(view: ViewFaces, chosen: int, note: str, residual_px: Float[np.ndarray, "L"]) -> ViewDetection:
    """A view's face with its spread scaled to its residuals, and without what contradicts the other views."""
    face = view.faces[chosen]
    known = residual_px[np.isfinite(residual_px)] / face.spread_px[np.isfinite(residual_px)]
    factor = np.sqrt(np.median(known**2) / _CHI2_MEDIAN) if len(known) else 1.0
    spread_px = face.spread_px * float(np.clip(factor, 1.0, _MAX_SPREAD_FACTOR))
    with np.errstate(invalid="ignore"):
        wrong = (residual_px > _OUTLIER * spread_px) & (residual_px > _OUTLIER_SIZE * face_size(face))
    confidence = np.where(wrong, 0.0, face.confidence)
    stored = distort_points(view.view.camera, face.points)
    return ViewDetection(
        name=view.view.name,
        state="used",
        note=note,
        camera=view.camera,
        faces=view.faces,
        chosen=chosen,
        landmarks=np.column_stack([stored, confidence]),
        spread_px=spread_px,
        residual_px=residual_px,
        outliers=tuple(int(k) for k in np.flatnonzero(wrong)),
    )
