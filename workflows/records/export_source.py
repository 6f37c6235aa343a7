"""The source of `gnmreg export`: which folder or file it is, the model that belongs to it, and its head."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.export.head_mesh import HeadMesh
from registration.export.options import ExportOptions
from registration.export.registrations import (
    T_out_world,
    check_usable,
    head_of_model,
    head_of_registration,
    with_arkit,
    with_expressions,
    with_filled_texture,
    with_frames,
)
from registration.frames import transform_points
from registration.model import gnm_npz
from registration.model.fetch import cached_path
from registration.model.gnm_npz import GNMData
from registration.stabilize import stabilized_folder
from registration.stabilize.components import HeadGeometry
from registration.stabilize.pipeline import Stabilization, automatic_stage
from registration.stabilize.subject_meshes import SkullSkin, subject_meshes
from registration.storage.cache import cache_folder
from registration.storage.registration_folder import is_registration, load_registration, read_manifest
from registration.types import Registration
from workflows.records.subject import SubjectRecord, is_subject_folder, read_subject


@dataclass(frozen=True, kw_only=True)
class ExportSource:
    """What is exported."""

    head: HeadMesh
    notes: tuple[str, ...] = ()  # for people


def read_source(
    source: Path,
    model: Path | None,
    options: ExportOptions = ExportOptions(),  # noqa: B008  frozen
) -> ExportSource:
    """Read what is to be exported.

    Args:
        source: a registration folder; a subject's folder of registrations; a stabilized set; a folder of registrations,
            which is a sequence; or a model's NPZ file.
        model: file of the head model of the registrations; None: the one that they name, or the cached one.
        options: of the export.

    Raises:
        InputError: it is nothing of this kind, it cannot be read, a registration failed, topologies differ, or the
            model is not found.
    """
    if options.subject is not None and not stabilized_folder.is_stabilized(source):
        raise _needless("--subject", source, "a stabilized set")
    if source.is_file():
        return _model(source, model, options)
    if is_registration(source):
        return _registration(source, model, options)
    if options.arkit and source.is_dir():
        raise _needless("--arkit", source, "a model, or the registration of a neutral")
    if is_subject_folder(source):
        return _subject(source, model, options)
    if stabilized_folder.is_stabilized(source):
        return _stabilized(source, model, options)
    if source.is_dir() and (frames := [path for path in source.iterdir() if is_registration(path)]):
        return _sequence(sorted(frames, key=lambda path: natural_key(path.name)), model, options)
    run = source.is_dir() and any(is_subject_folder(path) for path in source.iterdir())
    raise InputError(
        "There is nothing to export",
        where=source,
        expected="a registration folder, a subject's folder, a stabilized set, a folder of registrations, or a model",
        got="a run of several subjects" if run else "other contents" if source.is_dir() else "no such file or folder",
        fix="give the folder of one of its subjects" if run else "give a folder that gnmreg wrote",
    )


def holds(source: Path, options: ExportOptions) -> dict[str, bool]:
    """Return whether the head of a source has shapes, or is a sequence, by a look at the folder alone.

    Args:
        source: as of `read_source`; anything else holds neither.
        options: of the export.
    """
    expressions = is_subject_folder(source) or stabilized_folder.is_stabilized(source)
    single = source.is_file() or is_registration(source)
    several = (
        not (expressions or single) and source.is_dir() and any(is_registration(path) for path in source.iterdir())
    )
    return {
        "shapes": options.arkit if single else expressions and not options.sequence,
        "frames": several or (expressions and options.sequence),
    }


def _model(file: Path, model: Path | None, options: ExportOptions) -> ExportSource:
    for option, given in (("--fill", options.fills), ("--sequence", options.sequence), ("--model", model is not None)):
        if given:
            raise _needless(option, file, "registrations")
    data = gnm_npz.read(file)
    head = head_of_model(data, name=file.stem, shapes={})
    return _with_arkit(head, data, options) if options.arkit else ExportSource(head=head)


def _registration(folder: Path, model: Path | None, options: ExportOptions) -> ExportSource:
    registration = load_registration(folder)
    if options.sequence:
        raise _needless("--sequence", folder, "a subject's folder or a stabilized set")
    if options.arkit and "neutral" in registration.inputs:  # of which it is an expression
        raise _needless("--arkit", folder, "a model, or the registration of a neutral")
    data = find_model(registration, model, folder)
    found = _textured(registration, data, folder.name, options)
    if not options.arkit:
        return found
    shaped = _with_arkit(found.head, data, options, float(registration.scale))
    return ExportSource(head=shaped.head, notes=(*found.notes, *shaped.notes))


def _textured(registration: Registration, data: GNMData, name: str, options: ExportOptions) -> ExportSource:
    """A registration's head, its texture filled if the options say so."""
    head = head_of_registration(registration, data, name=name, options=options)
    if not options.fills:
        return ExportSource(head=head)
    others = [(str(folder), load_registration(folder)) for folder in options.fill_from]
    for folder, other in others:
        check_usable(other, folder, options)
    filled, notes = with_filled_texture(head, registration, data.mirror_indices.astype(np.int64), others)
    return ExportSource(head=filled, notes=tuple(notes))


def _with_arkit(head: HeadMesh, data: GNMData, options: ExportOptions, scale: float = 1.0) -> ExportSource:
    shaped, notes = with_arkit(head, data, options, scale)
    return ExportSource(head=shaped, notes=tuple(notes))


def _needless(option: str, where: Path, expected: str) -> InputError:
    """The error for an option that has no meaning for a source."""
    return InputError(
        f"{option} has no meaning for this source",
        where=where,
        expected=expected,
        got="another source",
        fix=f"leave out {option}, or give {expected}",
    )


def _subject(folder: Path, model: Path | None, options: ExportOptions) -> ExportSource:
    """A subject's neutral with the expressions, each without the motion of the head against the neutral."""
    record = read_subject(folder)
    assert record is not None, "it is a subject's folder"
    names, notes = _usable(record, folder, options)
    neutral = load_registration(folder / record.neutral)
    data = find_model(neutral, model, folder / record.neutral)
    rest = _textured(neutral, data, record.subject, options)
    head, notes = rest.head, (*notes, *rest.notes)
    if not names:
        return ExportSource(head=head, notes=(*notes, "the subject has no expressions"))
    skin = SkullSkin.from_model(data)

    def expressions() -> Iterator[tuple[str, str, Registration]]:
        for name, label in names.items():
            registration = load_registration(folder / name)
            check_usable(registration, folder / name, options)
            yield name, label, replace(registration, status="stopped")  # a failed one that the user wants is used

    meshes = subject_meshes(record.subject, replace(neutral, status="stopped"), expressions(), skin)
    aligned = automatic_stage(meshes, HeadGeometry.from_model(data), skin, Stabilization())
    posed = zip(_titles(meshes.names, meshes.labels), aligned.vertices, strict=True)
    T = T_out_world(neutral.vertices, data, options)
    return ExportSource(head=with_expressions(head, posed, T, options), notes=notes)


def _usable(record: SubjectRecord, folder: Path, options: ExportOptions) -> tuple[dict[str, str], tuple[str, ...]]:
    """The expressions to export, folder name -> label, and notes on those that are not. Raises InputError."""
    kept: dict[str, str] = {}
    notes = []
    for row in record.rows:
        present = row.usable or (row.status == "failed" and options.failed == "export")
        if present and row.name != record.neutral:
            kept[row.name] = row.expression
        elif not present and (options.failed != "skip" or row.name == record.neutral):
            raise InputError(
                "A subject's registration failed or is missing",
                where=folder / row.name,
                expected="converged or stopped",
                got=f"{row.status} {row.reason}".strip(),
                fix="register again with `gnmreg subject`"
                + ("" if row.name == record.neutral else ", or leave it out with --failed skip"),
            )
        elif not present:
            notes.append(f"left out: {row.name} ({row.status}: {row.reason})")
    return kept, tuple(notes)


def _stabilized(folder: Path, model: Path | None, options: ExportOptions) -> ExportSource:
    """A subject of a stabilized set, with the texture of the neutral's registration if that lies beside the set."""
    manifest = stabilized_folder.read_manifest(folder)
    number = _chosen(manifest.subjects, options.subject, folder)
    subject = stabilized_folder.read_subject(folder, number)
    found = _neutral_registration(folder.parent, subject.subject, manifest.inputs)
    if found is None and options.fills:
        raise _needless("--fill", folder, "a stabilized set in the folder of its registrations")
    if found is None:
        data = find_model(None, model, folder, content=manifest.inputs.get("model"))
        head = head_of_model(data, name=subject.subject, shapes={})
        notes: tuple[str, ...] = ("there is no texture: the neutral's registration is not beside the stabilized set",)
    else:
        neutral = load_registration(found)
        data = find_model(neutral, model, found)
        rest = _textured(neutral, data, subject.subject, options)
        head, notes = rest.head, rest.notes
    if len(subject.neutral) != head.topology.vertex_count:
        raise InputError(
            "The model has another topology than the stabilized set",
            where=folder,
            expected=f"{len(subject.neutral)} vertices",
            got=f"a model of {head.topology.vertex_count}",
            fix="give the model of the registrations with --model",
        )
    T = T_out_world(subject.neutral, data, options)
    head = replace(head, vertices=transform_points(T, subject.neutral.astype(np.float64)))
    posed = zip(_titles(subject.names, subject.labels), subject.vertices, strict=True)
    return ExportSource(head=with_expressions(head, posed, T, options), notes=notes)


def _chosen(subjects: tuple[str, ...], name: str | None, where: Path) -> int:
    if name in subjects or (name is None and len(subjects) == 1):
        return 0 if name is None else subjects.index(name)
    raise InputError(
        "The stabilized set has several subjects" if name is None else "There is no such subject",
        where=where,
        expected=f"one of {', '.join(subjects)}",
        got=name or "none",
        fix="choose one with --subject",
    )


def _neutral_registration(run: Path, subject: str, inputs: Mapping[str, str]) -> Path | None:
    """The folder of a subject's neutral in a run, if it is the one that was stabilized."""
    for folder in (run, *sorted(run.iterdir())):
        record = read_subject(folder) if folder.is_dir() and is_subject_folder(folder) else None
        if record is not None and record.subject == subject and is_registration(folder / record.neutral):
            content = read_manifest(folder / record.neutral).content_id
            return folder / record.neutral if inputs.get(f"{subject}/{record.neutral}") == content else None
    return None


def _sequence(folders: list[Path], model: Path | None, options: ExportOptions) -> ExportSource:
    """Registrations as frames, in the world of the first; moved to the head frame as that one is."""
    notes = []
    head: HeadMesh | None = None
    frames: list[Float[np.ndarray, "V 3"]] = []
    for folder in folders:
        registration = load_registration(folder)
        if registration.status == "failed" and options.failed == "skip":
            notes.append(f"left out: {folder.name} (failed: {registration.reason})")
            continue
        if head is None:
            data = find_model(registration, model, folder)
            rest = _textured(registration, data, folder.parent.name, options)
            head = rest.head
            notes += rest.notes
            T = T_out_world(registration.vertices, data, options)
            notes.append(f"the texture is that of {folder.name}, the first frame")
        check_usable(registration, folder, options)
        head.topology.check(registration.triangles, folder)
        frames.append(transform_points(T, registration.vertices.astype(np.float64)))
    if head is None:
        got = "failed ones only"
        raise InputError("There is nothing to export", where=folders[0].parent, expected="a registration", got=got)
    return ExportSource(head=with_frames(head, frames, options), notes=tuple(notes))


def _titles(names: tuple[str, ...], labels: tuple[str, ...]) -> tuple[str, ...]:
    """Names of shapes: the expressions' labels if they are different, else the folders' names."""
    return labels if all(labels) and len(set(labels)) == len(labels) else names


def find_model(
    registration: Registration | None, given: Path | None, where: Path, content: str | None = None
) -> GNMData:
    """Return the model that a registration was made with.

    Args:
        registration: names its model's file, and the digest of its content; None: only the digest is known.
        given: the model's file; any of the same topology. None: look where the registration names it, and in the cache.
        where: the registration's folder, for messages.
        content: digest of the model, without a registration.

    Raises:
        InputError: the given file is no model or has another topology; or there is none of that content.
    """
    if given is not None:
        data = gnm_npz.read(given)
        if registration is not None:
            _check_topology(data, registration, given)
        return data
    named = None
    if registration is not None:
        content, named = registration.inputs.get("model"), registration.provenance.get("model")
    candidates = [Path(named)] if named else []
    for file in (*candidates, cached_path(), *sorted(cache_folder().glob("first-*/*.npz"))):
        if file.is_file():
            try:
                data = gnm_npz.read(file)
            except InputError:
                continue  # another file has taken its place
            if gnm_npz.content_hash(data) == content:
                return data
    raise InputError(
        "The head model of this registration is not found",
        where=where,
        expected="the model where it was when the capture was registered, or in the cache",
        got=f"no model of sha256 {str(content)[:16]}" + (f" at {named}" if named else ""),
        fix="give its file with --model",
    )


def _check_topology(data: GNMData, registration: Registration, given: Path) -> None:
    if gnm_npz.topology_hash(data.triangles) != gnm_npz.topology_hash(registration.triangles):
        raise InputError(
            "The model has another topology than the registration",
            where=given,
            expected=f"the registration's {len(registration.triangles)} triangles, in their order",
            got=f"{len(data.triangles)} triangles, or another order",
            fix="give the model that the capture was registered with",
        )
