"""What stabilization left, and what it took, against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.support.performances import BROWS, JAW, Performed, Seen
from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import angle_deg, motion_fields
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.stabilize.components import Components, Head, regional_components
from registration.stabilize.decisions import corrections, default_actions
from registration.stabilize.pipeline import StabilizedSubject


def face(data: GNMData) -> np.ndarray:
    return group(data, "hockey_mask") > 0.5


def left(T_neutral_expression: np.ndarray, seen: Seen, truth: Performed, data: GNMData) -> np.ndarray:
    """Degrees and mm (rms over the face mask) of each residual motion, (2, S)."""
    return residual(T_neutral_expression @ seen.T_expression_neutral, truth.neutral[face(data)])


def residual(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Degrees and rms mm at some points of each motion (S, 4, 4), as (2, S)."""
    moved = np.stack([transform_points(motion, points) - points for motion in motions])
    return np.stack([angle_deg(motions), MM_PER_M * np.sqrt((moved**2).sum(-1).mean(1))])


def lost_by_label(
    subjects: Sequence[StabilizedSubject],
    truths: Sequence[Performed],
    head: Head,
    labels: tuple[str, ...] = JAW + BROWS,
) -> dict[str, float]:
    """1 - <d', d> / <d, d> over the exterior skin and all subjects: d true displacements, d' what came out."""
    inner, own = dict.fromkeys(labels, 0.0), dict.fromkeys(labels, 0.0)
    for subject, truth in zip(subjects, truths, strict=True):
        for k, label in enumerate(truth.labels):
            if label in inner:
                true = truth.vertices[k] - truth.neutral
                found = subject.vertices[k] - subject.neutral
                inner[label] += float((found * true).sum(-1) @ head.area)
                own[label] += float((true * true).sum(-1) @ head.area)
    return {label: 1 - inner[label] / own[label] for label in labels}


@dataclass(frozen=True, kw_only=True)
class Injected:
    """What the regional stage did about motions that were put into a third of the samples."""

    components: list[Components]
    reduced: float  # share of their energy that is gone
    lost: float  # of the true expressions' energy, 1 - <d', d> / <d, d> over all samples


def injected(
    truths: Sequence[Performed],
    data: GNMData,
    seed: int,
    *,
    kinds: int = 2,
    turn_deg: float = 1.0,
    shift_mm: float = 2.0,
) -> Injected:
    """Rigid motions of some kinds (standard deviations as given), each sample's strengths at random."""
    head, rng = Head.of(data), np.random.default_rng(seed)
    true = np.concatenate([truth.vertices - truth.neutral for truth in truths])
    labels = [label for truth in truths for label in truth.labels]
    twists = rng.normal(size=(kinds, 2, 3))
    twists *= np.array([np.radians(turn_deg), shift_mm / MM_PER_M])[:, None] / np.linalg.norm(
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
    found = corrections(components, default_actions(components), labels, head)
    gram = np.einsum("ivc,v,jvc->ij", fields, head.area, fields)
    remains = spurious - found.twists

    def energy(motions: np.ndarray) -> float:
        return float(np.einsum("si,ij,sj->", motions, gram, motions))

    shared = sum(
        float((d * np.tensordot(twist, fields, 1)).sum(-1) @ head.area) for d, twist in zip(true, remains, strict=True)
    )
    own = float(((true**2).sum(-1) @ head.area).sum())
    return Injected(components=components, reduced=1 - energy(remains) / energy(spurious), lost=-shared / own)
