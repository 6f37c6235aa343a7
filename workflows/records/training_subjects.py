"""What a model is built from and measured on, off the disk: registrations of a run, true meshes of captures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister.evaluate.evaluation import HeldOutSubject
from coregister.next_model.training_data import NEUTRAL, TrainingMesh, TrainingSubject, transfer_to_unposed, unpose
from registration.capture.scan import read_truth
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.stabilize import stabilized_folder as stabilized
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes, subject_meshes
from registration.storage.files import atomic_file
from registration.storage.registration_folder import load_registration, read_manifest
from workflows.records.held_out import TAG
from workflows.records.subject import SubjectCaptures, UsableRegistrations, read_usable


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredSubjects:
    """Subjects of a run whose neutral is usable, with expressions where a stabilized set has them; read anew each time.

    Neutrals are unposed, and expressions laid onto them; the confidence is each registration's own.
    """

    run: Path
    names: Sequence[str]  # of the subjects' folders
    model: GNMData
    steady: Path | None  # the stabilized set; None: neutrals alone
    tags: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by folder name

    @cached_property
    def usable(self) -> dict[str, UsableRegistrations]:
        found = {name: read_usable(self.run / name) for name in self.names}
        return {name: one for name, one in found.items() if one is not None}

    @cached_property
    def inputs(self) -> dict[str, str]:
        """Content ids of everything that is read."""
        ids = {
            f"{name}/{folder}": read_manifest(self.run / name / folder).content_id
            for name, one in self.usable.items()
            for folder in (one.neutral, *(one.expressions if self.steady else ()))
        }
        return ids | ({"stabilized": stabilized.read_manifest(self.steady)["content_id"]} if self.steady else {})

    def __iter__(self) -> Iterator[TrainingSubject]:
        model, weights = GNM(self.model), SkullSkin.of(self.model).area
        places = _places(self.steady)
        for name, one in self.usable.items():
            neutral = load_registration(self.run / name / one.neutral)
            bare = unpose(neutral, model)
            expressions = []
            if self.steady is not None and one.subject in places:
                found = stabilized.read_subject(self.steady, places[one.subject])
                sure = weights * neutral.confidence
                for folder, label, vertices in zip(found.names, found.labels, found.vertices, strict=True):
                    expressions.append(
                        TrainingMesh(
                            name=folder,
                            label=label,
                            vertices=transfer_to_unposed(vertices, neutral.vertices, bare, sure),
                            confidence=load_registration(self.run / name / folder).confidence,
                            triangles=neutral.triangles,
                            digest=self.inputs[f"{name}/{folder}"],
                        )
                    )
            yield TrainingSubject(
                name=name,
                neutral=TrainingMesh(
                    name=one.neutral,
                    label=NEUTRAL,
                    vertices=bare,
                    confidence=neutral.confidence,
                    triangles=neutral.triangles,
                    digest=self.inputs[f"{name}/{one.neutral}"],
                ),
                expressions=tuple(expressions),
                tags=self.tags.get(name, {}),
            )


def _places(steady: Path | None) -> dict[str, int]:
    """Subject -> its number in the stabilized set."""
    return {} if steady is None else {name: k for k, name in enumerate(stabilized.read_manifest(steady)["subjects"])}


def has_truths(captures: SubjectCaptures, model: GNMData) -> bool:
    """Whether every capture of a subject has true vertices of the model's number. Raises InputError for broken ones."""
    truths = [capture.ground_truth for capture in captures.captures]
    count = len(model.template_vertex_positions)
    return not captures.broken and all(truth is not None and len(read_truth(truth)) == count for truth in truths)


def true_meshes(captures: SubjectCaptures, model: GNMData) -> SubjectMeshes:
    """A subject's true vertices, seen everywhere."""
    truths = [read_truth(c.ground_truth).astype(np.float32) for c in captures.captures if c.ground_truth is not None]
    others = captures.captures[1:]
    return SubjectMeshes(
        subject=captures.subject,
        neutral=truths[0],
        neutral_confidence=np.ones(len(truths[0]), np.float32),
        names=tuple(capture.root.name for capture in others),
        labels=tuple(capture.expression for capture in others),
        vertices=np.array(truths[1:], np.float32).reshape(len(others), *truths[0].shape),
        confidence=np.ones((len(others), len(truths[0])), np.float32),
    )


def registered_meshes(folder: Path, model: GNMData) -> SubjectMeshes | None:
    """The usable registrations in a subject's folder; None without a neutral. Raises InputError for broken ones."""
    one = read_usable(folder)
    if one is None:
        return None
    neutral = load_registration(folder / one.neutral)
    if one.expressions:
        rows = ((name, label, load_registration(folder / name)) for name, label in one.expressions.items())
        return subject_meshes(one.subject, neutral, rows, SkullSkin.of(model))
    return SubjectMeshes(
        subject=one.subject,
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
    """One subject to measure models on: expressions lie in the neutral's world, the skull where the neutral has it."""
    vertices: Float[np.ndarray, "S V 3"] = meshes.vertices
    if meshes.names:
        vertices = stabilize_subject(meshes, skin).vertices
    return HeldOutSubject(
        subject=name,
        neutral=meshes.neutral,
        expressions=vertices,
        categories=tuple(categories.get(label, label) for label in meshes.labels),
        tags=tags,
    )


def write_held_out(people: Sequence[HeldOutSubject], triangles: np.ndarray, file: Path) -> None:
    """The NPZ file of `gnmreg model evaluate --held-out` (docs/formats.md), in one rename; tags that all have."""
    rows = [(one, NEUTRAL, NEUTRAL, one.neutral) for one in people]
    rows += [(o, c, c, v) for o in people for c, v in zip(o.categories, o.expressions, strict=True)]
    shared = [tag for tag in (people[0].tags if people else ()) if all(tag in one.tags for one in people)]
    arrays = {TAG + tag: np.array([one.tags[tag] for one, *_ in rows]) for tag in shared}
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as temporary:
        np.savez(
            temporary,
            allow_pickle=False,
            vertices=np.array([vertices for *_, vertices in rows], np.float32),
            triangles=triangles,
            subjects=np.array([one.subject for one, *_ in rows]),
            labels=np.array([label for _, label, _, _ in rows]),
            categories=np.array([category for _, _, category, _ in rows]),
            **{name: array for name, array in arrays.items() if array.dtype.kind != "O"},
        )
