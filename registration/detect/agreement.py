"""Which faces of several views are one person's: those whose landmarks agree on points in space.

Each pair of faces in two views proposes points (midpoints of their rays); the proposal that most views have a face for
is taken, and its landmarks are triangulated robustly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.capture.triangulation import MIN_CONFIDENCE, triangulate_pixels
from registration.detect.faces import face_size
from registration.detect.provider import Face
from registration.detect.views import ViewFaces
from registration.types import Camera

MAX_RESIDUAL = 0.04  # median over a face's points that agree, relative to its size; detected faces have 0.003 to 0.025
_SAMPLE = 48  # points that proposals are compared with
_MIN_COMMON = 4
_MAX_PROPOSALS = 300
_MAX_POINT_PAIRS = 60  # of views that propose a triangulated point
_MIN_ANGLE = np.radians(2.0)  # between the rays of a proposal
_SIZE_GAIN = 1e-3  # among people that as many views agree on, the larger is taken


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """One person's landmarks in space, and the face of each view that is theirs."""

    chosen: tuple[int | None, ...]  # for each view the position of its face that agrees
    points: Float[np.ndarray, "L 3"]  # world, metres; NaN where too few views agree
    used: Int[np.ndarray, "L"]  # views of each point
    residual_px: Float[np.ndarray, "L"]  # root mean square over these views

    @property
    def count(self) -> int:
        """How many views agree."""
        return sum(choice is not None for choice in self.chosen)


def agree(views: Sequence[ViewFaces]) -> Agreement | None:
    """Return the person on whom most views agree; None if no two do.

    Args:
        views: with the faces of each, which have the same landmarks.
    """
    candidates = [(v, f) for v, view in enumerate(views) for f in range(len(view.faces))]
    pairs = [(a, b) for a, b in combinations(candidates, 2) if a[0] != b[0]]
    if not pairs:
        return None
    if len(pairs) > _MAX_PROPOSALS:
        pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, _MAX_PROPOSALS).astype(int)]
    count = len(views[candidates[0][0]].faces[0].points)
    sample = np.unique(np.linspace(0, count - 1, _SAMPLE).astype(int))
    best, best_score = None, 0.0
    for (v, f), (w, g) in pairs:
        points = _midpoints(views[v].camera, views[v].faces[f], views[w].camera, views[w].faces[g], sample)
        if np.isfinite(points[:, 0]).sum() < _MIN_COMMON:
            continue
        chosen, score = _support(views, points, sample)
        if chosen[v] is not None and chosen[w] is not None and score > best_score:
            best, best_score = chosen, score
    return None if best is None else _triangulated(views, best)


def _support(
    views: Sequence[ViewFaces], points: Float[np.ndarray, "P 3"], sample: Int[np.ndarray, "P"]
) -> tuple[list[int | None], float]:
    """The face of each view that fits proposed points best, and how well all do."""
    chosen: list[int | None] = []
    score = 0.0
    for view in views:
        fits = [relative_residual(view.camera, face, points, sample) for face in view.faces]
        best = int(np.argmin(fits)) if fits else None
        if best is None or not fits[best] < MAX_RESIDUAL:
            chosen.append(None)
            continue
        chosen.append(best)
        size = face_size(view.faces[best]) / max(view.camera.width_px, view.camera.height_px)
        score += 1 - fits[best] / (2 * MAX_RESIDUAL) + _SIZE_GAIN * size
    return chosen, score


def _triangulated(views: Sequence[ViewFaces], chosen: Sequence[int | None]) -> Agreement | None:
    """Landmarks over the chosen faces; faces that the result contradicts are left out, others that fit are taken in."""
    choice = list(chosen)
    for _ in range(3):
        members = [(view, view.faces[k]) for view, k in zip(views, choice, strict=True) if k is not None]
        if len(members) < 2:
            return None
        points, used, residual = triangulate_pixels(
            [view.camera for view, _ in members],
            np.stack([np.column_stack([face.points, face.confidence]) for _, face in members]),
            np.stack([face.spread_px for _, face in members]),
            max_pairs=_MAX_POINT_PAIRS,
        )
        if np.isfinite(points[:, 0]).sum() < _MIN_COMMON:
            return None
        before = choice
        choice = [fitting_face(view, points) for view in views]
        if choice == before:
            break
    members_left = sum(k is not None for k in choice)
    if members_left < 2:
        return None
    return Agreement(chosen=tuple(choice), points=points, used=used, residual_px=residual)


def fitting_face(view: ViewFaces, points: Float[np.ndarray, "L 3"]) -> int | None:
    """Return the position of a view's face that agrees best with points in space; None if none does."""
    fits = [relative_residual(view.camera, face, points) for face in view.faces]
    best = int(np.argmin(fits)) if fits else None
    return best if best is not None and fits[best] < MAX_RESIDUAL else None


def residuals(camera: Camera, face: Face, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L"]:
    """Return the distances of a face's landmarks from projected points, px.

    NaN where a landmark is not seen or has no point, infinite behind the camera.
    """
    projected, depth = camera.project(points)
    distance = np.linalg.norm(projected - face.points, axis=-1)
    distance = np.where(depth > 0, distance, np.where(np.isfinite(depth), np.inf, np.nan))
    return np.where(face.confidence > MIN_CONFIDENCE, distance, np.nan)


def relative_residual(
    camera: Camera, face: Face, points: Float[np.ndarray, "P 3"], sample: Int[np.ndarray, "P"] | None = None
) -> float:
    """Return the median distance of a face's landmarks from projected points, relative to its size.

    Args:
        camera: without distortion.
        face: its landmarks.
        points: world, of the landmarks `sample`; None: of all.
        sample: positions of landmarks.

    Returns:
        The median over landmarks that are seen; infinite if few are.
    """
    part = face if sample is None else _part(face, sample)
    distance = residuals(camera, part, points)
    known = distance[~np.isnan(distance)]
    return float(np.median(known)) / face_size(face) if len(known) >= _MIN_COMMON else np.inf


def _part(face: Face, sample: Int[np.ndarray, "P"]) -> Face:
    return Face(
        points=face.points[sample],
        confidence=face.confidence[sample],
        spread_px=face.spread_px[sample],
        presence=face.presence,
        box=face.box,
    )


def _midpoints(
    first: Camera, face: Face, second: Camera, other: Face, sample: Int[np.ndarray, "P"]
) -> Float[np.ndarray, "P 3"]:
    """Points halfway between the rays of two views; NaN where a landmark is hidden or the rays are nearly parallel."""
    a, b = _rays(first, face.points[sample]), _rays(second, other.points[sample])
    between = second.centre - first.centre
    cosine = (a * b).sum(-1)
    along_a, along_b = a @ between, b @ between
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    points = first.centre + (s[:, None] * a + between + t[:, None] * b) / 2
    usable: Bool[np.ndarray, P] = (sine2 > np.sin(_MIN_ANGLE) ** 2) & (s > 0) & (t > 0)
    usable &= (face.confidence[sample] > MIN_CONFIDENCE) & (other.confidence[sample] > MIN_CONFIDENCE)
    return np.where(usable[:, None], points, np.nan)


def _rays(camera: Camera, pixels: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    """Unit directions of pixels in the world."""
    local = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.intrinsics).T
    world = local @ camera.T_cam_world[:3, :3]
    return world / np.linalg.norm(world, axis=-1, keepdims=True)
