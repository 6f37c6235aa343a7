"""A subject on disk: the captures that lie in one folder, and the folder of their registrations with its
`subject.json` (docs/formats.md)."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from registration.capture.native import natural_key, read_capture
from registration.errors import InputError
from registration.storage.files import atomic_write_text, read_json_of_kind
from registration.storage.hashing import to_jsonable
from registration.storage.registration_folder import check_output_folder
from registration.types import Capture

SCHEMA = 1
KIND = "gnm-subject"
MANIFEST, PAGE = "subject.json", "index.html"
NEUTRAL = "neutral"  # the expression of a neutral's capture.toml

USABLE = ("converged", "stopped")  # statuses
# "waiting": not reached yet. "error": no registration could be made. "skipped": not tried, for the neutral failed.
RowStatus = Literal["waiting", "converged", "stopped", "failed", "error", "skipped"]


@dataclass(frozen=True, kw_only=True)
class Captures:
    """A subject's captures as they lie in a folder."""

    folder: Path
    subject: str
    captures: tuple[Capture, ...]  # the neutral first, then by folder name
    broken: Mapping[str, InputError]  # folder name -> why that capture cannot be read

    @property
    def names(self) -> tuple[str, ...]:
        """Of all captures' folders, also the broken ones'."""
        return (*(capture.root.name for capture in self.captures), *self.broken)


@dataclass(frozen=True, kw_only=True)
class Row:
    """What became of one capture."""

    name: str  # of the capture's folder, and of its registration's
    expression: str  # empty if the capture cannot be read
    status: RowStatus = "waiting"
    reason: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)  # the headline among the manifest's, mm
    seconds: float | None = None  # that the registration took when it was made
    folder: str | None = None  # of the registration, within the subject's; None: there is none

    @property
    def usable(self) -> bool:
        return self.status in USABLE


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What became of all captures: `subject.json`."""

    subject: str
    model: str  # the model's content hash
    recipe: str
    neutral: str  # the row of this name
    rows: tuple[Row, ...]  # the neutral's first


def read_captures(folder: Path, neutral: str | None = None) -> Captures:
    """The captures among the sub-folders of `folder`: those with a `capture.toml`. Only headers are read.

    `neutral` names the neutral's folder; otherwise it is the capture whose expression is "neutral". A capture that
    cannot be read ends up in `broken`, unless it is the neutral that was named.

    Raises:
        InputError: no such folder, no capture in it, no neutral or two, or captures of several subjects.
    """
    captures: dict[str, Capture] = {}
    broken: dict[str, InputError] = {}
    for path in _capture_folders(folder):
        try:
            captures[path.name] = read_capture(path)
        except InputError as error:
            broken[path.name] = error
    if neutral in broken:
        raise broken[neutral]
    first = _neutral(folder, captures, broken, neutral)
    subjects = {capture.subject for capture in captures.values()}
    if len(subjects) > 1:
        raise InputError(
            "The captures show several subjects",
            where=folder,
            expected="captures of one subject",
            got=", ".join(f"{name}: {capture.subject}" for name, capture in captures.items()),
            fix="give every subject a folder of its own, or correct `subject` in capture.toml",
        )
    ordered = (captures[first], *(capture for name, capture in captures.items() if name != first))
    return Captures(folder=folder, subject=subjects.pop(), captures=ordered, broken=broken)


def check_subject_out(out: Path, captures: Captures) -> None:
    """Refuse, before any work, an output folder that is not ours, or not this subject's.

    Raises:
        InputError: `out` lies in a capture, is a file, a filled folder without our `subject.json`, or another
            subject's; or one of the registration folders in it cannot be used.
    """
    place = out.resolve()
    for name in captures.names:
        if (captures.folder / name).resolve() in (place, *place.parents):
            raise _refused(out, got=f"a place inside the capture {name}", fix="choose a folder outside the captures")
        if name in (MANIFEST, PAGE):
            raise _refused(out, got=f"a capture whose folder is named {name}", fix="rename that folder")
    if place.is_dir() and any(place.iterdir()):
        owner = _owner(place)
        if owner is None:
            raise _refused(out, got="a folder that holds other things", fix="choose another output folder")
        if owner != captures.subject:
            raise _refused(out, got=f"the folder of subject {owner!r}", fix="give every subject a folder of its own")
    else:
        check_output_folder(place)
    for name in captures.names:
        check_output_folder(place / name)


@dataclass(frozen=True, kw_only=True)
class Usable:
    """What of a subject's folder can be used."""

    subject: str
    neutral: str  # name of its registration's folder
    expressions: Mapping[str, str]  # of the others that can be used -> what was performed


def read_usable(folder: Path) -> Usable | None:
    """The usable registrations that `subject.json` tells of; None without it, or if the neutral is not among them."""
    try:
        told = json.loads((Path(folder) / MANIFEST).read_text("utf-8"))
        rows = {str(row["name"]): row for row in told["captures"] if row["status"] in USABLE}
        subject, neutral = str(told["subject"]), str(told["neutral"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if neutral not in rows:
        return None
    expressions = {name: str(row["expression"]) for name, row in rows.items() if name != neutral}
    return Usable(subject=subject, neutral=neutral, expressions=expressions)


def save_subject(subject: Subject, out: Path, page: str) -> None:
    """Write `subject.json` and `index.html`, each in one rename: whoever reads sees the old or the new one."""
    out.mkdir(parents=True, exist_ok=True)
    head = {"kind": KIND, "schema": SCHEMA}
    rows = [{f.name: getattr(row, f.name) for f in fields(row)} for row in subject.rows]
    body = {f.name: getattr(subject, f.name) for f in fields(subject) if f.name != "rows"}
    text = json.dumps(to_jsonable({**head, **body, "captures": rows}), indent=1, allow_nan=False) + "\n"
    atomic_write_text(out / MANIFEST, text)
    atomic_write_text(out / PAGE, page)


def _capture_folders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(
            "The subject's folder is missing",
            where=folder,
            expected="a folder whose sub-folders are captures",
            got="a file" if folder.exists() else "no such folder",
            fix="check the path",
        )
    below = [path for path in folder.iterdir() if not path.name.startswith(".") and (path / "capture.toml").is_file()]
    if not below:
        itself = (folder / "capture.toml").is_file()
        raise InputError(
            "There are no captures in the subject's folder",
            where=folder,
            expected="sub-folders with capture.toml",
            got="a capture" if itself else "none",
            fix="give the folder that holds it, or `gnmreg register` for one capture" if itself else "check the path",
        )
    return sorted(below, key=lambda path: natural_key(path.name))


def _neutral(
    folder: Path, captures: Mapping[str, Capture], broken: Mapping[str, InputError], wanted: str | None
) -> str:
    """The name of the neutral's folder."""
    if wanted is not None:
        if wanted not in captures:
            raise InputError(
                "There is no such capture",
                where="--neutral",
                expected=f"one of {', '.join(captures)}",
                got=wanted,
                fix="give the name of the neutral capture's folder",
            )
        return wanted
    found = [name for name, capture in captures.items() if capture.expression == NEUTRAL]
    if len(found) != 1:
        told = [f"{name}: {capture.expression}" for name, capture in captures.items()]
        told += [f"{name}: cannot be read ({error.what}, {error.where})" for name, error in broken.items()]
        raise InputError(
            "There are two neutrals" if found else "There is no neutral",
            where=folder,
            expected=f'one capture with expression = "{NEUTRAL}"',
            got=", ".join(found or told),
            fix="name the neutral's folder with --neutral, or correct capture.toml",
        )
    return found[0]


def _owner(out: Path) -> str | None:
    """The subject whose folder `out` is; None if it is not ours."""
    manifest = read_json_of_kind(out / MANIFEST, KIND)
    return None if manifest is None else str(manifest.get("subject"))


def _refused(out: Path, *, got: str, fix: str) -> InputError:
    return InputError(
        "The output folder cannot be used",
        where=out,
        expected="a new or empty folder, or one that `gnmreg subject` wrote for this subject",
        got=got,
        fix=fix,
    )
