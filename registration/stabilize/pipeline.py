"""Both stages of stabilization over many subjects in memory; `gnmreg stabilize` does the same with subjects on disk."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from registration.frames import transform_points
from registration.model.gnm_npz import GNMData
from registration.stabilize.automatic import AutomaticSettings, stabilize_subject
from registration.stabilize.components import (
    HeadGeometry,
    RegionalComponents,
    RegionalSettings,
    regional_components,
)
from registration.stabilize.decisions import Corrections, Decision, compute_corrections, decided_actions
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes


@dataclass(frozen=True, kw_only=True)
class Stabilization:
    """Settings of both stages."""

    automatic: AutomaticSettings = field(default_factory=AutomaticSettings)
    regional: RegionalSettings = field(default_factory=RegionalSettings)


@dataclass(frozen=True, kw_only=True)
class StabilizedSubject:
    """A subject after the automatic stage or after both: S expressions, metres, the neutral's world."""

    subject: str
    names: tuple[str, ...]  # of the expressions' registrations
    labels: tuple[str, ...]  # the performed expressions
    neutral: Float[np.ndarray, "V 3"]
    T_neutral_expression: Float[np.ndarray, "S 4 4"]  # p_neutral = T_neutral_expression @ p_expression
    vertices: Float[np.ndarray, "S V 3"]  # the stabilized expressions
    confidence_map: Float[np.ndarray, "V"]  # as in `AlignedExpressions`
    residual_mm: Float[np.ndarray, "S R"]  # as in `AlignedExpressions`
    T_head_world: Float[np.ndarray, "4 4"]  # from the neutral's world to the head frame


@dataclass(frozen=True, kw_only=True)
class StabilizedSet:
    """The result of `stabilize`."""

    subjects: tuple[StabilizedSubject, ...]
    components: tuple[RegionalComponents, ...]
    corrections: Corrections


def stabilize(
    subjects: Iterable[SubjectMeshes],
    data: GNMData,
    settings: Stabilization | None = None,
    decisions: Sequence[Decision] = (),
) -> StabilizedSet:
    """Run both stages: each subject alone, then regional components over all subjects.

    Everything is in memory. For larger sets call `automatic_stage`, `regional_stage` and `apply_corrections` as
    `workflows/steps/stabilize.py` does, which keeps subjects on disk.

    Args:
        subjects: registrations of each subject.
        data: the model that the captures were registered with.
        settings: None: the defaults.
        decisions: an operator's, which replace the default actions.

    Returns:
        The subjects after both stages, in the given order.

    Raises:
        InputError: as `HeadGeometry.from_model` and `regional_stage`.
    """
    settings = settings or Stabilization()
    head, skin = HeadGeometry.from_model(data), SkullSkin.from_model(data)
    aligned = [automatic_stage(meshes, head, skin, settings) for meshes in subjects]
    components, corrections = regional_stage(lambda: iter(aligned), head, settings, decisions)
    first_sample, corrected = 0, []
    for subject in aligned:
        corrected.append(apply_corrections(subject, corrections, first_sample))
        first_sample += len(subject.names)
    return StabilizedSet(subjects=tuple(corrected), components=tuple(components), corrections=corrections)


def automatic_stage(
    meshes: SubjectMeshes, head: HeadGeometry, skin: SkullSkin, settings: Stabilization
) -> StabilizedSubject:
    """Run the automatic stage on one subject.

    Args:
        meshes: its registrations.
        head: geometry of the model.
        skin: areas of the model's skin on the skull.
        settings: of both stages.

    Returns:
        The subject's aligned expressions, as `stabilize_subject` computes them.
    """
    aligned = stabilize_subject(meshes, skin, settings.automatic)
    return StabilizedSubject(
        subject=meshes.subject,
        names=meshes.names,
        labels=meshes.labels,
        neutral=meshes.neutral,
        T_neutral_expression=aligned.T_neutral_expression,
        vertices=aligned.vertices,
        confidence_map=aligned.confidence_map,
        residual_mm=aligned.residual_mm,
        T_head_world=head.T_head_world(meshes.neutral, skin),
    )


def regional_stage(
    subjects: Callable[[], Iterator[StabilizedSubject]],
    head: HeadGeometry,
    settings: Stabilization,
    decisions: Sequence[Decision] = (),
) -> tuple[list[RegionalComponents], Corrections]:
    """Compute the components over all subjects, and the corrections of all samples.

    Args:
        subjects: returns a new iterator over the subjects after the automatic stage; called several times.
        head: geometry of the model.
        settings: of both stages.
        decisions: an operator's, which replace the default actions.

    Returns:
        Components of all regions; corrections of all samples, in the subjects' order.

    Raises:
        InputError: as `regional_components` and `decided_actions`.
    """
    labels = [label for subject in subjects() for label in subject.labels]
    components = regional_components(Displacements(subjects), labels, head, settings.regional)
    actions = decided_actions(components, decisions)
    return components, compute_corrections(components, actions, labels, head)


def apply_corrections(subject: StabilizedSubject, corrections: Corrections, first_sample: int) -> StabilizedSubject:
    """Apply the regional stage's corrections to a subject.

    Args:
        subject: after the automatic stage.
        corrections: of all subjects' samples.
        first_sample: index of the subject's first sample among all.

    Returns:
        The subject after both stages. Its transforms include the head motion, but not dropped components.
    """
    T_head_world = subject.T_head_world
    T_world_head = np.linalg.inv(T_head_world)
    vertices, transforms = [], []
    for sample, (expression, T_neutral_expression) in enumerate(
        zip(subject.vertices, subject.T_neutral_expression, strict=True), first_sample
    ):
        points = corrections.apply(transform_points(T_head_world, expression.astype(np.float64)), sample)
        vertices.append(transform_points(T_world_head, points).astype(expression.dtype))
        transforms.append(T_world_head @ corrections.T_corrected_head(sample) @ T_head_world @ T_neutral_expression)
    return StabilizedSubject(
        subject=subject.subject,
        names=subject.names,
        labels=subject.labels,
        neutral=subject.neutral,
        T_neutral_expression=np.stack(transforms),
        vertices=np.stack(vertices),
        confidence_map=subject.confidence_map,
        residual_mm=subject.residual_mm,
        T_head_world=T_head_world,
    )


class Displacements:
    """The displacement of every sample from its neutral in the head frame, metres, float32; iterable several times."""

    def __init__(self, subjects: Callable[[], Iterator[StabilizedSubject]]):
        """Wrap the subjects.

        Args:
            subjects: returns a new iterator over them.
        """
        self._subjects = subjects

    def __iter__(self) -> Iterator[Float[np.ndarray, "V 3"]]:
        """Yield the displacements in the subjects' order."""
        for subject in self._subjects():
            R_world_head = subject.T_head_world[:3, :3].T.astype(np.float32)
            for vertices in subject.vertices:
                yield (vertices - subject.neutral).astype(np.float32) @ R_world_head  # row vectors
