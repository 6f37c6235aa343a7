"""Both stages over the registrations of many subjects, as plain functions: the command does the same, on disk."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from registration.frames import transform_points
from registration.model.gnm_npz import GNMData
from registration.stabilize.automatic import Automatic, Stabilized, stabilize_subject
from registration.stabilize.components import Components, Head, Regional, regional_components
from registration.stabilize.decisions import Corrections, Decision, corrections, decided_actions
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes


@dataclass(frozen=True, kw_only=True)
class Stabilization:
    """The resolved configuration of both stages."""

    automatic: Automatic = field(default_factory=Automatic)
    regional: Regional = field(default_factory=Regional)


@dataclass(frozen=True, kw_only=True)
class StabilizedSubject:
    """A subject after the automatic stage, or after both: metres, the world of its neutral."""

    subject: str
    names: tuple[str, ...]
    labels: tuple[str, ...]
    neutral: Float[np.ndarray, "V 3"]
    T_neutral_expression: Float[np.ndarray, "S 4 4"]
    vertices: Float[np.ndarray, "S V 3"]  # the expressions, stabilized
    confidence_map: Float[np.ndarray, "V"]  # as `Stabilized` has it
    residual_mm: Float[np.ndarray, "S R"]
    T_head_world: Float[np.ndarray, "4 4"]  # lays the neutral onto the model's template, about the head's centre


@dataclass(frozen=True, kw_only=True)
class StabilizedSet:
    """What `stabilize` returns."""

    subjects: tuple[StabilizedSubject, ...]
    components: tuple[Components, ...]
    corrections: Corrections


def stabilize(
    subjects: Iterable[SubjectMeshes],
    data: GNMData,
    settings: Stabilization | None = None,
    decisions: Sequence[Decision] = (),
) -> StabilizedSet:
    """Both stages: every subject by itself, then regional components over all, corrected by default or as decided.

    Everything is held in memory: for larger sets call `automatic_stage`, `regional_stage` and `corrected` as
    `workflows/steps/stabilize.py` does, which keeps subjects on disk. Raises InputError as these do.
    """
    settings = settings or Stabilization()
    head, skin = Head.of(data), SkullSkin.of(data)
    steady = [automatic_stage(meshes, head, skin, settings) for meshes in subjects]
    components, correction = regional_stage(lambda: iter(steady), head, settings, decisions)
    first, final = 0, []
    for subject in steady:
        final.append(corrected(subject, correction, first))
        first += len(subject.names)
    return StabilizedSet(subjects=tuple(final), components=tuple(components), corrections=correction)


def automatic_stage(meshes: SubjectMeshes, head: Head, skin: SkullSkin, settings: Stabilization) -> StabilizedSubject:
    """One subject."""
    found: Stabilized = stabilize_subject(meshes, skin, settings.automatic)
    return StabilizedSubject(
        subject=meshes.subject,
        names=meshes.names,
        labels=meshes.labels,
        neutral=meshes.neutral,
        T_neutral_expression=found.T_neutral_expression,
        vertices=found.vertices,
        confidence_map=found.confidence_map,
        residual_mm=found.residual_mm,
        T_head_world=head.T_head_world(meshes.neutral, skin),
    )


def regional_stage(
    subjects: Callable[[], Iterator[StabilizedSubject]],
    head: Head,
    settings: Stabilization,
    decisions: Sequence[Decision] = (),
) -> tuple[list[Components], Corrections]:
    """All subjects, read several times: components, and what is taken from every sample, in the subjects' order.

    Raises InputError as `regional_components` and `decided_actions`.
    """
    labels = [label for subject in subjects() for label in subject.labels]
    components = regional_components(Displacements(subjects), labels, head, settings.regional)
    actions = decided_actions(components, decisions)
    return components, corrections(components, actions, labels, head)


def corrected(subject: StabilizedSubject, correction: Corrections, first: int) -> StabilizedSubject:
    """A subject after the regional stage; `first` is the number of its first sample in the whole set."""
    T_head_world = subject.T_head_world
    T_world_head = np.linalg.inv(T_head_world)
    vertices, transforms = [], []
    for number, (head, T_neutral_expression) in enumerate(
        zip(subject.vertices, subject.T_neutral_expression, strict=True), first
    ):
        points = correction.corrected(transform_points(T_head_world, head.astype(np.float64)), number)
        vertices.append(transform_points(T_world_head, points).astype(np.float32))
        transforms.append(T_world_head @ correction.T_head_head(number) @ T_head_world @ T_neutral_expression)
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
    """Every sample's displacement from its neutral in the head's frame, metres, float32: to be read again and again."""

    def __init__(self, subjects: Callable[[], Iterator[StabilizedSubject]]):
        self._subjects = subjects

    def __iter__(self) -> Iterator[Float[np.ndarray, "V 3"]]:
        for subject in self._subjects():
            turn = subject.T_head_world[:3, :3].T.astype(np.float32)
            for vertices in subject.vertices:
                yield (vertices - subject.neutral) @ turn
