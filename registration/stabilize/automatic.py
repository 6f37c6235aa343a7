"""The automatic stage of stabilization: the rigid motion of the skull between a subject's neutral and its expressions
[GNM, Head Expression], [Bednarik 2024]; docs/algorithms.md, "Stabilization".

A confidence map gives high weight to the skin that moves least over all expressions of a subject. Each expression is
then aligned robustly with these weights, since in some expressions even that skin moves.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.frames import MM_PER_M, compact, transform_points
from registration.geometry.rigid import align
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes


@dataclass(frozen=True, kw_only=True)
class AutomaticSettings:
    """Settings of the automatic stage (docs/algorithms.md, "Stabilization")."""

    half_weight_mm: float = 0.5  # median distance from the neutral at which a vertex has half the weight
    iterations: int = 4  # of confidence map and alignment in turn
    kernel_scale_mm: float = 1.0  # of the Geman-McClure kernel: at this distance the weight is a quarter
    robust_iterations: int = 8  # of reweighted least squares


@dataclass(frozen=True, kw_only=True)
class AlignedExpressions:
    """A subject's expressions after removal of the skull's motion: metres, the neutral's world.

    S expressions, V vertices, R: one more than all iterations.
    """

    T_neutral_expression: Float[np.ndarray, "S 4 4"]  # p_neutral = T_neutral_expression @ p_expression
    vertices: Float[np.ndarray, "S V 3"]  # float32
    confidence_map: Float[np.ndarray, "V"]  # in [0, 1]: 1 does not move; 0 unobserved, or no skin on the skull
    residual_mm: Float[np.ndarray, "S R"]  # rms distance from the neutral before and after each iteration,
    # with the weights of the last one


def stabilize_subject(
    meshes: SubjectMeshes, skin: SkullSkin, settings: AutomaticSettings | None = None
) -> AlignedExpressions:
    """Estimate the skull's motion in each expression of a subject, and undo it.

    Alternates the confidence map w_v = s^2 / (s^2 + median over expressions of |d_v|^2), s = `half_weight_mm`, with
    weighted rigid alignment to the neutral; then aligns each expression alone by iteratively reweighted least squares
    with the Geman-McClure kernel. All weights are multiplied by the registrations' vertex confidence, so that
    unobserved vertices have none, and by vertex areas: models are dense where faces move (eyelids, lips), and the
    areas halve the errors in `bench.stabilization`.

    Args:
        meshes: the subject's registrations, as `subject_meshes` returns them.
        skin: vertex areas of the skin on the skull.
        settings: None: the defaults.

    Returns:
        Transforms, aligned meshes, confidence map and residuals. It never fails: if little skin was observed in both
        meshes, the motion is inaccurate.
    """
    settings = settings or AutomaticSettings()
    rows = np.flatnonzero((skin.area > 0) & (meshes.neutral_confidence > 0))
    target = meshes.neutral[rows].astype(np.float64)
    source = meshes.vertices[:, rows].astype(np.float64)
    confidence = meshes.confidence[:, rows].astype(np.float64)
    base_weights = confidence * (meshes.neutral_confidence[rows] * skin.area[rows])
    stability = np.ones(len(rows))
    transforms, kernel = align(source, target, base_weights), np.ones_like(base_weights)
    history = []
    for iteration in range(settings.iterations + settings.robust_iterations):
        squared_mm = _squared_distances_mm(transforms, source, target)
        history.append(squared_mm)
        if iteration < settings.iterations:
            stability = _stability_weights(squared_mm, confidence > 0, settings.half_weight_mm)
        else:
            kernel = 1 / (1 + squared_mm / settings.kernel_scale_mm**2) ** 2
        transforms = align(source, target, base_weights * stability * kernel)
    history.append(_squared_distances_mm(transforms, source, target))
    weights = base_weights * stability * kernel
    confidence_map = np.zeros(len(meshes.neutral), np.float32)
    confidence_map[rows] = stability * (confidence > 0).any(0)
    aligned = [transform_points(T, vertices) for T, vertices in zip(transforms, meshes.vertices, strict=True)]
    return AlignedExpressions(
        T_neutral_expression=transforms,
        vertices=compact(np.stack(aligned)),
        confidence_map=confidence_map,
        residual_mm=np.stack([np.sqrt((weights * squared).sum(1) / weights.sum(1)) for squared in history], 1),
    )


def _squared_distances_mm(
    transforms: Float[np.ndarray, "S 4 4"], source: Float[np.ndarray, "S P 3"], target: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "S P"]:
    """Return the squared distances of the transformed source from the target, mm^2."""
    residual = source @ transforms[:, :3, :3].swapaxes(1, 2)
    residual += transforms[:, None, :3, 3] - target
    return np.einsum("spc,spc->sp", residual, residual) * MM_PER_M**2


def _stability_weights(
    squared_mm: Float[np.ndarray, "S P"], observed: Bool[np.ndarray, "S P"], half_weight_mm: float
) -> Float[np.ndarray, "P"]:
    """Return the confidence map in (0, 1], from the median over the expressions that show a vertex; 0 if none does."""
    ordered = np.sort(np.where(observed, squared_mm, np.inf), axis=0)
    count = observed.sum(0)
    # The two middle entries of the observed ones, which are equal for odd counts.
    median_rows = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(observed) - 1)])
    median = np.take_along_axis(ordered, median_rows, 0).mean(0)
    return np.where(count > 0, half_weight_mm**2 / (half_weight_mm**2 + np.where(count > 0, median, 0)), 0)
