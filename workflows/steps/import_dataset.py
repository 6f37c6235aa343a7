"""`gnmreg dataset import`: a dataset in another program's layout becomes folders of subjects with native captures."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.convert import import_capture
from registration.formats.datasets import Recording, find_recordings
from registration.formats.registry import read_source
from registration.formats.source import ReadOptions
from registration.formats.units import parse_unit
from registration.progress import NullProgress, Progress
from registration.storage.reading import read_json
from workflows.processes import run_parallel
from workflows.records.dataset_import import MANIFEST, DatasetImportRecord, ImportRow, Status
from workflows.records.subject import NEUTRAL


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What of a dataset is imported.

    Attributes:
        format: name of the only format that counts; None: any that is recognized.
        subjects: names or patterns such as "01*"; empty: all.
        expressions: likewise.
        frames: of each sequence; empty: the format's first. Several are several captures of a sequence.
        neutral: expression whose first frame becomes each subject's neutral; None: the one with neutral in its name.
        unit: of the source's world, as `registration.formats.units.parse_unit` takes it; None: as the format says.
    """

    format: str | None = None
    subjects: tuple[str, ...] = ()
    expressions: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    neutral: str | None = None
    unit: str | None = None


def import_dataset(
    source: Path, target: Path, selection: Selection, *, jobs: int = 1, progress: Progress | None = None
) -> DatasetImportRecord:
    """Import the captures of a dataset into `target/SUBJECT/EXPRESSION`; a capture that fails does not stop others.

    Complete captures are kept: a repeated call resumes, tries failed ones again, and adds newly selected ones.

    Args:
        source: folder of the dataset.
        target: folder to write; new, empty, or of an earlier import of the same source with the same settings.
        selection: what is imported.
        jobs: captures imported in parallel.
        progress: where to report to.

    Returns:
        The content of `import.json`, with a row for each capture of this and earlier calls.

    Raises:
        InputError: the source has no recordings, nothing is selected, an option is wrong, or the target is another's,
            before anything is written.
    """
    progress = progress or NullProgress()
    if jobs < 1:
        raise _error("The number of jobs is out of range", "--jobs", "at least 1", jobs)
    if selection.unit is not None:
        parse_unit(selection.unit)
    recordings = _selected(find_recordings(source, selection.format), selection)
    planned = _rows(source, recordings, selection)
    record = DatasetImportRecord(
        source=source.resolve(), frames=selection.frames, neutral=selection.neutral, unit=selection.unit
    )
    earlier = _earlier(target, record)
    rows: dict[str, ImportRow] = {row.folder: row for row in earlier} | {
        folder: row for folder, (row, _) in planned.items()
    }
    calls: dict[str, dict[str, Any]] = {}
    for folder, (row, recording) in planned.items():
        if (target / folder / "capture.toml").is_file():
            rows[folder] = replace(row, status="imported", notes=_notes(target / folder))
        else:
            calls[folder] = _call(target / folder, row, recording, selection.unit)
    target.mkdir(parents=True, exist_ok=True)
    _write(target, record, rows)
    for done, (folder, failure) in enumerate(run_parallel(import_one, calls, jobs), 1):
        progress.update(done, len(calls), folder)
        notes = () if failure else _notes(target / folder)
        status: Status = "failed" if failure else "imported"
        rows[folder] = replace(rows[folder], status=status, reason=failure, notes=notes)
        _write(target, record, rows)
    return _write(target, record, rows)


def import_one(**settings: Any) -> str:
    """Import one capture. Returns the reason of its failure, "" for none."""
    try:
        options = ReadOptions(**{name: settings[name] for name in ("subject", "expression", "frame")})
        unit = settings["unit"]
        source = read_source(settings["source"], options, name=settings["format"])
        import_capture(source, settings["target"], unit_m=None if unit is None else parse_unit(unit))
    except InputError as error:
        return error.line
    except Exception as error:  # a bug in the reader of one capture must not stop the others
        return f"{type(error).__name__}: {error}"
    return ""


def without_neutral(record: DatasetImportRecord) -> list[str]:
    """Return the folders of the subjects that have no capture of a neutral."""
    subjects = dict.fromkeys(row.folder.partition("/")[0] for row in record.rows)
    return [subject for subject in subjects if not any(row.folder == f"{subject}/{NEUTRAL}" for row in record.rows)]


def _selected(recordings: Sequence[Recording], selection: Selection) -> list[Recording]:
    kept = list(recordings)
    for name, option, patterns in (
        ("subject", "--subjects", selection.subjects),
        ("expression", "--expressions", selection.expressions),
    ):
        names = list(dict.fromkeys(getattr(recording, name) for recording in kept))
        for pattern in patterns:
            if not any(fnmatchcase(known, pattern) for known in names):
                raise _error(f"There is no such {name}", option, listed(names, 12), pattern)
        if patterns:
            kept = [r for r in kept if any(fnmatchcase(getattr(r, name), pattern) for pattern in patterns)]
    return kept


def _rows(
    source: Path, recordings: Sequence[Recording], selection: Selection
) -> dict[str, tuple[ImportRow, Recording]]:
    """Folder of each capture -> its row and recording, whose expression is the capture's label."""
    neutrals = _neutrals(recordings, selection.neutral)
    planned: dict[str, tuple[ImportRow, Recording]] = {}
    for recording in recordings:
        for number, frame in enumerate(selection.frames or (None,)):
            suffix = f"_{frame:05d}" if len(selection.frames) > 1 else ""
            is_neutral = number == 0 and neutrals.get(recording.subject) == recording.expression
            label = NEUTRAL if is_neutral else f"{recording.expression}{suffix}"
            folder = f"{_folder_name(recording.subject)}/{_folder_name(label)}"
            if folder in planned:
                got = f"{planned[folder][1].path} and {recording.path}"
                raise _error("Two recordings have one name", source, f"one for {folder}", got)
            below = recording.path.resolve().relative_to(source.resolve()).as_posix()
            row = ImportRow(folder=folder, source=below, format=recording.format, frame=frame)
            planned[folder] = row, replace(recording, expression=label)
    return planned


def _neutrals(recordings: Sequence[Recording], chosen: str | None) -> Mapping[str, str]:
    """Subject -> the expression that is its neutral."""
    if chosen is not None:
        neutrals = {r.subject: r.expression for r in recordings if r.expression == chosen}
        if not neutrals:
            names = listed(list(dict.fromkeys(r.expression for r in recordings)), 12)
            raise _error("There is no such expression", "--neutral", names, chosen)
        return neutrals
    named: dict[str, str] = {}
    for recording in recordings:
        if NEUTRAL in recording.expression.lower():
            named.setdefault(recording.subject, recording.expression)
    return named


def _folder_name(name: str) -> str:
    """A name that is one folder's on any system and not hidden."""
    return re.sub(r"[^\w.+@-]+", "_", name).lstrip(".") or "_"


def _call(target: Path, row: ImportRow, recording: Recording, unit: str | None) -> dict[str, Any]:
    return {
        "source": recording.path,
        "target": target,
        "format": row.format,
        "subject": recording.subject,
        "expression": recording.expression,
        "frame": row.frame,
        "unit": unit,
    }


def _earlier(target: Path, record: DatasetImportRecord) -> tuple[ImportRow, ...]:
    """The rows of an earlier import into the folder. Raises InputError if it is anything but one of these settings."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return ()
    file = target / MANIFEST
    existing = DatasetImportRecord.read(file) if DatasetImportRecord.is_ours(file) else None
    if existing is None or replace(existing, rows=()) != record:
        raise InputError.output_folder(
            target,
            expected="a new or empty folder, or one of an import of this source with the same frames, neutral and unit",
            got="other contents" if existing is None else f"an import of {existing.source} with other settings",
        )
    return existing.rows


def _notes(capture: Path) -> tuple[str, ...]:
    """The notes in a capture's own record of its import."""
    file = capture / "import.json"

    def refuse(expected: object, got: object) -> InputError:
        return InputError("The record of a capture's import cannot be read", where=file, expected=expected, got=got)

    notes = read_json(file, refuse).get("notes", []) if file.is_file() else []
    return tuple(str(note) for note in notes)


def _write(target: Path, record: DatasetImportRecord, rows: Mapping[str, ImportRow]) -> DatasetImportRecord:
    done = replace(record, rows=tuple(rows.values()))
    done.write(target / MANIFEST)
    return done


def _error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change it")
