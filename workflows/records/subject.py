"""A subject on disk: the folder of their captures, and the folder of their registrations with its `subject.json`
(docs/formats.md)."""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from registration.capture.native import natural_key, read_capture
from registration.errors import InputError
from registration.storage.files import atomic_write_text
from registration.storage.records import Record, json_key
from registration.storage.registration_folder import check_output_folder
from registration.types import Capture

MANIFEST, PAGE = "subject.json", "index.html"
NEUTRAL = "neutral"  # the expression of a neutral's capture.toml

USABLE = ("converged", "stopped")  # statuses
# "waiting": not reached yet. "error": there is no registration. "skipped": not tried because the neutral failed.
RowStatus = Literal["waiting", "converged", "stopped", "failed", "error", "skipped"]


@dataclass(frozen=True, kw_only=True)
class SubjectCaptures:
    """The captures in a subject's folder."""

    folder: Path
    subject: str
    captures: tuple[Capture, ...]  # the neutral first, then by folder name
    broken: Mapping[str, InputError]  # folder name -> why that capture cannot be read

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all captures' folders, including the broken ones."""
        return (*(capture.root.name for capture in self.captures), *self.broken)


@dataclass(frozen=True, kw_only=True)
class CaptureRow:
    """The registration of one capture of a subject."""

    name: str  # of the capture's folder, and of its registration's
    expression: str  # empty if the capture cannot be read
    status: RowStatus = "waiting"
    reason: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)  # the headline among the manifest's, mm
    seconds: float | None = None  # duration of the registration when it was computed
    folder: str | None = None  # of the registration, within the subject's; None: there is none

    @property
    def usable(self) -> bool:
        return self.status in USABLE


@dataclass(frozen=True, kw_only=True)
class UsableRegistrations:
    """Those of a subject's registrations that converged or were stopped."""

    subject: str
    neutral: str  # name of its registration's folder
    expressions: Mapping[str, str]  # folder name -> expression label

    @property
    def names(self) -> tuple[str, ...]:
        """Folder names of all, the neutral's first."""
        return (self.neutral, *self.expressions)

    def without(self, names: Collection[str]) -> "UsableRegistrations | None":
        """Return them without those of these names; None if the neutral is one."""
        if self.neutral in names:
            return None
        return replace(self, expressions={name: label for name, label in self.expressions.items() if name not in names})


@dataclass(frozen=True, kw_only=True)
class SubjectRecord(
    Record, kind="gnm-subject", title="subject's record", fix="delete it and run `gnmreg subject` again"
):
    """The registrations of all captures of a subject: `subject.json`."""

    subject: str
    model: str  # the model's content hash
    recipe: str
    neutral: str  # the row of this name
    rows: tuple[CaptureRow, ...] = json_key("captures")  # the neutral's first

    def row(self, name: str) -> CaptureRow | None:
        """Return the row of a capture, None if there is none."""
        return next((row for row in self.rows if row.name == name), None)

    @property
    def usable(self) -> UsableRegistrations | None:
        """The usable registrations; None if the neutral is not among them."""
        names = {row.name: row.expression for row in self.rows if row.usable}
        if self.neutral not in names:
            return None
        expressions = {name: label for name, label in names.items() if name != self.neutral}
        return UsableRegistrations(subject=self.subject, neutral=self.neutral, expressions=expressions)


def is_subject_folder(folder: Path) -> bool:
    """Return whether a folder holds a `subject.json`, valid or not."""
    return os.path.lexists(Path(folder) / MANIFEST)


def read_subject(folder: Path) -> SubjectRecord | None:
    """Read the `subject.json` of a folder; None if there is none: it is no folder of registrations.

    Raises:
        InputError: the record is malformed.
    """
    return SubjectRecord.read(Path(folder) / MANIFEST) if is_subject_folder(folder) else None


def read_usable(folder: Path) -> UsableRegistrations | None:
    """Return a subject folder's usable registrations; None without a record, or without a usable neutral.

    Raises:
        InputError: the record is malformed.
    """
    record = read_subject(folder)
    return None if record is None else record.usable


def read_usable_subjects(
    run: Path, names: Sequence[str], left_out: Collection[str] = ()
) -> dict[str, UsableRegistrations]:
    """Return subject folder's name -> its usable registrations, of those of the subjects that have any.

    Args:
        run: folder of the subject folders.
        names: of the subject folders.
        left_out: registrations that are not used, as SUBJECT/NAME of the folders.

    Raises:
        InputError: a record is malformed.
    """
    found = {name: usable for name in names if (usable := read_usable(run / name)) is not None}
    kept = {
        name: usable.without([one for one in usable.names if f"{name}/{one}" in left_out])
        for name, usable in found.items()
    }
    return {name: usable for name, usable in kept.items() if usable is not None}


def read_captures(folder: Path, neutral: str | None = None) -> SubjectCaptures:
    """Read the headers of a subject's captures: the sub-folders with a `capture.toml`.

    Args:
        folder: of the subject.
        neutral: name of the neutral's folder; None: the capture whose expression is "neutral".

    Returns:
        The captures; one that cannot be read is in `broken`, unless it is the neutral named by the argument.

    Raises:
        InputError: there is no such folder, no capture in it, not exactly one neutral, or there are several subjects.
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
            fix="give every subject a separate folder, or correct `subject` in capture.toml",
        )
    ordered = (captures[first], *(capture for name, capture in captures.items() if name != first))
    return SubjectCaptures(folder=folder, subject=subjects.pop(), captures=ordered, broken=broken)


def check_subject_out(out: Path, captures: SubjectCaptures) -> None:
    """Refuse, before any work, an output folder that is not a subject's, or another subject's.

    Raises:
        InputError: `out` lies in a capture, is a file, a filled folder without a valid `subject.json`, or another
            subject's; or one of the registration folders in it cannot be used.
    """
    resolved = out.resolve()
    for name in captures.names:
        if (captures.folder / name).resolve() in (resolved, *resolved.parents):
            raise _refused(out, got=f"a folder inside the capture {name}", fix="choose a folder outside the captures")
        if name in (MANIFEST, PAGE):
            raise _refused(out, got=f"a capture whose folder is named {name}", fix="rename that folder")
    if resolved.is_dir() and any(resolved.iterdir()):
        record = read_subject(resolved)
        if record is None:
            raise _refused(out, got="a folder with other contents", fix="choose another output folder")
        if record.subject != captures.subject:
            got = f"the folder of subject {record.subject!r}"
            raise _refused(out, got=got, fix="give every subject a separate folder")
    else:
        check_output_folder(resolved)
    for name in captures.names:
        check_output_folder(resolved / name)


def write_subject(record: SubjectRecord, out: Path, page: str) -> None:
    """Write `subject.json` and `index.html`, each in one rename."""
    out.mkdir(parents=True, exist_ok=True)
    record.write(out / MANIFEST)
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
    below = [
        path for path in folder.iterdir() if not path.name.startswith(".") and os.path.lexists(path / "capture.toml")
    ]
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


def _neutral(folder: Path, captures: Mapping[str, Capture], broken: Mapping[str, InputError], name: str | None) -> str:
    """The name of the neutral's folder."""
    if name is not None:
        if name not in captures:
            raise InputError(
                "There is no such capture",
                where="--neutral",
                expected=f"one of {', '.join(captures)}",
                got=name,
                fix="give the name of the neutral capture's folder",
            )
        return name
    neutrals = [name for name, capture in captures.items() if capture.expression == NEUTRAL]
    if len(neutrals) != 1:
        labels = [f"{name}: {capture.expression}" for name, capture in captures.items()]
        labels += [f"{name}: cannot be read ({error.what}, {error.where})" for name, error in broken.items()]
        raise InputError(
            "There are two neutrals" if neutrals else "There is no neutral",
            where=folder,
            expected=f'one capture with expression = "{NEUTRAL}"',
            got=", ".join(neutrals or labels),
            fix="name the neutral's folder with --neutral, or correct capture.toml",
        )
    return neutrals[0]


def _refused(out: Path, *, got: str, fix: str) -> InputError:
    return InputError(
        "The output folder cannot be used",
        where=out,
        expected="a new or empty folder, or one that `gnmreg subject` wrote for this subject",
        got=got,
        fix=fix,
    )
