"""Where a fit begins: from landmarks in closed form, or without them from masks and several turns of the head."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.fit.variables import Start, pivot
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Rendered, Targets

_LANDMARK_SIGMA_M = 1.5e-3  # of a triangulated landmark against the same point of the model
_EXPRESSION_SHARE = 0.5  # standard deviation granted to expressions against identity, at the start
_OUTLIER_M = 8e-3
_ROUNDS = 15
_TRIMMING_ROUNDS = (2, 5, 8)  # after which outliers are found anew
LEAST_LANDMARKS = 6
LEAST_OVERLAP = 0.7
_YAWS, _PITCHES = np.radians(np.arange(0, 360, 45)), np.radians([-25.0, 0.0, 25.0])
_REFINED = 5  # of the starts that are refined


def from_landmarks(
    data: GNMData,
    scheme: LandmarkScheme,
    points: Float[np.ndarray, "L 3"],
    *,
    free_scale: bool,
    neutral: Start | None = None,
) -> Start:
    """A similarity and first coefficients from triangulated landmarks (world, metres; NaN = unseen).

    Alternates the rigid motion (Umeyama 1991) with the coefficients' ridge solution. Landmarks that disagree with the
    model by more than 8 mm after the first rounds are left out and named: schemes differ along the jaw.
    From a `neutral`, its identity, offsets and scale are kept and only pose and expression are sought.
    At least LEAST_LANDMARKS must be seen.
    """
    template = scheme.points(data.template_vertex_positions.astype(np.float64))
    identity_basis = scheme.points(data.vertex_identity_basis.astype(np.float64))
    basis = scheme.points(data.expression_basis.astype(np.float64)) * _EXPRESSION_SHARE
    if neutral is None:
        basis = np.concatenate([identity_basis, basis])
    else:
        assert neutral.identity is not None and neutral.offsets is not None
        template = template + np.tensordot(neutral.identity.astype(np.float64), identity_basis, 1)
        template = neutral.scale * (template + scheme.points(neutral.offsets.astype(np.float64)))
        basis = neutral.scale * basis
    used = np.isfinite(points).all(1)
    seen = used.copy()
    coefficients = np.zeros(len(basis))
    for round_ in range(_ROUNDS):
        model = template + np.tensordot(coefficients, basis, 1)
        scale, rotation, shift = similarity(model[used], points[used], free_scale=free_scale and neutral is None)
        wanted = (points - shift) @ rotation / scale - template
        matrix = basis[:, used].reshape(len(basis), -1).T / _LANDMARK_SIGMA_M
        right = wanted[used].ravel() / _LANDMARK_SIGMA_M
        coefficients = matrix.T @ np.linalg.solve(matrix @ matrix.T + np.eye(len(right)), right)
        if round_ in _TRIMMING_ROUNDS:
            fitted = scale * (template + np.tensordot(coefficients, basis, 1)) @ rotation.T + shift
            distance = np.linalg.norm(fitted - points, axis=1)
            keep = seen & (distance < max(_OUTLIER_M, 3 * np.median(distance[seen])))
            used = keep if keep.sum() >= LEAST_LANDMARKS else used
    split = len(basis) - len(data.expression_basis)
    dropped = np.flatnonzero(seen & ~used)
    note = f"landmarks {_ranges(dropped)} of scheme {scheme.name} lie elsewhere than the model's: left out"
    total = scale if neutral is None else neutral.scale
    return Start(
        rotation=rotation,
        position=total * rotation @ pivot(data) + shift,
        scale=total,
        identity=coefficients[:split] if neutral is None else neutral.identity,
        expression=coefficients[split:] * _EXPRESSION_SHARE,
        offsets=None if neutral is None else neutral.offsets,
        landmarks_used=used,
        notes=(note,) if len(dropped) else (),
    )


def similarity(
    source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"], *, free_scale: bool
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Scale, rotation, shift with target = scale * rotation @ source + shift in the least squares sense (Umeyama)."""
    a, b = source.mean(0), target.mean(0)
    u, s, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = float((s * np.diag(flip)).sum() / ((source - a) ** 2).sum()) if free_scale else 1.0
    return scale, rotation, b - scale * rotation @ a


def _ranges(indices: np.ndarray) -> str:
    """1, 2, 3, 7 as "1-3, 7"."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return ", ".join(f"{r[0]}-{r[-1]}" if len(r) > 1 else f"{r[0]}" for r in runs if len(r))


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One turn of the head that was tried, and how well its silhouette covered the masks (intersection over union)."""

    start: Start
    overlap: float
    score: float  # overlap plus agreement of normals and classes


def from_masks(
    data: GNMData,
    targets: Targets,
    assess: Callable[[Start], Candidate],
    refine: Callable[[Start], Start],
) -> Start:
    """A start without landmarks: 24 turns of the head at the masks' common centre, the best refined as rigid bodies.

    The rig's cameras are taken to stand upright and in front of the subject, give or take; failing that, they are
    taken to be rolled by quarter turns.

    Raises:
        InputError: no turn covers the masks by 0.7.
    """
    centre = _masks_centre(targets)
    best: Candidate | None = None
    for roll in np.radians([0.0, 90.0, -90.0, 180.0]):
        upright = _upright(targets, centre) @ Rotation.from_euler("z", roll).as_matrix()
        turns = [upright @ Rotation.from_euler("YX", (yaw, pitch)).as_matrix() for yaw in _YAWS for pitch in _PITCHES]
        tried = [assess(Start(rotation=turn, position=centre)) for turn in turns]
        tried.sort(key=lambda c: -c.score)
        refined = [assess(refine(c.start)) for c in tried[:_REFINED]]
        best = max([*refined, *([best] if best else [])], key=lambda c: c.score)
        if best.overlap >= LEAST_OVERLAP:
            note = f"no landmarks: best of {len(turns)} turns of the head, mask overlap {best.overlap:.2f}"
            return replace(best.start, notes=(note,))
    assert best is not None
    raise InputError(
        "The head was not found",
        where="masks of the capture; there are no landmarks in a scheme that the model knows",
        expected=f"a turn of the head that covers the masks by at least {LEAST_OVERLAP}",
        got=f"{best.overlap:.2f} at best",
        fix="give landmarks of a scheme that the model has (head_sparse_<scheme>.txt beside it, or --landmarks), or "
        "check the masks and that cameras and model are in metres",
    )


def _masks_centre(targets: Targets) -> Float[np.ndarray, "3"]:
    """The point nearest to the rays through the centres of the heads' boxes."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for i, camera in enumerate(targets.pixels.cameras):
        head = _head(targets, i)
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


def _head(targets: Targets, view: int) -> Bool[np.ndarray, "H W"]:
    head = (targets.mask > 0.5) & (targets.mask_weight > 0) & (targets.pixels.view == view)
    return targets.pixels.image(head[:, None].float())[view, ..., 0].numpy() > 0.5


def _upright(targets: Targets, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """World from model for a head that faces the middle of the rig, upright as the images are."""
    up = -np.mean([camera.T_cam_world[1, :3] for camera in targets.pixels.cameras], 0)
    front = np.mean([camera.centre for camera in targets.pixels.cameras], 0) - centre
    front -= up * (front @ up) / (up @ up)
    y, z = up / np.linalg.norm(up), front / np.linalg.norm(front)
    return np.stack([np.cross(y, z), y, z], 1)


def assess(start: Start, rendered: Rendered, targets: Targets) -> Candidate:
    """How well a rendered start covers the masks, and agrees with normals and classes where it does."""
    known = targets.mask_weight > 0
    drawn, seen = (rendered.mask > 0.5) & known, (targets.mask > 0.5) & known
    overlap = ((drawn & seen).sum() / (drawn | seen).sum().clamp_min(1)).item()
    both = drawn & seen
    normal_weight, class_weight = targets.normal_weight * both, targets.class_weight * both
    cosine = (rendered.normals * targets.normals).sum(-1)
    agree = (cosine * normal_weight).sum() / normal_weight.sum().clamp_min(1e-6)
    # Skin is nearly everywhere: what tells one turn from another is the share of everything else.
    other = (targets.classes[..., 1:] * class_weight[..., None]).sum()
    met = (torch.minimum(rendered.classes, targets.classes)[..., 1:] * class_weight[..., None]).sum()
    return Candidate(start=start, overlap=overlap, score=overlap + agree.item() + (met / other.clamp_min(1)).item())


def spread_views(cameras: Sequence[Camera], count: int) -> list[int]:
    """`count` views that look from as different places as possible, the first one included; in order."""
    centres = np.stack([camera.centre for camera in cameras])
    chosen = [0]
    while len(chosen) < min(count, len(centres)):
        distance = np.linalg.norm(centres[:, None] - centres[chosen][None], axis=-1).min(1)
        chosen.append(int(distance.argmax()))
    return sorted(chosen)
