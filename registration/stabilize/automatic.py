"""The automatic stage: the skull's motion between a subject's neutral and its expressions.

See docs/algorithms.md, "Stabilization".

A confidence map tells which skin stays with the skull: what moves least over all of a subject's expressions. Each
expression is then aligned by it, robustly, since even the steadiest skin moves in some.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import align
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes


@dataclass(frozen=True, kw_only=True)
class Automatic:
    """How the stage goes about it (docs/algorithms.md, "Stabilization")."""

    still_mm: float = 0.5  # a vertex that moves by this much is trusted half
    rounds: int = 4  # of map and alignment in turn
    scale_mm: float = 1.0  # of Geman and McClure's kernel: at this distance a vertex counts a quarter
    robust_rounds: int = 8


@dataclass(frozen=True, kw_only=True)
class Stabilized:
    """A subject's expressions with the skull where the neutral has it."""

    T_neutral_expression: Float[np.ndarray, "S 4 4"]  # p_neutral = T_neutral_expression @ p_expression
    vertices: Float[np.ndarray, "S V 3"]  # float32, metres, the neutral's world
    confidence_map: Float[np.ndarray, "V"]  # in [0, 1]: 1 never moves, 0 moves much, is unseen, or is no skin
    residual_mm: Float[
        np.ndarray, "S R"
    ]  # after each round: rms distance from the neutral, weighted as in the last round


def stabilize_subject(meshes: SubjectMeshes, skin: SkullSkin, settings: Automatic | None = None) -> Stabilized:
    """Find the skull's motion in each expression and undo it.

    Alternates the confidence map w_v = s^2 / (s^2 + median over expressions of |d_v|^2), s = `still_mm`, with weighted
    rigid alignment to the neutral; then aligns each expression alone by iteratively reweighted least squares with Geman
    and McClure's kernel. Weights are times the registrations' confidence, so that unseen vertices carry none.

    Measured by `bench.stabilization`: weights are also times the area that a vertex stands for, since
    models are dense where faces move (lids, lips); that halves the errors. The neck does not take part.

    `meshes` as `subject_meshes` returns them. Never fails: with little skin seen in common the motion is a poor one.
    """
    settings = settings or Automatic()
    rows = np.flatnonzero((skin.area > 0) & (meshes.neutral_confidence > 0))
    target = meshes.neutral[rows].astype(np.float64)
    source = meshes.vertices[:, rows].astype(np.float64)
    seen = meshes.confidence[:, rows].astype(np.float64)
    base = seen * (meshes.neutral_confidence[rows] * skin.area[rows])
    trust = np.ones(len(rows))
    found, kernel = align(source, target, base), np.ones_like(base)
    history = []
    for number in range(settings.rounds + settings.robust_rounds):
        squared = _squared_mm(found, source, target)
        history.append(squared)
        if number < settings.rounds:
            trust = _still(squared, seen > 0, settings.still_mm)
        else:
            kernel = 1 / (1 + squared / settings.scale_mm**2) ** 2
        found = align(source, target, base * trust * kernel)
    history.append(_squared_mm(found, source, target))
    weights = base * trust * kernel
    confidence_map = np.zeros(len(meshes.neutral), np.float32)
    confidence_map[rows] = trust * (seen > 0).any(0)
    return Stabilized(
        T_neutral_expression=found,
        vertices=np.stack([transform_points(T, v) for T, v in zip(found, meshes.vertices, strict=True)]).astype(
            np.float32
        ),
        confidence_map=confidence_map,
        residual_mm=np.stack([np.sqrt((weights * h).sum(1) / weights.sum(1)) for h in history], 1),
    )


def _squared_mm(
    found: Float[np.ndarray, "S 4 4"], source: Float[np.ndarray, "S P 3"], target: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "S P"]:
    """Squared distances of the moved source from the target, mm^2."""
    away = source @ found[:, :3, :3].swapaxes(1, 2)
    away += found[:, None, :3, 3] - target
    return np.einsum("spc,spc->sp", away, away) * MM_PER_M**2


def _still(squared: Float[np.ndarray, "S P"], seen: Bool[np.ndarray, "S P"], still_mm: float) -> Float[np.ndarray, "P"]:
    """How much each vertex stays with the skull, in (0, 1]; 0 if no expression shows it."""
    known = np.sort(np.where(seen, squared, np.inf), axis=0)
    count = seen.sum(0)
    middle = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(seen) - 1)])
    median = np.take_along_axis(known, middle, 0).mean(0)
    return np.where(count > 0, still_mm**2 / (still_mm**2 + np.where(count > 0, median, 0)), 0)
