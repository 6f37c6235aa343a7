"""What is wrong with the faces of a capture: none, one, two people, mirrored, of different moments, blurred."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from registration.detect.agreement import Agreement
from registration.detect.capture_landmarks import Outcome, ViewDetection
from registration.detect.faces import face_size
from registration.detect.views import ViewFaces
from registration.types import Camera

_MIN_SHARE = 0.5  # of the views with a face that must agree
_FRONTAL_DEG = 40.0
_AXES = {  # scheme -> points at the subject's right, left, above, below, and in front of these, at any expression
    "face478": ((33, 133, 61, 205), (263, 362, 291, 425), (10, 151, 9), (152, 199, 175), (1, 4, 5, 195)),
    "68": ((36, 39, 48), (42, 45, 54), (19, 24), (7, 8, 9), (29, 30, 33)),
}
_LARGE_SPREAD = 0.02  # median, relative to the face's size; sharp images have 0.005 to 0.01
_LARGE_RATIO = 2.2  # of residuals to spreads; views of one moment have 0.5 to 1.9
_PART = 0.2  # share of a view's landmarks that contradict others; views of one moment have up to 0.15


def judge(
    views: Sequence[ViewFaces], agreement: Agreement | None, mirrored: Mapping[int, ViewFaces], scheme: str
) -> tuple[Outcome, str]:
    """Return what the faces are good for, and why in words."""
    seen = [view.view.name for view in views if view.faces]
    if not seen:
        return "no face", f"no face in any of {len(views)} views"
    if agreement is None:
        if len(seen) == 1:
            return "one view", f"a face in {seen[0]} alone"
        if mirrored:
            return (
                "mirrored",
                f"faces agree only if images are mirrored: {named([views[k].view.name for k in mirrored])}",
            )
        return "contradictory", f"faces in {named(seen)} that do not agree: {_apart(views)}"
    if inside_out(agreement.points, scheme):
        return "mirrored", "the views agree on a face that is inside out: images, or the cameras, are mirrored"
    if agreement.count < _MIN_SHARE * len(seen):
        others = [view.view.name for view, k in zip(views, agreement.chosen, strict=True) if view.faces and k is None]
        return "contradictory", f"{agreement.count} of {len(seen)} views agree on a face; others: {named(others)}"
    return "found", f"{agreement.count} of {len(views)} views agree on a face"


def _apart(views: Sequence[ViewFaces]) -> str:
    """How far the rays through the faces of the two most certain views pass each other."""
    first, second = sorted((v for v in views if v.faces), key=lambda v: -v.faces[0].presence)[:2]
    a, b = _ray(first), _ray(second)
    between = second.camera.centre - first.camera.centre
    system = np.column_stack([a, -b])
    s, t = np.linalg.lstsq(system, between, rcond=None)[0]
    if s <= 0 or t <= 0:
        return f"the cameras {first.view.name} and {second.view.name} look at different places"
    gap = float(np.linalg.norm(between - system @ [s, t]))
    names = f"{first.view.name} and {second.view.name}"
    return f"the rays through the faces of {names} pass at {1000 * gap:.0f} mm, or their landmarks differ"


def _ray(view: ViewFaces) -> Float[np.ndarray, "3"]:
    x, y = view.faces[0].points.mean(0)
    ray = view.camera.T_cam_world[:3, :3].T @ np.linalg.inv(view.camera.intrinsics) @ np.array([x, y, 1.0])
    return ray / np.linalg.norm(ray)


def inside_out(points: Float[np.ndarray, "L 3"], scheme: str) -> bool:
    """Return whether triangulated points are a face's mirror image: its nose behind its eyes and chin."""
    if scheme not in _AXES:
        return False
    groups = [points[list(group)] for group in _AXES[scheme]]
    if any(np.isnan(group).all() for group in groups):
        return False
    right, left, above, below, front = (np.nanmean(group, 0) for group in groups)
    return bool(np.linalg.det(np.stack([left - right, below - above, front - (right + left) / 2])) > 0)


def facing(views: Sequence[ViewFaces], agreement: Agreement) -> Float[np.ndarray, "3"]:
    """Return the direction that the face looks to in the world: its flattest, towards the cameras that see it."""
    points = agreement.points[np.isfinite(agreement.points[:, 0])]
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    seeing = [view.camera.centre for view, k in zip(views, agreement.chosen, strict=True) if k is not None]
    towards = np.sum([_unit(centre - points.mean(0)) for centre in seeing], 0)
    return normal if normal @ towards > 0 else -normal


def turned_away_deg(views: Sequence[ViewFaces], agreement: Agreement, camera: Camera) -> float:
    """Return the angle between where the face looks and the direction to a camera, degrees."""
    centre = np.nanmean(agreement.points, 0)
    cosine = facing(views, agreement) @ _unit(camera.centre - centre)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def hints(
    views: Sequence[ViewFaces], detections: Sequence[ViewDetection], agreement: Agreement | None
) -> dict[str, float]:
    """Return the median of each hint over the views that see the face from the front, or over all if none does."""
    used = [k for k, detection in enumerate(detections) if detection.state == "used"]
    if agreement is not None:
        frontal = [k for k in used if turned_away_deg(views, agreement, views[k].camera) < _FRONTAL_DEG]
        used = frontal or used
    tables = [detections[k].faces[chosen].hints for k in used if (chosen := detections[k].chosen) is not None]
    names = dict.fromkeys(name for table in tables for name in table)
    return {name: float(np.median([table[name] for table in tables if name in table])) for name in names}


def warnings(
    views: Sequence[ViewFaces],
    detections: Sequence[ViewDetection],
    agreement: Agreement | None,
    mirrored: Mapping[int, ViewFaces],
) -> Iterator[str]:
    """Yield what a person should know about landmarks that are used all the same."""
    refused = [detection for detection in detections if detection.state == "refused"]
    if mirrored:
        yield f"mirrored images: {named([views[k].view.name for k in mirrored])}; their landmarks are not used"
    if plain := [d.name for d in refused if detections.index(d) not in mirrored]:
        yield f"faces that contradict the other views: {named(plain)}; their landmarks are not used"
    several = [view.view.name for view in views if len(view.faces) > 1]
    if several:
        yield f"more than one face: {named(several)}; the one is used that the views agree on"
    used = [detection for detection in detections if detection.state == "used"]
    blurred = [d.name for d in used if _relative_spread(d) > _LARGE_SPREAD]
    if blurred:
        yield f"uncertain landmarks, as in blurred or small pictures: {named(blurred)}"
    if agreement is None:
        return
    ratios = np.array([_ratio(d) for d in used])
    if (rough := [d.name for d, ratio in zip(used, ratios, strict=True) if ratio > _LARGE_RATIO]) and len(used) > 1:
        worst = int(np.nanargmax(ratios))
        size = f"{used[worst].name} within {np.nanmedian(used[worst].residual_px):.1f} px"
        yield (
            f"faces that fit the other views only roughly, {size}, {ratios[worst]:.1f} times what is expected:"
            f" {named(rough)}; cameras are off, or the photographs are of different moments"
        )
        return
    shares = [len(d.outliers) / max(1, int(np.isfinite(d.residual_px).sum())) for d in used]
    if apart := [d.name for d, share in zip(used, shares, strict=True) if share > _PART]:
        yield f"parts of the face contradict other views, as in photographs of different moments: {named(apart)}"


def _relative_spread(detection: ViewDetection) -> float:
    face = detection.faces[detection.chosen or 0]
    return float(np.median(face.spread_px)) / face_size(face)


def _ratio(detection: ViewDetection) -> float:
    """Median of a view's residuals, relative to what its spreads lead one to expect."""
    face = detection.faces[detection.chosen or 0]
    known = np.isfinite(detection.residual_px)
    if not known.any():
        return float("nan")
    return float(np.median(detection.residual_px[known] / face.spread_px[known])) / np.sqrt(1.386)


def named(names: Sequence[str], limit: int = 6) -> str:
    """Return a list of names in words, shortened."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more} more" if more > 0 else "")


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / np.linalg.norm(vector)
