"""The input of `gnmreg model evaluate`: held-out subjects, as registrations of a run or as meshes in one NPZ file."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.evaluation import HeldOutSubject
from registration.capture.native import natural_key, read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.evaluate.evaluation import CLOUD_TOLERANCE
from registration.evaluate.face import face_sphere, visible_in_two_views
from registration.evaluate.folder import is_capture_of
from registration.frames import compact, local_origin
from registration.stabilize import stabilized_folder as stabilized
from registration.storage.hashing import hash_arrays, hash_capture
from registration.storage.npz import NpzSchema
from registration.storage.registration_folder import load_registration
from registration.types import Capture, Registration
from workflows.records.dataset import CATEGORY
from workflows.records.run import STABILIZED
from workflows.records.subject import MANIFEST, NEUTRAL, is_subject_folder, read_subject

TAG = "tag_"  # prefix of an NPZ file's tags
SCHEMA = NpzSchema(
    title="held-out file",
    fix="see docs/formats.md, Held-out subjects",
    fields={
        "vertices": ("float", "N V 3"),
        "triangles": ("integer", "F 3"),
        "subjects": ("text", "N"),
        "labels": ("text", "N"),
    },
    indices={"triangles": "V"},
)
CATEGORIES = "categories"  # optional, of the length N as the tags


@dataclass(frozen=True, kw_only=True)
class HeldOutSet:
    """Subjects, the topology of their meshes, and digests of what they were read from."""

    subjects: tuple[HeldOutSubject, ...]
    triangles: Int[np.ndarray, "F 3"]
    inputs: Mapping[str, str]
    warnings: tuple[str, ...] = ()  # captures that differ from those that were registered


def read_held_out(source: Path, captures: Path | None = None) -> HeldOutSet:
    """Read held-out subjects.

    Args:
        source: an NPZ file, or a run of `gnmreg subject`, from which expressions are read if it was stabilized.
        captures: folder of the run's subjects, each with their captures: adds tags, categories and scans.

    Raises:
        InputError: there are no subjects; a file, record, registration or capture cannot be read; a subject has not
            exactly one neutral; topologies differ.
    """
    source = Path(source)
    if not source.is_dir():
        return _from_file(source)
    folders = sorted(filter(is_subject_folder, source.iterdir()), key=lambda folder: natural_key(folder.name))
    if not folders:
        raise _input_error("There are no held-out subjects", source, f"folders with {MANIFEST}, or an NPZ file", "none")
    expressions = _stabilized(source / STABILIZED)
    subjects, topologies, inputs, warnings = [], [], {}, []
    for folder in folders:
        subject, registration, neutral = _from_folder(folder)
        if subject.subject in expressions:
            subject = replace(subject, **expressions[subject.subject])
        if captures is not None:
            capture_folder = Path(captures) / folder.name
            capture = read_capture(capture_folder / neutral)
            if capture.subject != subject.subject:
                warnings.append(f"{capture.root} shows {capture.subject}, {folder / neutral} {subject.subject}")
            elif not is_capture_of(registration, capture):
                warnings.append(f"{capture.root} is not the capture of {folder / neutral}, or it has changed")
            subject = _with_captures(subject, capture, registration)
            inputs[f"capture {subject.subject}"] = hash_capture(capture)
        subjects.append(around_origin(subject))
        topologies.append(registration.triangles)
    if other := [s.subject for s, t in zip(subjects, topologies, strict=True) if not np.array_equal(t, topologies[0])]:
        got = f"another of {other[0]}"
        raise _input_error("The held-out subjects have different topologies", source, "one topology", got)
    inputs["held_out"] = _digest(subjects)
    return HeldOutSet(subjects=tuple(subjects), triangles=topologies[0], inputs=inputs, warnings=tuple(warnings))


def around_origin(subject: HeldOutSubject) -> HeldOutSubject:
    """Return the same subject in a frame whose origin is near: models are fitted in float32."""
    origin = local_origin(subject.neutral.mean(0))
    if not origin.any():
        return subject
    return replace(
        subject,
        neutral=compact(subject.neutral - origin),
        expressions=compact(subject.expressions - origin),
        scan=None if subject.scan is None else subject.scan - origin,
    )


def _digest(subjects: Sequence[HeldOutSubject]) -> str:
    arrays: list[np.ndarray] = []
    for subject in subjects:
        tags = json.dumps(dict(subject.tags), sort_keys=True, default=str)
        arrays += [subject.neutral, subject.expressions, np.array([subject.subject, *subject.categories, tags])]
    return hash_arrays(*arrays)


def _from_file(file: Path) -> HeldOutSet:
    arrays = SCHEMA.read(file)
    count = len(arrays["vertices"])
    for name in (name for name in arrays if name.startswith(TAG) or name == CATEGORIES):
        if arrays[name].shape != (count,):
            got = f"shape {arrays[name].shape}"
            raise _input_error("The held-out meshes are incomplete", f"{file}, {name}", f"{count} entries", got)
    names = dict.fromkeys(arrays["subjects"].tolist())
    subjects = tuple(_from_rows(name, np.flatnonzero(arrays["subjects"] == name), arrays, file) for name in names)
    triangles = arrays["triangles"].astype(np.int64)
    return HeldOutSet(subjects=subjects, triangles=triangles, inputs={"held_out": _digest(subjects)})


def _from_rows(
    subject: str, rows: Int[np.ndarray, "M"], arrays: Mapping[str, np.ndarray], file: Path
) -> HeldOutSubject:
    """One subject, from the rows of their meshes."""
    labels = arrays["labels"]
    neutral = [int(row) for row in rows if labels[row] == NEUTRAL]
    if len(neutral) != 1:
        expected = f'one mesh labelled "{NEUTRAL}" per subject'
        raise _input_error("A held-out subject has not one neutral", file, expected, f"{len(neutral)} of {subject}")
    others = [int(row) for row in rows if row != neutral[0]]
    categories = arrays.get(CATEGORIES, labels).astype(str)
    held_out = HeldOutSubject(
        subject=subject,
        neutral=arrays["vertices"][neutral[0]],
        expressions=arrays["vertices"][others],
        categories=tuple(categories[others].tolist()),
        tags={n.removeprefix(TAG): v[neutral[0]].item() for n, v in arrays.items() if n.startswith(TAG)},
    )
    return around_origin(held_out)


def _from_folder(folder: Path) -> tuple[HeldOutSubject, Registration, str]:
    """A subject's neutral, its registration and the name of its folder."""
    record = read_subject(folder)
    assert record is not None, "it is a subject folder"
    neutral = record.row(record.neutral)
    if neutral is None or not neutral.usable:
        got = "none" if neutral is None else neutral.status
        expected = f"a usable registration {record.neutral!r}"
        raise _input_error("A held-out subject has no neutral", folder / MANIFEST, expected, got)
    registration = load_registration(folder / record.neutral)
    vertices = registration.vertices
    subject = HeldOutSubject(subject=record.subject, neutral=vertices, expressions=vertices[None][:0])
    return subject, registration, neutral.name


def _stabilized(folder: Path) -> dict[str, dict[str, Any]]:
    """By subject: neutral, expressions and their labels, in one frame. Empty if the run was not stabilized."""
    if not os.path.lexists(folder / stabilized.MANIFEST):
        return {}
    count = len(stabilized.read_manifest(folder).subjects)
    subjects = (stabilized.read_subject(folder, number) for number in range(count))
    return {
        subject.subject: {
            "neutral": subject.neutral,
            "expressions": subject.vertices,
            "categories": subject.labels,
        }
        for subject in subjects
    }


def _with_captures(subject: HeldOutSubject, capture: Capture, registration: Registration) -> HeldOutSubject:
    """Add the tags and the scan of the neutral's capture, and the categories that captures beside it have."""
    labels = {}
    for path in sorted(path.parent for path in capture.root.parent.glob("*/capture.toml")):
        other = read_capture(path)
        labels[other.expression] = str(other.tags.get(CATEGORY, other.expression))
    scan: Float[np.ndarray, "P 3"] | None = None
    if capture.scan is not None:
        points = read_scan(capture.scan)
        cameras = [view.camera for view in capture.views]
        face = face_sphere(capture, registration).contains(points.vertices)
        surface = points if len(points.triangles) else registration
        tolerance = () if len(points.triangles) else (CLOUD_TOLERANCE,)
        occluder = surface.vertices.astype(np.float64), surface.triangles
        face &= visible_in_two_views(points.vertices, *occluder, cameras, *tolerance)
        scan = points.vertices[face].astype(np.float64)
    categories = tuple(labels.get(label, label) for label in subject.categories)
    return replace(subject, tags=capture.tags, categories=categories, scan=scan)


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=SCHEMA.fix)
