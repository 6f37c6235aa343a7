"""Figures of a dataset: subjects and samples by gender, age, ethnicity and category of the expression, and what the
captures do not state [GNM, Data Foundation & Acquisition]."""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from coregister.tag_groups import tag_group
from registration.capture.native import natural_key
from registration.types import Capture
from workflows.records.dataset import CATEGORY, Dataset
from workflows.records.subject import NEUTRAL

TAGS = ("gender", "age", "ethnicity")  # of subjects
CATEGORIES = ("flexing", "visemes", "lips", "emotions", "tongue", "jaw", "eyes", "gaze", "eyebrows", "cheeks")
COLUMNS = ("kind", "group", "subjects", "samples", "names")
NOT_STATED = "not stated"
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # a spreadsheet would compute a text that begins so


@dataclass(frozen=True, kw_only=True)
class GroupCount:
    """How often one value of a tag, or one category, occurs."""

    group: str
    subjects: int
    samples: int  # captures, neutrals included


@dataclass(frozen=True, kw_only=True)
class Distribution:
    """Subjects and samples by the groups of one tag, or by category."""

    kind: str
    groups: tuple[GroupCount, ...]
    missing: tuple[str, ...]  # subjects' folders, or SUBJECT/CAPTURE, that do not state it
    missing_samples: int  # captures of those

    @property
    def missing_subjects(self) -> int:
        """Number of subjects among the missing."""
        return len({name.partition("/")[0] for name in self.missing})


@dataclass(frozen=True, kw_only=True)
class DatasetFigures:
    """Figures of a dataset."""

    name: str
    subjects: int
    samples: int  # captures that can be read
    distributions: tuple[Distribution, ...]  # of `TAGS`, then of the category
    expressions: tuple[GroupCount, ...]  # by label
    unreadable: Mapping[str, str]  # SUBJECT/CAPTURE -> why it cannot be read

    @property
    def empty_categories(self) -> tuple[str, ...]:
        """Those of the ten categories without a sample."""
        groups = self.distributions[-1].groups
        return tuple(each.group for each in groups if not each.samples)


def describe(dataset: Dataset) -> DatasetFigures:
    """Count the subjects and samples of a dataset.

    A subject's tags are those of the neutral's capture. The category of an expression is its capture's tag, or what
    `dataset.json` states for its label.
    """
    samples = [(name, c) for name, subject in dataset.subjects.items() for c in subject.captures]
    tagged = [_by_tag(dataset, tag) for tag in TAGS]
    labels = _counts([(capture.expression, name) for name, capture in samples])
    return DatasetFigures(
        name=dataset.folder.resolve().name,
        subjects=len(dataset.subjects),
        samples=len(samples),
        distributions=(*tagged, _by_category(dataset, samples)),
        expressions=_sorted(labels),
        unreadable={
            f"{name}/{folder}": error.what
            for name, subject in dataset.subjects.items()
            for folder, error in subject.broken.items()
        },
    )


def csv_text(figures: DatasetFigures) -> str:
    """Return the figures as CSV with the columns `COLUMNS`; the last names what does not state its group."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_harmless(value) for value in row] for row in _rows(figures))
    return text.getvalue()


def _rows(figures: DatasetFigures) -> Iterator[tuple[object, ...]]:
    yield "all", "", figures.subjects, figures.samples, ""
    for distribution in figures.distributions:
        for each in distribution.groups:
            yield distribution.kind, each.group, each.subjects, each.samples, ""
        if distribution.missing:
            counts = (distribution.missing_subjects, distribution.missing_samples)
            yield distribution.kind, NOT_STATED, *counts, "; ".join(distribution.missing)
    for each in figures.expressions:
        yield "expression", each.group, each.subjects, each.samples, ""
    for name, reason in figures.unreadable.items():
        yield "unreadable", reason, "", "", name


def _harmless(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def _by_tag(dataset: Dataset, tag: str) -> Distribution:
    found, missing = [], []
    for name, subject in dataset.subjects.items():
        group = _group(dataset.tags(name).get(tag))
        if group is None:
            missing.append(name)
        else:
            found += [(group, name)] * len(subject.captures)
    captures = sum(len(dataset.subjects[name].captures) for name in missing)
    return Distribution(kind=tag, groups=_sorted(_counts(found)), missing=tuple(missing), missing_samples=captures)


def _by_category(dataset: Dataset, samples: Iterable[tuple[str, Capture]]) -> Distribution:
    found, missing = [], []
    for name, capture in samples:
        stated = dataset.categories.get(capture.expression) if dataset.closed else None
        category = NEUTRAL if capture.expression == NEUTRAL else _group(capture.tags.get(CATEGORY, stated))
        if category is None:
            missing.append(f"{name}/{capture.root.name}")
        else:
            found.append((category, name))
    counts = _counts(found)
    first = [counts.pop(name, GroupCount(group=name, subjects=0, samples=0)) for name in (NEUTRAL, *CATEGORIES)]
    groups = (*first, *_sorted(counts))
    return Distribution(kind=CATEGORY, groups=groups, missing=tuple(missing), missing_samples=len(missing))


def _group(value: Any) -> str | None:
    return None if value is None else tag_group(value).strip() or None


def _counts(pairs: Iterable[tuple[str, str]]) -> dict[str, GroupCount]:
    """Group -> its counts, from pairs of a group and a subject, one for each sample."""
    subjects: dict[str, list[str]] = {}
    for group, subject in pairs:
        subjects.setdefault(group, []).append(subject)
    return {
        group: GroupCount(group=group, subjects=len(set(names)), samples=len(names))
        for group, names in subjects.items()
    }


def _sorted(counts: Mapping[str, GroupCount]) -> tuple[GroupCount, ...]:
    return tuple(counts[group] for group in sorted(counts, key=natural_key))
