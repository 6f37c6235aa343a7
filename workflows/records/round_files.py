"""The products and reports of a coregistration that exist on disk, also while it runs."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MANIFEST, PAGE, PLAN = "coregistration.json", "index.html", "plan.json"  # in a coregistration's folder
FIRST_MODEL = "model 0"
HELD_OUT = "held_out"
_ROUND = re.compile(r"it[0-9]{2,}")
_PRODUCTS = (  # title, path in the folder of a round
    ("stabilized expressions", "registrations/stabilized/index.html"),
    ("gate's record", "gate/gate.json"),
    ("verdicts", "gate/verdicts.csv"),
    ("model", "model/index.html"),
    ("model file", "model/gnm_head.npz"),
    ("record of the model", "model/gnm_head.manifest.json"),
    ("evaluation", "evaluation/index.html"),
    ("record of the evaluation", "evaluation/manifest.json"),
    ("meshes", "held_out.npz"),
)


def model_name(number: int) -> str:
    """Return the name of a model in records and figures; 0 is the first model, n the one that round n built."""
    return f"model {number}"


@dataclass(frozen=True, kw_only=True)
class SubjectFiles:
    """A subject in one round."""

    name: str
    page: str | None  # its page; None: there is none yet
    reports: Mapping[str, str | None]  # capture -> its report


@dataclass(frozen=True, kw_only=True)
class RoundFiles:
    """The files of a round, or of the held-out subjects. All paths are relative to the coregistration's folder."""

    name: str  # of its folder
    products: tuple[tuple[str, str], ...]  # title and path
    subjects: tuple[SubjectFiles, ...]

    @property
    def reported(self) -> int:
        """Number of captures with a report."""
        return sum(report is not None for subject in self.subjects for report in subject.reports.values())

    @property
    def captures(self) -> int:
        return sum(len(subject.reports) for subject in self.subjects)


def find_round_files(out: Path, plan: Mapping[str, Any]) -> tuple[RoundFiles, ...]:
    """Return what exists of the held-out subjects and of every round, in this order.

    Args:
        out: the coregistration's folder.
        plan: entries of `plan.json`.
    """
    rounds = sorted(path.name for path in out.iterdir() if _ROUND.fullmatch(path.name)) if out.is_dir() else []
    found = [_files(out, HELD_OUT, plan["without_truth"], plan["captures"])]
    found += [_files(out, name, plan["split"]["training"], plan["captures"]) for name in rounds]
    return tuple(files for files in found if files.products or any(subject.page for subject in files.subjects))


def _files(out: Path, name: str, subjects: Sequence[str], captures: Mapping[str, Sequence[str]]) -> RoundFiles:
    products = ((title, f"{name}/{path}") for title, path in _PRODUCTS)
    return RoundFiles(
        name=name,
        products=tuple((title, path) for title, path in products if (out / path).is_file()),
        subjects=tuple(_subjects(out, f"{name}/registrations", subjects, captures)),
    )


def _subjects(
    out: Path, run: str, subjects: Sequence[str], captures: Mapping[str, Sequence[str]]
) -> Iterator[SubjectFiles]:
    def existing(path: str) -> str | None:
        return path if (out / path).is_file() else None

    for name in subjects:
        folder = f"{run}/{name}"
        page = existing(f"{folder}/index.html")
        # Without a page there is no report: the page is written before the first registration.
        reports = {capture: page and existing(f"{folder}/{capture}/report.html") for capture in captures[name]}
        yield SubjectFiles(name=name, page=page, reports=reports)
