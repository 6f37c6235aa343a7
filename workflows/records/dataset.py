"""A dataset on disk: a folder of subject folders with capture folders; and its division into training and held-out
subjects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.storage.reading import read_list
from registration.storage.records import Record
from workflows.records.subject import NEUTRAL, SubjectCaptures, read_captures

MANIFEST = "dataset.json"
CATEGORY, HELD_OUT = "category", "held_out"  # tags that describe captures, not subjects
MIN_SUBJECTS = 2  # on either side: a basis needs two heads, a confidence interval two subjects


@dataclass(frozen=True, kw_only=True)
class DatasetRecord(Record, kind="gnm-dataset", title="dataset's record", fix="correct it"):
    """`dataset.json`. All but the first two fields are of a synthetic dataset."""

    complete: bool  # all captures exist
    categories: Mapping[str, str] | None = None  # permitted expression label -> category; None: any label
    seeds: Mapping[str, int] = field(default_factory=dict)  # subject -> seed
    held_out: tuple[str, ...] = ()
    expressions: tuple[str, ...] = ()
    studio: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Subjects by folder name, in natural order; only headers were read."""

    folder: Path
    subjects: Mapping[str, SubjectCaptures]
    categories: Mapping[str, str] = field(default_factory=dict)  # label of an expression -> its category
    closed: bool = False  # other labels are refused

    def tags(self, name: str) -> dict[str, Any]:
        """Return a subject's tags: those of its neutral's capture that do not describe captures."""
        tags = self.subjects[name].captures[0].tags
        return {tag: value for tag, value in tags.items() if tag not in (CATEGORY, HELD_OUT)}


@dataclass(frozen=True, kw_only=True)
class Split:
    """The subjects that models are built from, and those that they are evaluated on, by folder name."""

    training: tuple[str, ...]
    held_out: tuple[str, ...]
    how: str  # how they were chosen, in words


def read_dataset(folder: Path) -> Dataset:
    """Read the headers of all subjects' captures below `folder`, except hidden folders and those without captures.

    Raises:
        InputError: there is no such folder, or no subject in it; `dataset.json` is malformed, or says that captures are
            missing; a subject has no neutral, captures of several subjects, or two folders; a label is not permitted.
    """
    folder = Path(folder)
    record = _record(folder)
    below = sorted(folder.iterdir(), key=lambda path: natural_key(path.name)) if folder.is_dir() else []
    folders = [p for p in below if not p.name.startswith(".") and any(p.glob("*/capture.toml"))]
    if not folders:
        raise InputError(
            "There are no subjects",
            where=folder,
            expected="a folder of subject folders, each of capture folders",
            got="a subject" if any(folder.glob("*/capture.toml")) else "none" if below else "no such folder",
            fix="give the folder that holds the subjects' folders",
        )
    subjects = {path.name: read_captures(path) for path in folders}
    owners: dict[str, str] = {}
    for name, captures in subjects.items():
        if captures.subject in owners:
            raise InputError(
                "Two folders hold the same subject",
                where=folder,
                expected="one folder per subject",
                got=f"{captures.subject} in {owners[captures.subject]} and {name}",
                fix="move the captures into one folder, or correct `subject` in their capture.toml files",
            )
        owners[captures.subject] = name
    every = [(name, capture) for name, captures in subjects.items() for capture in captures.captures]
    if record is not None and record.categories is not None:
        _check_labels(folder, {f"{name}/{c.root.name}": c.expression for name, c in every}, record.categories)
        return Dataset(folder=folder, subjects=subjects, categories=record.categories, closed=True)
    categories = {c.expression: str(c.tags.get(CATEGORY, c.expression)) for _, c in every if c.expression != NEUTRAL}
    return Dataset(folder=folder, subjects=subjects, categories=categories)


def split(dataset: Dataset, held_out: float | Path | None = None, seed: int = 0) -> Split:
    """Divide a dataset into training and held-out subjects.

    Args:
        dataset: to be divided.
        held_out: the fraction of subjects to hold out, sampled with the seed; or a file with one folder name per line;
            None: those whose neutral's capture has the tag `held_out = true`, or a fifth if none has.
        seed: of the sampling.

    Raises:
        InputError: the fraction is out of range, the file cannot be read or names an unknown subject, or there are
            fewer than MIN_SUBJECTS on either side.
    """
    names = tuple(dataset.subjects)
    tagged = tuple(n for n in names if dataset.subjects[n].captures[0].tags.get(HELD_OUT) is True)
    if held_out is None and tagged:
        chosen, how = tagged, "by the tag held_out"
    elif held_out is None or isinstance(held_out, float):
        fraction = 0.2 if held_out is None else held_out
        if not 0 < fraction < 1:
            raise _input_error("The fraction to hold out is out of range", "held-out", "between 0 and 1", fraction)
        count = max(MIN_SUBJECTS, round(fraction * len(names)))
        sampled = np.random.default_rng(seed).permutation(len(names))[:count].tolist()
        chosen, how = tuple(names[k] for k in sorted(sampled)), f"a fraction of {fraction:g} by seed {seed}"
    else:
        chosen, how = _listed(Path(held_out), names), f"by the list {Path(held_out).name}"
    training = tuple(name for name in names if name not in chosen)
    for what, side in (("to build a model from", training), ("to hold out", chosen)):
        if len(side) < MIN_SUBJECTS:
            expected = f"at least {MIN_SUBJECTS} {what} of the {len(names)} in {dataset.folder}"
            raise _input_error(f"There are too few subjects {what}", "held-out", expected, ", ".join(side) or "none")
    return Split(training=training, held_out=chosen, how=how)


def _listed(file: Path, names: Sequence[str]) -> tuple[str, ...]:
    fix = "give a fraction such as 0.2, or a file with one folder name per line"
    listed = read_list(file, partial(InputError, "The held-out subjects cannot be read", where=file, fix=fix))
    if unknown := [name for name in listed if name not in names]:
        raise _input_error("There is no such subject to hold out", file, ", ".join(names[:8]), unknown[0])
    return tuple(name for name in names if name in listed)


def _record(folder: Path) -> DatasetRecord | None:
    """The dataset's record, None without one. Raises InputError if it is malformed, or captures are missing."""
    file = folder / MANIFEST
    if not file.is_file():
        return None
    record = DatasetRecord.read(file)
    if not record.complete:
        raise InputError(
            "The dataset is incomplete",
            where=file,
            expected='"complete": true',
            got="a dataset whose creation was interrupted",
            fix="run `gnmreg dataset synth` again with the same arguments: it resumes",
        )
    return record


def _check_labels(folder: Path, labels: Mapping[str, str], categories: Mapping[str, str]) -> None:
    for where, label in labels.items():
        if label != NEUTRAL and label not in categories:
            expected = ", ".join(sorted(categories)) or "neutrals only"
            raise _input_error(
                "A label is unknown", folder / where, f"one of {MANIFEST}'s categories: {expected}", label
            )


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="correct it")
