"""Subjects that a model is built from or evaluated on: registrations of a run, true meshes of captures."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister.evaluate.evaluation import HeldOutSubject
from coregister.next_model.training_data import TrainingMesh, TrainingSubject, skull_weights, unpose, unposed_expression
from registration.capture.scan import read_truth
from registration.frames import compact
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.stabilize import stabilized_folder as stabilized
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes, subject_meshes
from registration.storage.files import atomic_file
from registration.storage.registration_folder import load_registration, read_manifest
from workflows.records.held_out import TAG, around_origin
from workflows.records.subject import NEUTRAL, SubjectCaptures, UsableRegistrations, read_usable, read_usable_subjects


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredSubjects:
    """The training subjects of a run: those with a usable neutral, with the expressions of a stabilized set.

    An iterable; every iteration reads the meshes from disk. Neutrals are in the bind pose, and expressions aligned with
    them; the confidence is that of each registration.
    """

    run: Path
    names: Sequence[str]  # of the subjects' folders
    model: GNMData
    stabilized_set: Path | None  # the stabilized set; None: neutrals alone
    tags: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by folder name
    left_out: Collection[str] = ()  # registrations that are not used, as SUBJECT/NAME of the folders
    # Of a registration's figures, those that say whether it is an outlier (`TrainingMesh.figures`).
    figures_of: Callable[[Mapping[str, Any]], Mapping[str, float]] = lambda _: {}

    @cached_property
    def usable(self) -> dict[str, UsableRegistrations]:
        """Folder name -> usable registrations, of the subjects that have any. Raises InputError for broken records."""
        return read_usable_subjects(self.run, self.names, self.left_out)

    @cached_property
    def inputs(self) -> dict[str, str]:
        """Content ids of everything that an iteration reads."""
        ids = {
            f"{name}/{folder}": read_manifest(self.run / name / folder).content_id
            for name, usable in self.usable.items()
            for folder in (usable.neutral, *(usable.expressions if self.stabilized_set else ()))
        }
        if self.stabilized_set:
            ids["stabilized"] = stabilized.read_manifest(self.stabilized_set).content_id
        return ids

    def __iter__(self) -> Iterator[TrainingSubject]:
        model, weights = GNM(self.model), skull_weights(self.model)
        numbers = _subject_numbers(self.stabilized_set)
        for name, usable in self.usable.items():
            neutral = load_registration(self.run / name / usable.neutral)
            unposed = unpose(neutral, model)
            expressions = []
            if self.stabilized_set is not None and usable.subject in numbers:
                meshes = stabilized.read_subject(self.stabilized_set, numbers[usable.subject])
                columns = meshes.names, meshes.labels, meshes.vertices, meshes.T_neutral_expression
                for folder, label, vertices, T in zip(*columns, strict=True):
                    registration = load_registration(self.run / name / folder)
                    expressions.append(
                        TrainingMesh(
                            name=folder,
                            label=label,
                            vertices=unposed_expression(registration, vertices, T, neutral, model, weights),
                            confidence=registration.confidence,
                            triangles=neutral.triangles,
                            digest=self.inputs[f"{name}/{folder}"],
                            figures=self.figures_of(registration.figures),
                        )
                    )
            yield TrainingSubject(
                name=name,
                neutral=TrainingMesh(
                    name=usable.neutral,
                    label=NEUTRAL,
                    vertices=unposed,
                    confidence=neutral.confidence,
                    triangles=neutral.triangles,
                    digest=self.inputs[f"{name}/{usable.neutral}"],
                ),
                expressions=tuple(expressions),
                tags=self.tags.get(name, {}),
            )


def _subject_numbers(stabilized_set: Path | None) -> dict[str, int]:
    """Subject -> number in the stabilized set."""
    return (
        {}
        if stabilized_set is None
        else {name: k for k, name in enumerate(stabilized.read_manifest(stabilized_set).subjects)}
    )


def has_truths(captures: SubjectCaptures, model: GNMData) -> bool:
    """Return whether all captures of a subject have ground truths with the model's number of vertices.

    Raises:
        InputError: a ground truth cannot be read.
    """
    truths = [capture.ground_truth for capture in captures.captures]
    count = len(model.template_vertex_positions)
    return not captures.broken and all(truth is not None and len(read_truth(truth)) == count for truth in truths)


def true_meshes(captures: SubjectCaptures, model: GNMData) -> SubjectMeshes:
    """Return a subject's true vertices, with full confidence. All captures must have a ground truth."""
    truths = [compact(read_truth(c.ground_truth)) for c in captures.captures if c.ground_truth is not None]
    others = captures.captures[1:]
    return SubjectMeshes(
        subject=captures.subject,
        neutral=truths[0],
        neutral_confidence=np.ones(len(truths[0]), np.float32),
        names=tuple(capture.root.name for capture in others),
        labels=tuple(capture.expression for capture in others),
        vertices=np.array(truths[1:], truths[0].dtype).reshape(len(others), *truths[0].shape),
        confidence=np.ones((len(others), len(truths[0])), np.float32),
    )


def registered_meshes(folder: Path, model: GNMData) -> SubjectMeshes | None:
    """Return the usable registrations in a subject's folder; None without a usable neutral.

    Raises:
        InputError: the record or a registration cannot be read.
    """
    usable = read_usable(folder)
    if usable is None:
        return None
    neutral = load_registration(folder / usable.neutral)
    if usable.expressions:
        rows = ((name, label, load_registration(folder / name)) for name, label in usable.expressions.items())
        return subject_meshes(usable.subject, neutral, rows, SkullSkin.from_model(model))
    return SubjectMeshes(
        subject=usable.subject,
        neutral=neutral.vertices,
        neutral_confidence=neutral.confidence,
        names=(),
        labels=(),
        vertices=neutral.vertices[None][:0],
        confidence=neutral.confidence[None][:0],
    )


def held_out(
    name: str, meshes: SubjectMeshes, skin: SkullSkin, categories: Mapping[str, str], tags: Mapping[str, Any]
) -> HeldOutSubject:
    """Return a held-out subject whose expressions are stabilized: their skull is aligned with the neutral's.

    Args:
        name: of the subject's folder.
        meshes: of the subject.
        skin: of the model, for stabilization.
        categories: expression label -> category; other labels are their own category.
        tags: of the subject.
    """
    vertices: Float[np.ndarray, "S V 3"] = meshes.vertices
    if meshes.names:
        vertices = stabilize_subject(meshes, skin).vertices
    subject = HeldOutSubject(
        subject=name,
        neutral=meshes.neutral,
        expressions=vertices,
        categories=tuple(categories.get(label, label) for label in meshes.labels),
        tags=tags,
    )
    return around_origin(subject)


def write_held_out(subjects: Sequence[HeldOutSubject], triangles: np.ndarray, file: Path) -> None:
    """Write the NPZ file of `gnmreg model evaluate --held-out` (docs/formats.md), in one rename.

    Args:
        subjects: to be written; of their tags, those that all of them have.
        triangles: (F, 3), of all meshes.
        file: to write.
    """
    rows = [(subject, NEUTRAL, NEUTRAL, subject.neutral) for subject in subjects]
    rows += [(s, c, c, v) for s in subjects for c, v in zip(s.categories, s.expressions, strict=True)]
    shared = [tag for tag in (subjects[0].tags if subjects else ()) if all(tag in s.tags for s in subjects)]
    arrays = {TAG + tag: np.array([subject.tags[tag] for subject, *_ in rows]) for tag in shared}
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as temporary:
        np.savez(
            temporary,
            allow_pickle=False,
            vertices=np.array([vertices for *_, vertices in rows], np.float32),
            triangles=triangles,
            subjects=np.array([subject.subject for subject, *_ in rows]),
            labels=np.array([label for _, label, _, _ in rows]),
            categories=np.array([category for _, _, category, _ in rows]),
            **{name: array for name, array in arrays.items() if array.dtype.kind != "O"},
        )
