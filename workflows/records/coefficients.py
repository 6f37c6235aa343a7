"""The input of `gnmreg sampler train`: coefficients and tags, of a run or of one NPZ file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coregister.tag_groups import tag_group
from registration.capture.native import natural_key, read_capture
from registration.errors import InputError
from registration.storage.hashing import hash_file
from registration.storage.npz import NpzSchema
from registration.storage.registration_folder import SCHEMA as ARRAYS
from registration.storage.registration_folder import read_manifest
from workflows.records.held_out import TAG
from workflows.records.subject import NEUTRAL, is_subject_folder, read_subject

SCHEMA = NpzSchema(
    title="file of coefficients",
    fix="see docs/sampler.md, Coefficients",
    fields={
        "identity": ("float", "N I"),
        "expression": ("float", "N E"),
        "subjects": ("text", "N"),
        "labels": ("text", "N"),
    },
    families={TAG: ("text", "N")},
    max_bytes=2**32,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Coefficients:
    """Coefficients of registrations with their subjects, labels and tags. N registrations."""

    identity: Float[np.ndarray, "N I"]
    expression: Float[np.ndarray, "N E"]
    subjects: tuple[str, ...]
    labels: tuple[str, ...]  # of the expressions
    tags: dict[str, tuple[str, ...]]  # name -> value of each registration; "" where there is none
    model: str  # content hash of the head model; empty: unknown
    inputs: dict[str, str]  # what was read -> digest
    remarks: tuple[str, ...] = ()


def read_coefficients(source: Path, captures: Path | None, tags: Sequence[str]) -> Coefficients:
    """Read coefficients and tags.

    Args:
        source: a run of `gnmreg subject` or `gnmreg batch`, or an NPZ file.
        captures: folder of the run's subjects, each with their captures, which have the tags; not for an NPZ file.
        tags: names of the tags to read.

    Raises:
        InputError: there are no registrations; a file or record cannot be read; the subjects were registered with
            different models, or captures are missing for the tags.
    """
    source = Path(source)
    return _from_run(source, captures, tags) if source.is_dir() else _from_file(source, tags)


def _from_file(file: Path, tags: Sequence[str]) -> Coefficients:
    arrays = SCHEMA.read(file)
    count = len(arrays["subjects"])
    for name in tags:
        if TAG + name not in arrays:
            known = sorted(key.removeprefix(TAG) for key in arrays if key.startswith(TAG))
            expected = f"the array {TAG}{name}"
            raise _input_error("The file lacks a tag", file, expected, f"tags {', '.join(known) or 'none'}")
        if len(arrays[TAG + name]) != count:
            got = len(arrays[TAG + name])
            raise _input_error("A tag has another length", file, f"{TAG}{name}: {count} values", got)
    model = str(arrays["model"]) if "model" in arrays and arrays["model"].shape == () else ""
    return Coefficients(
        identity=arrays["identity"].astype(np.float32),
        expression=arrays["expression"].astype(np.float32),
        subjects=tuple(arrays["subjects"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        tags={name: tuple(arrays[TAG + name].tolist()) for name in tags},
        model=model,
        inputs={file.name: hash_file(file)},
    )


def _from_run(run: Path, captures: Path | None, tags: Sequence[str]) -> Coefficients:
    folders = sorted((p for p in run.iterdir() if is_subject_folder(p)), key=lambda folder: natural_key(folder.name))
    if not folders:
        raise _input_error("There are no registrations", run, "folders of `gnmreg subject`, or an NPZ file", "none")
    rows, models, inputs, remarks = [], set[str](), dict[str, str](), list[str]()
    for folder in folders:
        record = read_subject(folder)
        usable = None if record is None else record.usable
        if record is None or usable is None:
            remarks.append(f"{folder.name}: no usable neutral, left out")
            continue
        models.add(record.model)
        values = _tags(folder, usable.neutral, captures, tags)
        for name, label in {usable.neutral: NEUTRAL, **usable.expressions}.items():
            arrays = ARRAYS.read(folder / name / "registration.npz", only=("identity", "expression"))
            rows.append((record.subject, label, arrays["identity"], arrays["expression"], values))
            inputs[f"{folder.name}/{name}"] = read_manifest(folder / name).content_id
    if len(models) != 1:
        got = f"{len(models)} models"
        raise _input_error("The coefficients belong to different models", run, "registrations of one model", got)
    return Coefficients(
        identity=np.stack([row[2] for row in rows]).astype(np.float32),
        expression=np.stack([row[3] for row in rows]).astype(np.float32),
        subjects=tuple(row[0] for row in rows),
        labels=tuple(row[1] for row in rows),
        tags={name: tuple(row[4][name] for row in rows) for name in tags},
        model=models.pop(),
        inputs=inputs,
        remarks=tuple(remarks),
    )


def _tags(folder: Path, neutral: str, captures: Path | None, tags: Sequence[str]) -> dict[str, str]:
    """The tags of a subject's neutral capture, as groups; "" for one that it lacks."""
    if not tags:
        return {}
    if captures is None:
        fix = "give --captures, the folder of the subjects' captures, or --factors without names"
        what = "A run holds no tags"
        raise InputError(what, where="--captures", expected="the folder of the captures", got="nothing", fix=fix)
    found = read_capture(captures / folder.name / neutral).tags
    return {name: tag_group(found[name]) if name in found else "" for name in tags}


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="give another run or file")
