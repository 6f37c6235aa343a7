"""Measures of stabilization against known truth: remaining motion, and energy lost by expressions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.support.performances import BROWS, JAW, ObservedSubject, TrueSubject
from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import angle_deg, motion_fields
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.stabilize.components import HeadGeometry, RegionalComponents, regional_components
from registration.stabilize.decisions import compute_corrections, default_actions
from registration.stabilize.pipeline import StabilizedSubject


def face_mask(data: GNMData) -> np.ndarray:
    """Return the vertices of the face mask."""
    return group(data, "hockey_mask") > 0.5


def remaining_motion(
    T_neutral_expression: np.ndarray, observed: ObservedSubject, truth: TrueSubject, data: GNMData
) -> np.ndarray:
    """Return degrees and mm (rms over the face mask) of each remaining motion, (2, S)."""
    return motion_size(T_neutral_expression @ observed.T_expression_neutral, truth.neutral[face_mask(data)])


def motion_size(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return degrees, and rms mm at some points, of each motion (S, 4, 4), as (2, S)."""
    displacement = np.stack([transform_points(motion, points) - points for motion in motions])
    return np.stack([angle_deg(motions), MM_PER_M * np.sqrt((displacement**2).sum(-1).mean(1))])


def energy_lost(
    subjects: Sequence[StabilizedSubject],
    truths: Sequence[TrueSubject],
    head: HeadGeometry,
    labels: tuple[str, ...] = JAW + BROWS,
) -> dict[str, float]:
    """Return 1 - <d', d> / <d, d> by label over all exterior skin: d true, d' stabilized displacements."""
    products, squares = dict.fromkeys(labels, 0.0), dict.fromkeys(labels, 0.0)
    for subject, truth in zip(subjects, truths, strict=True):
        for k, label in enumerate(truth.labels):
            if label in products:
                true = truth.vertices[k] - truth.neutral
                stabilized = subject.vertices[k] - subject.neutral
                products[label] += float((stabilized * true).sum(-1) @ head.area)
                squares[label] += float((true * true).sum(-1) @ head.area)
    return {label: 1 - products[label] / squares[label] for label in labels}


@dataclass(frozen=True, kw_only=True)
class InjectedMotionResult:
    """The regional stage's effect on motions that were added to a third of the samples."""

    components: list[RegionalComponents]
    reduced: float  # fraction of the motions' energy
    lost: float  # of the true expressions' energy, 1 - <d', d> / <d, d> over all samples


def remove_injected_motion(
    truths: Sequence[TrueSubject],
    data: GNMData,
    seed: int,
    *,
    kinds: int = 2,
    rotation_deg: float = 1.0,
    translation_mm: float = 2.0,
) -> InjectedMotionResult:
    """Add rigid motions of some kinds (standard deviations as given) with random strengths, and apply the stage."""
    head, rng = HeadGeometry.from_model(data), np.random.default_rng(seed)
    true = np.concatenate([truth.vertices - truth.neutral for truth in truths])
    labels = [label for truth in truths for label in truth.labels]
    twists = rng.normal(size=(kinds, 2, 3))
    twists *= np.array([np.radians(rotation_deg), translation_mm / MM_PER_M])[:, None] / np.linalg.norm(
        twists, axis=2, keepdims=True
    )
    chosen = rng.permutation(len(true)) % 3 == 0
    strengths = rng.normal(size=(len(true), kinds)) * chosen[:, None]
    spurious = strengths @ twists.reshape(kinds, 6)
    fields = motion_fields(head.points)
    components = regional_components(
        [(d + np.tensordot(twist, fields, 1)).astype(np.float32) for d, twist in zip(true, spurious, strict=True)],
        labels,
        head,
    )
    corrections = compute_corrections(components, default_actions(components), labels, head)
    gram = np.einsum("ivc,v,jvc->ij", fields, head.area, fields)
    remaining = spurious - corrections.twists

    def energy(motions: np.ndarray) -> float:
        return float(np.einsum("si,ij,sj->", motions, gram, motions))

    shared = sum(
        float((d * np.tensordot(twist, fields, 1)).sum(-1) @ head.area)
        for d, twist in zip(true, remaining, strict=True)
    )
    energy_of_true = float(((true**2).sum(-1) @ head.area).sum())
    return InjectedMotionResult(
        components=components, reduced=1 - energy(remaining) / energy(spurious), lost=-shared / energy_of_true
    )
