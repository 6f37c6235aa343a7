"""A dataset on disk: a folder of subject folders, each of capture folders; and who of them is held out."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from registration.capture.native import natural_key
from registration.errors import InputError
from workflows.records.subject import NEUTRAL, Captures, read_captures

KIND = "gnm-dataset"
SCHEMA = 1
MANIFEST = "dataset.json"
CATEGORY, HELD_OUT = "category", "held_out"  # tags of captures that are none of a subject's
LEAST = 2  # subjects on either side: a basis needs two heads, an interval two people


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Subjects by the names of their folders, in order; only headers were read."""

    folder: Path
    subjects: Mapping[str, Captures]
    categories: Mapping[str, str] = field(default_factory=dict)  # label of an expression -> its category
    closed: bool = False  # there may be no other labels

    def tags(self, name: str) -> dict[str, Any]:
        """A subject's own tags, as its neutral's capture tells them."""
        tags = self.subjects[name].captures[0].tags
        return {tag: value for tag, value in tags.items() if tag not in (CATEGORY, HELD_OUT)}


@dataclass(frozen=True, kw_only=True)
class Split:
    """Who makes the models and who measures them."""

    training: tuple[str, ...]
    held_out: tuple[str, ...]
    how: str  # the choice, in words


def read_dataset(folder: Path) -> Dataset:
    """All subjects with captures below `folder`; hidden folders and those without captures are left out.

    Raises:
        InputError: no such folder, no subjects; a dataset that is not all there yet; a subject without a neutral, or
            whose captures show several people; one subject in two folders; a label that `dataset.json` does not know.
    """
    folder = Path(folder)
    told = _manifest(folder)
    below = sorted(folder.iterdir(), key=lambda path: natural_key(path.name)) if folder.is_dir() else []
    found = [p for p in below if not p.name.startswith(".") and any(p.glob("*/capture.toml"))]
    if not found:
        raise InputError(
            "There are no subjects",
            where=folder,
            expected="a folder of subject folders, each of capture folders",
            got="a subject" if any(folder.glob("*/capture.toml")) else "none" if below else "no such folder",
            fix="give the folder that holds the subjects' folders",
        )
    subjects = {path.name: read_captures(path) for path in found}
    owners: dict[str, str] = {}
    for name, captures in subjects.items():
        if captures.subject in owners:
            raise InputError(
                "Two folders hold the same subject",
                where=folder,
                expected="one folder a subject",
                got=f"{captures.subject} in {owners[captures.subject]} and {name}",
                fix="put the captures together, or correct `subject` in their capture.toml files",
            )
        owners[captures.subject] = name
    every = [(name, capture) for name, captures in subjects.items() for capture in captures.captures]
    labels = told.get("categories")
    if labels is not None:
        _check_labels(folder, {f"{name}/{c.root.name}": c.expression for name, c in every}, labels)
        return Dataset(folder=folder, subjects=subjects, categories=labels, closed=True)
    categories = {c.expression: str(c.tags.get(CATEGORY, c.expression)) for _, c in every if c.expression != NEUTRAL}
    return Dataset(folder=folder, subjects=subjects, categories=categories)


def split(dataset: Dataset, held_out: float | Path | None = None, seed: int = 0) -> Split:
    """Who is held out: a share of the subjects, drawn by the seed; those whom a file names, one name a line; or, if
    None, those whose neutral's capture has the tag `held_out = true`, and a fifth by the seed if none has.

    Raises InputError for a share out of range, a file that cannot be read, unknown names, and too few on either side.
    """
    names = tuple(dataset.subjects)
    tagged = tuple(n for n in names if dataset.subjects[n].captures[0].tags.get(HELD_OUT) is True)
    if held_out is None and tagged:
        chosen, how = tagged, "by the tag held_out"
    elif held_out is None or isinstance(held_out, float):
        share = 0.2 if held_out is None else held_out
        if not 0 < share < 1:
            raise _wrong("The share to hold out is out of range", "held-out", "between 0 and 1", share)
        count = max(LEAST, round(share * len(names)))
        drawn = np.random.default_rng(seed).permutation(len(names))[:count].tolist()
        chosen, how = tuple(names[k] for k in sorted(drawn)), f"a share of {share:g} by seed {seed}"
    else:
        chosen, how = _listed(Path(held_out), names), f"by the list {Path(held_out).name}"
    training = tuple(name for name in names if name not in chosen)
    for what, side in (("to build a model from", training), ("to hold out", chosen)):
        if len(side) < LEAST:
            expected = f"at least {LEAST} {what} of the {len(names)} in {dataset.folder}"
            raise _wrong(f"There are too few subjects {what}", "held-out", expected, ", ".join(side) or "none")
    return Split(training=training, held_out=chosen, how=how)


def _listed(file: Path, names: Sequence[str]) -> tuple[str, ...]:
    try:
        told = [line.strip() for line in file.read_text("utf-8").splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        expected = "a share such as 0.2, or a file with a subject's folder name a line"
        raise _wrong("The held-out subjects cannot be read", file, expected, error) from error
    if unknown := [name for name in told if name not in names]:
        raise _wrong("There is no such subject to hold out", file, ", ".join(names[:8]), unknown[0])
    return tuple(name for name in names if name in told)


def _manifest(folder: Path) -> dict[str, Any]:
    """What `dataset.json` tells; nothing without one."""
    file = folder / MANIFEST
    if not file.is_file():
        return {}
    try:
        told = json.loads(file.read_text("utf-8"))
        if told["kind"] != KIND or told["schema"] != SCHEMA:
            raise ValueError(f"{told['kind']}, schema {told['schema']}")
        complete = bool(told["complete"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = f'"kind": "{KIND}", "schema": {SCHEMA}'
        raise _wrong("The dataset's record cannot be read", file, expected, error) from error
    if not complete:
        raise InputError(
            "The dataset is not all there yet",
            where=file,
            expected='"complete": true',
            got="a dataset whose making was interrupted",
            fix="run `gnmreg dataset synth` again with the same arguments: it goes on",
        )
    return dict(told)


def _check_labels(folder: Path, labels: Mapping[str, str], known: Mapping[str, str]) -> None:
    for where, label in labels.items():
        if label != NEUTRAL and label not in known:
            expected = ", ".join(sorted(known)) or "neutrals only"
            raise _wrong("A label is unknown", folder / where, f"one of {MANIFEST}'s categories: {expected}", label)


def _wrong(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="correct it")
