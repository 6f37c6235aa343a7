"""The initial guess of a fit: from landmarks in closed form, or without them from masks and many head poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.fit.variables import InitialGuess, pivot
from registration.geometry.rigid import similarity_transform
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Rendered, Targets

MIN_LANDMARKS = 6  # of a scheme, triangulated, for an initial guess
MIN_OVERLAP = 0.7  # intersection over union of rendered and target masks, for an initial guess
_LANDMARK_SIGMA_M = 1.5e-3  # of a triangulated landmark against the same point of the model, if nobody states it
_MODEL_SIGMA_M = 1e-3  # part of it that is the model's: its basis does not span the subject
UNKNOWN_SPREAD_M = float(np.sqrt(_LANDMARK_SIGMA_M**2 - _MODEL_SIGMA_M**2))  # of a landmark beside others with a spread
_EXPRESSION_SIGMA = 0.5  # standard deviation of expression coefficients; that of identity coefficients is 1
_OUTLIER_M = 8e-3
_MAX_ITERATIONS = 15
_OUTLIER_ITERATIONS = (2, 5, 8)  # after which outliers are determined again
_YAWS, _PITCHES = np.radians(np.arange(0, 360, 45)), np.radians([-25.0, 0.0, 25.0])
_REFINED_POSES = 5  # the best ones of each roll


def from_landmarks(
    data: GNMData,
    scheme: LandmarkScheme,
    points: Float[np.ndarray, "L 3"],
    *,
    free_scale: bool,
    neutral: InitialGuess | None = None,
    spread_m: Float[np.ndarray, "L"] | None = None,
) -> InitialGuess:
    """Return the similarity transform and coefficients that fit triangulated landmarks best.

    Alternates the similarity transform [Umeyama 1991] with ridge regression for the coefficients. Landmarks farther
    than 8 mm and than three times the median from the model are outliers, re-determined after some iterations: schemes
    differ along the jaw. Where spreads are given, distances are relative to them, and 8 mm stand for 5.3 of them.

    Args:
        data: the model.
        scheme: of the model; names the same points.
        points: world, metres; NaN where not triangulated. At least `MIN_LANDMARKS` must be finite.
        free_scale: estimate the size of the head too; else it is the model's.
        neutral: of the same subject: its identity, offsets and scale are kept, pose and expression are estimated.
        spread_m: standard deviation of the points along each axis, metres; None: alike for all.

    Returns:
        The guess; its notes name the outliers.
    """
    template = scheme.points(data.template_vertex_positions.astype(np.float64))
    identity_basis = scheme.points(data.vertex_identity_basis.astype(np.float64))
    basis = scheme.points(data.expression_basis.astype(np.float64)) * _EXPRESSION_SIGMA
    if neutral is None:
        basis = np.concatenate([identity_basis, basis])
    else:
        assert neutral.identity is not None and neutral.offsets is not None
        template = template + np.tensordot(neutral.identity.astype(np.float64), identity_basis, 1)
        template = neutral.scale * (template + scheme.points(neutral.offsets.astype(np.float64)))
        basis = neutral.scale * basis
    valid = np.isfinite(points).all(1)
    sigma_m, pull = np.full(len(points), _LANDMARK_SIGMA_M), None
    if spread_m is not None:
        valid &= np.isfinite(spread_m)
        sigma_m = np.where(valid, np.hypot(spread_m, _MODEL_SIGMA_M), 1)
        pull = (_LANDMARK_SIGMA_M / sigma_m) ** 2
    used = valid.copy()
    coefficients = np.zeros(len(basis))
    for iteration in range(_MAX_ITERATIONS):
        model = template + np.tensordot(coefficients, basis, 1)
        scale, rotation, shift = similarity_transform(
            model[used],
            points[used],
            free_scale=free_scale and neutral is None,
            weights=None if pull is None else pull[used],
        )
        target = (points - shift) @ rotation / scale - template
        scales = np.repeat(sigma_m[used], 3)
        matrix = basis[:, used].reshape(len(basis), -1).T / scales[:, None]
        right = target[used].ravel() / scales
        coefficients = matrix.T @ np.linalg.solve(matrix @ matrix.T + np.eye(len(right)), right)
        if iteration in _OUTLIER_ITERATIONS:
            fitted = scale * (template + np.tensordot(coefficients, basis, 1)) @ rotation.T + shift
            distance = np.linalg.norm(fitted - points, axis=1)
            if spread_m is not None:
                distance *= _LANDMARK_SIGMA_M / sigma_m
            inliers = valid & (distance < max(_OUTLIER_M, 3 * np.median(distance[valid])))
            used = inliers if inliers.sum() >= MIN_LANDMARKS else used
    identity_count = len(basis) - len(data.expression_basis)
    outliers = np.flatnonzero(valid & ~used)
    note = f"landmarks {_ranges(outliers)} of scheme {scheme.name} do not fit the model's: excluded"
    total_scale = scale if neutral is None else neutral.scale
    return InitialGuess(
        rotation=rotation,
        position=total_scale * rotation @ pivot(data) + shift,
        scale=total_scale,
        identity=coefficients[:identity_count] if neutral is None else neutral.identity,
        expression=coefficients[identity_count:] * _EXPRESSION_SIGMA,
        offsets=None if neutral is None else neutral.offsets,
        landmarks_used={scheme.name: used},
        notes=(note,) if len(outliers) else (),
    )


def _ranges(indices: np.ndarray) -> str:
    """1, 2, 3, 7 as "1-3, 7"."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return ", ".join(f"{r[0]}-{r[-1]}" if len(r) > 1 else f"{r[0]}" for r in runs if len(r))


@dataclass(frozen=True, kw_only=True)
class PoseCandidate:
    """An initial guess that was tried, and how well its rendering covers the targets."""

    initial: InitialGuess
    overlap: float  # intersection over union of the masks
    score: float  # overlap plus agreement of normals and classes


def from_masks(
    data: GNMData,
    targets: Targets,
    assess: Callable[[InitialGuess], PoseCandidate],
    refine: Callable[[InitialGuess], InitialGuess],
) -> InitialGuess:
    """Return an initial guess without landmarks: the best of 24 head poses at the masks' common centre.

    The best five of the poses are refined as rigid bodies. Cameras are assumed to stand upright and around the front of
    the subject; if no pose covers the masks, they are assumed to be rolled by quarter turns.

    Args:
        data: the model.
        targets: of all views, at a coarse level.
        assess: renders a guess and rates it.
        refine: improves a guess's pose.

    Raises:
        InputError: no pose reaches `MIN_OVERLAP`.
    """
    centre = _masks_centre(targets)
    best: PoseCandidate | None = None
    for roll in np.radians([0.0, 90.0, -90.0, 180.0]):
        upright = _upright(targets, centre) @ Rotation.from_euler("z", roll).as_matrix()
        rotations = [
            upright @ Rotation.from_euler("YX", (yaw, pitch)).as_matrix() for yaw in _YAWS for pitch in _PITCHES
        ]
        candidates = [assess(InitialGuess(rotation=rotation, position=centre)) for rotation in rotations]
        candidates.sort(key=lambda candidate: -candidate.score)
        refined = [assess(refine(candidate.initial)) for candidate in candidates[:_REFINED_POSES]]
        best = max([*refined, *([best] if best else [])], key=lambda candidate: candidate.score)
        if best.overlap >= MIN_OVERLAP:
            note = f"no landmarks: best of {len(rotations)} head poses, mask overlap {best.overlap:.2f}"
            return replace(best.initial, notes=(note,))
    assert best is not None
    raise InputError(
        "The pose of the head cannot be estimated",
        where="masks of the capture; there are no landmarks in a scheme that the model knows",
        expected=f"a head pose that covers the masks by at least {MIN_OVERLAP}",
        got=f"{best.overlap:.2f} at best",
        fix="give landmarks of a scheme that the model has (head_sparse_<scheme>.txt beside it, or --landmarks), or "
        "check the masks and that cameras and model are in metres",
    )


def _masks_centre(targets: Targets) -> Float[np.ndarray, "3"]:
    """The point closest to the rays through the centres of the heads' bounding boxes; world, metres."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for i, camera in enumerate(targets.pixels.cameras):
        head = _head_mask(targets, i)
        if not head.any():
            continue
        rows, columns = np.flatnonzero(head.any(1)), np.flatnonzero(head.any(0))
        pixel = np.array([columns[[0, -1]].mean() + 0.5, rows[[0, -1]].mean() + 0.5, 1.0])
        ray = camera.T_cam_world[:3, :3].T @ np.linalg.solve(camera.intrinsics, pixel)
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        right += across @ camera.centre
    return np.linalg.solve(matrix, right)


def _head_mask(targets: Targets, view: int) -> Bool[np.ndarray, "H W"]:
    head = (targets.mask > 0.5) & (targets.mask_weight > 0) & (targets.pixels.view == view)
    return targets.pixels.image(head[:, None].float())[view, ..., 0].numpy() > 0.5


def _upright(targets: Targets, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """World from model for a head that faces the centre of the cameras, upright as the images."""
    up = -np.mean([camera.T_cam_world[1, :3] for camera in targets.pixels.cameras], 0)
    front = np.mean([camera.centre for camera in targets.pixels.cameras], 0) - centre
    front -= up * (front @ up) / (up @ up)
    y, z = up / np.linalg.norm(up), front / np.linalg.norm(front)
    return np.stack([np.cross(y, z), y, z], 1)


def rate_candidate(initial: InitialGuess, rendered: Rendered, targets: Targets) -> PoseCandidate:
    """Return how well a rendered initial guess covers the masks, and agrees with normals and classes where it does.

    Args:
        initial: the guess.
        rendered: its rendering at the pixels of the targets.
        targets: of the same views.
    """
    compared = targets.mask_weight > 0
    rendered_mask, target_mask = (rendered.mask > 0.5) & compared, (targets.mask > 0.5) & compared
    both = rendered_mask & target_mask
    overlap = (both.sum() / (rendered_mask | target_mask).sum().clamp_min(1)).item()
    normal_weight, class_weight = targets.normal_weight * both, targets.class_weight * both
    cosine = (rendered.normals * targets.normals).sum(-1)
    agree = (cosine * normal_weight).sum() / normal_weight.sum().clamp_min(1e-6)
    # Most pixels are skin in every pose; the other classes distinguish poses.
    other = (targets.classes[..., 1:] * class_weight[..., None]).sum()
    matched = (torch.minimum(rendered.classes, targets.classes)[..., 1:] * class_weight[..., None]).sum()
    score = overlap + agree.item() + (matched / other.clamp_min(1)).item()
    return PoseCandidate(initial=initial, overlap=overlap, score=score)


def select_spread_views(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return `count` views whose cameras are as far apart as possible (farthest point sampling from the first).

    Args:
        cameras: of all views.
        count: at most so many.

    Returns:
        Indices into `cameras`, sorted; the first camera is among them.
    """
    centres = np.stack([camera.centre for camera in cameras])
    selected = [0]
    while len(selected) < min(count, len(centres)):
        distance = np.linalg.norm(centres[:, None] - centres[selected][None], axis=-1).min(1)
        selected.append(int(distance.argmax()))
    return sorted(selected)
